//! Whether a gang is slower than one of its members would be alone, and because of whom.
//!
//! A member knows how long its own slices take, and so about how long all of them would. Where steps take longer than that for a while, or one
//! step is far over it, the peer is named whose parts came last, or that took this member's last. Parts of a sum depend on nobody but their
//! sender, and all are sent at once; so a third member that waits for the slow one is not named.

use std::collections::BTreeSet;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::event_count::lock;

/// A gang may take so much longer for a step than a member alone before it is too slow: it makes at least 0.8 of the member's rate.
const TOLERANCE: f64 = 1.25;
/// A step of a gang costs at least so much more than a member's own where speed is complained of.
const COST: Duration = Duration::from_millis(100);
/// A single step that is under way is too slow after so many times what a member alone needs.
const FAR_OVER: u32 = 3;

/// The pace of one generation, as one member sees it.
#[derive(Debug)]
pub(crate) struct Pace {
    /// What is judged lasts at least so long.
    window: Duration,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// The exchange under way, unless it is excused.
    exchange: Option<Exchange>,
    /// When each peer's part of it was complete in both directions.
    late: Vec<Late>,
    /// Sums over the steps of the window.
    steps: u32,
    took: Duration,
    alone: Duration,
    lags: Vec<Duration>,
    /// Who is named.
    slow: BTreeSet<usize>,
}

#[derive(Debug, Clone, Copy)]
struct Exchange {
    begun: Instant,
    /// What this member's share took.
    own: Duration,
    /// What the step would take it alone.
    alone: Duration,
}

#[derive(Debug, Clone, Copy, Default)]
struct Late {
    sent: Option<Duration>,
    received: Option<Duration>,
}

impl Late {
    fn both(self) -> Option<Duration> {
        Some(self.sent?.max(self.received?))
    }
}

impl Pace {
    pub(super) fn new(members: usize, window: Duration) -> Self {
        let state = State {
            exchange: None,
            late: vec![Late::default(); members],
            steps: 0,
            took: Duration::ZERO,
            alone: Duration::ZERO,
            lags: vec![Duration::ZERO; members],
            slow: BTreeSet::new(),
        };
        Self { window, state: Mutex::new(state) }
    }

    /// An exchange begins after `own` was spent on `share` of `slices` slices.
    pub(super) fn begin(&self, own: Duration, share: usize, slices: usize) {
        let mut state = lock(&self.state);
        let state = &mut *state;
        state.late.fill(Late::default());
        // A member without slices cannot tell.
        state.exchange = (share > 0).then(|| {
            let alone = own.mul_f64(slices as f64 / share as f64);
            Exchange { begun: Instant::now(), own, alone }
        });
    }

    /// A member saves, or has saved since the step before: that is no matter of speed.
    pub(super) fn excuse(&self) {
        lock(&self.state).exchange = None;
    }

    /// All that a peer needs of this member's parts has gone to it.
    pub(super) fn sent(&self, peer: usize) {
        let mut state = lock(&self.state);
        let since = state.exchange.map(|exchange| exchange.begun.elapsed());
        state.late[peer].sent = since;
    }

    /// All of a peer's parts are here, since `at`.
    pub(super) fn received(&self, peer: usize, at: Instant) {
        let mut state = lock(&self.state);
        let since = state.exchange.map(|exchange| at.saturating_duration_since(exchange.begun));
        state.late[peer].received = since;
    }

    /// The exchange is over. Gives a peer that is newly found to be too slow.
    pub(super) fn end(&self, others: impl Iterator<Item = usize>) -> Option<usize> {
        let mut state = lock(&self.state);
        let state = &mut *state;
        let Exchange { begun, own, alone } = state.exchange.take()?;
        state.steps += 1;
        state.took += own + begun.elapsed();
        state.alone += alone;
        for peer in others {
            state.lags[peer] += state.late[peer].both().unwrap_or_default();
        }
        if state.took < self.window || state.steps < 3 {
            return None;
        }
        let cost = state.took.saturating_sub(state.alone) / state.steps;
        let is_slow = state.took > state.alone.mul_f64(TOLERANCE) && cost > COST;
        let worst = (0..state.lags.len()).max_by_key(|peer| state.lags[*peer]);
        (state.steps, state.took, state.alone) = (0, Duration::ZERO, Duration::ZERO);
        state.lags.fill(Duration::ZERO);
        worst.filter(|worst| is_slow && state.slow.insert(*worst))
    }

    /// Peers that are newly found to hold up a step for far too long: those that do not take this member's parts, and the one whose parts
    /// it waits for.
    pub(super) fn overdue(&self, others: impl Iterator<Item = usize>, waits_for: Option<usize>) -> Vec<usize> {
        let mut state = lock(&self.state);
        let state = &mut *state;
        let Some(Exchange { begun, alone, .. }) = state.exchange else { return Vec::new() };
        if begun.elapsed() < self.window.max(alone * FAR_OVER) {
            return Vec::new();
        }
        let holds_up = |peer: &usize| {
            let Late { sent, received } = state.late[*peer];
            sent.is_none() || (received.is_none() && waits_for == Some(*peer))
        };
        let late: Vec<usize> = others.filter(holds_up).collect();
        late.into_iter().filter(|peer| state.slow.insert(*peer)).collect()
    }

    /// Who is named.
    pub(super) fn slow(&self) -> BTreeSet<usize> {
        lock(&self.state).slow.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(pace: &Pace, own: Duration, lags: [Duration; 2]) -> Option<usize> {
        pace.begin(own, 4, 8);
        let begun = Instant::now();
        let longest = lags[0].max(lags[1]);
        std::thread::sleep(longest);
        for (peer, lag) in [1, 2].into_iter().zip(lags) {
            pace.received(peer, begun + lag);
            lock(&pace.state).late[peer].sent = Some(Duration::ZERO);
        }
        pace.end([1, 2].into_iter())
    }

    #[test]
    fn the_peer_whose_parts_come_last_is_named_once_steps_are_slower_than_alone() {
        let pace = Pace::new(3, Duration::from_millis(400));
        let ms = Duration::from_millis;
        let named: Vec<usize> = (0..6).filter_map(|_| step(&pace, ms(20), [ms(5), ms(150)])).collect();
        assert_eq!(named, [2], "once");
        assert_eq!(pace.slow(), BTreeSet::from([2]));
        // As long, and worth it: alone it would take twice as long.
        let worth = Pace::new(3, Duration::from_millis(400));
        assert!((0..6).all(|_| step(&worth, ms(400), [ms(5), ms(150)]).is_none()));
    }

    #[test]
    fn a_step_under_way_names_those_that_it_waits_for() {
        let pace = Pace::new(3, Duration::from_millis(50));
        pace.begin(Duration::from_millis(1), 4, 8);
        pace.sent(1);
        pace.received(1, Instant::now());
        pace.sent(2);
        assert_eq!(pace.overdue([1, 2].into_iter(), Some(2)), [0; 0]);
        std::thread::sleep(Duration::from_millis(60));
        assert_eq!(pace.overdue([1, 2].into_iter(), Some(2)), [2]);
        assert_eq!(pace.overdue([1, 2].into_iter(), Some(2)), [0; 0], "once");
        let excused = Pace::new(2, Duration::ZERO);
        excused.begin(Duration::from_millis(1), 4, 8);
        excused.excuse();
        assert_eq!((excused.overdue([1].into_iter(), Some(1)), excused.end([1].into_iter())), (vec![], None));
    }
}
