//! Detects that a gang is slower than one of its members alone, and which peer causes it.
//!
//! A member measures the time of its own slices and so estimates the time of all slices. It names a peer if steps take
//! longer than that for a while, or if one step far exceeds it. The named peer is the one whose parts arrived last or
//! that took this member's parts last. Parts of a sum depend only on their sender, and all are sent at once, so a third
//! member that waits for the slow one is not named.

use std::collections::BTreeSet;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::event_count::lock;

/// Factor by which a step of a gang may exceed that of a member alone. A gang must reach at least 0.8 of the member's
/// rate.
const TOLERANCE: f64 = 1.25;
/// Least time by which a step of a gang must exceed a member's own before a peer is named.
const COST: Duration = Duration::from_millis(100);
/// Factor over a member's own time beyond which a single running step is too slow.
const FAR_OVER: u32 = 3;
/// Windows between two exchanges that are excused because of a silence.
const RARELY: u32 = 30;

/// The pace of one generation, measured by one member.
#[derive(Debug)]
pub(crate) struct Pace {
    /// Shortest period that is judged.
    window: Duration,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// The current exchange, unless it is excused.
    exchange: Option<Exchange>,
    /// Times at which each peer's parts were complete, per direction.
    late: Vec<Late>,
    /// Sums over the steps of the window.
    steps: u32,
    took: Duration,
    alone: Duration,
    lags: Vec<Duration>,
    /// Ranks that are named.
    slow: BTreeSet<usize>,
    /// Time at which an exchange was last excused because of a silence.
    silence: Option<Instant>,
}

#[derive(Debug, Clone, Copy)]
struct Exchange {
    begun: Instant,
    /// Time of this member's share.
    own: Duration,
    /// Estimated time of the whole step for this member alone.
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
            silence: None,
        };
        Self { window, state: Mutex::new(state) }
    }

    /// Begins an exchange after `own` was spent on `share` of `slices` slices.
    pub(super) fn begin(&self, own: Duration, share: usize, slices: usize) {
        let mut state = lock(&self.state);
        let state = &mut *state;
        state.late.fill(Late::default());
        // A member without slices cannot estimate.
        state.exchange = (share > 0).then(|| {
            let alone = own.mul_f64(slices as f64 / share as f64);
            Exchange { begun: Instant::now(), own, alone }
        });
    }

    /// Excuses the current exchange, because a member saves or has saved since the last step.
    pub(super) fn excuse(&self) {
        lock(&self.state).exchange = None;
    }

    /// Excuses the current exchange, because a peer is silent. A link that is often silent is slow, so this has an effect
    /// once in [`RARELY`] windows.
    pub(super) fn excuse_silence(&self) {
        let mut state = lock(&self.state);
        let is_rare = state.silence.is_none_or(|at| at.elapsed() > self.window * RARELY);
        if is_rare && state.exchange.take().is_some() {
            state.silence = Some(Instant::now());
        }
    }

    /// Records that all of this member's parts for `peer` are sent.
    pub(super) fn sent(&self, peer: usize) {
        let mut state = lock(&self.state);
        let since = state.exchange.map(|exchange| exchange.begun.elapsed());
        state.late[peer].sent = since;
    }

    /// Records that all of a peer's parts arrived at `at`.
    pub(super) fn received(&self, peer: usize, at: Instant) {
        let mut state = lock(&self.state);
        let since = state.exchange.map(|exchange| at.saturating_duration_since(exchange.begun));
        state.late[peer].received = since;
    }

    /// Ends the exchange. Returns a peer that is newly found too slow.
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

    /// Returns the peers that are newly found to delay the current step for too long. They are the ones that do not
    /// take this member's parts, and the one whose parts it waits for.
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

    /// Ranks that are named.
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
        // Same delay but worthwhile: alone it would take twice as long.
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

    #[test]
    fn a_silence_is_excused_once_in_a_while() {
        let pace = Pace::new(2, Duration::from_millis(10));
        for named in [vec![], vec![1]] {
            pace.begin(Duration::from_millis(1), 4, 8);
            std::thread::sleep(Duration::from_millis(20));
            pace.excuse_silence();
            assert_eq!(pace.overdue([1].into_iter(), Some(1)), named);
        }
    }
}
