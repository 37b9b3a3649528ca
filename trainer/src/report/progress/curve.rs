//! Progress of one stage: its rate, its remaining time, and its loss as a row of blocks.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Period over which a rate is computed.
const RECENT: Duration = Duration::from_secs(20);
/// Shortest period for a rate.
const SHORTEST: Duration = Duration::from_secs(1);
/// Width of a sparkline.
const CELLS: usize = 16;
const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// Reported progress of a stage.
#[derive(Debug, Default)]
pub(super) struct Curve {
    /// Recent counts, for rates.
    recent: VecDeque<(Instant, u64)>,
    /// Means of the loss over periods of equal length, at most twice [`CELLS`].
    losses: Vec<f64>,
    /// Reports per period of `losses`, and the sum and count of the current period.
    stretch: usize,
    open: (f64, usize),
}

impl Curve {
    /// Adds the count `done` at time `now`. An unchanged count is ignored; a falling one starts a new period.
    pub(super) fn push(&mut self, now: Instant, done: u64, loss: Option<f64>) {
        match self.recent.back() {
            Some((_, before)) if *before == done => return,
            Some((_, before)) if *before > done => self.recent.clear(),
            _ => {}
        }
        self.recent.push_back((now, done));
        // One older count stays, so that slow work has a rate too.
        while self.recent.get(1).is_some_and(|(at, _)| now - *at > RECENT) {
            self.recent.pop_front();
        }
        if let Some(loss) = loss.filter(|loss| loss.is_finite()) {
            self.add(loss);
        }
    }

    fn add(&mut self, loss: f64) {
        self.open = (self.open.0 + loss, self.open.1 + 1);
        if self.open.1 < self.stretch.max(1) {
            return;
        }
        self.losses.push(self.open.0 / self.open.1 as f64);
        self.open = (0.0, 0);
        if self.losses.len() >= 2 * CELLS {
            self.losses = self.losses.chunks(2).map(|pair| pair.iter().sum::<f64>() / pair.len() as f64).collect();
            self.stretch = 2 * self.stretch.max(1);
        }
    }

    /// Forgets the losses, because the loss changes its meaning from now on.
    pub(super) fn forget_losses(&mut self) {
        (self.losses, self.stretch, self.open) = (Vec::new(), 1, (0.0, 0));
    }

    /// Recent counts per second.
    pub(super) fn rate(&self, now: Instant) -> Option<f64> {
        let (since, first) = self.recent.front()?;
        let (_, last) = self.recent.back()?;
        let time = now - *since;
        let done = last - first;
        (time >= SHORTEST && done > 0).then(|| done as f64 / time.as_secs_f64())
    }

    /// The losses from first to last; the lowest block is the lowest loss. Logarithmic if all are positive.
    pub(super) fn sparkline(&self) -> String {
        let rest = (self.open.1 > 0).then(|| self.open.0 / self.open.1 as f64);
        let losses: Vec<f64> = self.losses.iter().copied().chain(rest).collect();
        if losses.len() < 3 {
            return String::new();
        }
        let positive = losses.iter().all(|loss| *loss > 0.0);
        let scaled: Vec<f64> = losses.iter().map(|loss| if positive { loss.ln() } else { *loss }).collect();
        let cells: Vec<f64> = match scaled.len().div_ceil(CELLS) {
            0 | 1 => scaled,
            each => scaled.chunks(each).map(|cell| cell.iter().sum::<f64>() / cell.len() as f64).collect(),
        };
        let low = cells.iter().copied().fold(f64::INFINITY, f64::min);
        let high = cells.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let block = |value: &f64| {
            let height = if high > low { (value - low) / (high - low) } else { 0.0 };
            BLOCKS[(height * 7.0).round() as usize]
        };
        cells.iter().map(block).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(counts: &[(u64, u64)]) -> (Curve, Instant) {
        let start = Instant::now();
        let mut curve = Curve::default();
        for (second, done) in counts {
            curve.push(start + Duration::from_secs(*second), *done, None);
        }
        (curve, start)
    }

    #[test]
    fn a_rate_is_that_of_the_last_seconds_and_of_the_present_attempt() {
        let (steady, start) = curve(&[(0, 100), (10, 200)]);
        assert_eq!(steady.rate(start + Duration::from_secs(10)), Some(10.0));
        let (slower, start) = curve(&[(0, 0), (10, 1000), (40, 1030), (60, 1050)]);
        assert_eq!(slower.rate(start + Duration::from_secs(60)), Some(1.0), "what was long ago does not count");
        let (resumed, start) = curve(&[(0, 80), (5, 40), (15, 60)]);
        assert_eq!(resumed.rate(start + Duration::from_secs(15)), Some(2.0), "an attempt that goes back counts anew");
        let (first, start) = curve(&[(3, 7_000_000)]);
        assert_eq!(first.rate(start + Duration::from_secs(3)), None, "one report has no rate");
        let (burst, start) = curve(&[(0, 1), (0, 900)]);
        assert_eq!(burst.rate(start + Duration::from_millis(1)), None, "a burst has no rate");
    }

    #[test]
    fn a_falling_loss_is_a_falling_line_of_a_bounded_width() {
        let now = Instant::now();
        let mut curve = Curve::default();
        assert_eq!(curve.sparkline(), "");
        for step in 1..=8 {
            curve.push(now, step, Some(f64::from(9 - step as u32)));
        }
        let line: Vec<char> = curve.sparkline().chars().collect();
        assert_eq!((line.len(), line[0], line[7]), (8, '█', '▁'));
        for step in 9..5000 {
            curve.push(now, step, Some(1.0 / step as f64));
            assert!(curve.sparkline().chars().count() <= CELLS, "at step {step}");
        }
        let line: Vec<char> = curve.sparkline().chars().collect();
        assert!(line.windows(2).all(|pair| pair[0] >= pair[1]), "{line:?}");
        curve.forget_losses();
        assert_eq!(curve.sparkline(), "");
        curve.push(now, 5000, Some(f64::NAN));
        assert_eq!(curve.sparkline(), "");
    }
}
