//! Times of active runs, kept in memory while the state is unchanged, so that many pages that watch one run read them once.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use protocol::message::Times;
use protocol::{RunId, StageName};

use crate::state::State;

/// Maximum number of runs whose times are kept.
const RUNS: usize = 256;

/// Times of a run and of those of its stages that began.
#[derive(Debug, Default)]
pub(super) struct RunTimes {
    pub(super) run: Times,
    pub(super) stages: BTreeMap<StageName, Times>,
}

/// Times of runs that were read beside one state.
#[derive(Debug, Default)]
pub(crate) struct TimesCache(Mutex<Kept>);

#[derive(Debug, Default)]
struct Kept {
    /// The state. While it is referred to, no later one has its address.
    beside: Weak<State>,
    runs: BTreeMap<RunId, Arc<RunTimes>>,
}

impl TimesCache {
    /// Returns the times that were read beside `state`.
    pub(super) fn get(&self, state: &Arc<State>, run: &RunId) -> Option<Arc<RunTimes>> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        std::ptr::eq(kept.beside.as_ptr(), Arc::as_ptr(state)).then(|| kept.runs.get(run).cloned()).flatten()
    }

    /// Keeps times that were read beside `state`. Those of another state are dropped.
    pub(super) fn keep(&self, state: &Arc<State>, run: RunId, times: Arc<RunTimes>) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if !std::ptr::eq(kept.beside.as_ptr(), Arc::as_ptr(state)) {
            *kept = Kept { beside: Arc::downgrade(state), runs: BTreeMap::new() };
        }
        if kept.runs.len() < RUNS {
            kept.runs.insert(run, times);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::Policy;

    fn state() -> Arc<State> {
        Arc::new(State::new(Policy::default()))
    }

    #[test]
    fn times_hold_as_long_as_the_state() {
        let cache = TimesCache::default();
        let run = RunId::new("r-1");
        let times = Times { created_ms: Some(30), ..Times::default() };
        let (first, second) = (state(), state());
        cache.keep(&first, run.clone(), Arc::new(RunTimes { run: times, ..RunTimes::default() }));
        assert_eq!(cache.get(&first, &run).map(|kept| kept.run), Some(times));
        assert!(cache.get(&second, &run).is_none());
        cache.keep(&second, run.clone(), Arc::default());
        assert!(cache.get(&first, &run).is_none());
    }

    #[test]
    fn the_number_of_runs_is_bounded() {
        let (cache, state) = (TimesCache::default(), state());
        for number in 0..2 * RUNS {
            let run = RunId::new(format!("r-{number}"));
            cache.keep(&state, run, Arc::default());
        }
        assert_eq!(cache.0.lock().expect("the lock").runs.len(), RUNS);
    }
}
