//! The mean of repeated measurements with its 95% interval, as the papers print it: `mean ± 1.96 sd / sqrt(n)`, with
//! the standard deviation that divides by n.

use serde::{Deserialize, Serialize};

/// Half width of the 95% interval of a standard normal, in deviations.
const NORMAL_95: f64 = 1.96;

/// A mean with its confidence interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Mean of the repeats.
    pub mean: f64,
    /// Half the width of the interval; 0 for a single repeat, whose spread is unknown.
    pub half: f64,
}

impl Interval {
    /// Computes the interval from the values of all repeats.
    ///
    /// # Panics
    /// If there are none.
    pub fn of(values: &[f64]) -> Self {
        assert!(!values.is_empty(), "an interval needs a value");
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        Self { mean, half: NORMAL_95 * (variance / n).sqrt() }
    }

    /// Lower end of the interval.
    pub fn lower(self) -> f64 {
        self.mean - self.half
    }

    /// Upper end of the interval.
    pub fn upper(self) -> f64 {
        self.mean + self.half
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_is_that_of_the_papers() {
        let found = Interval::of(&[1.0, 2.0, 3.0, 4.0]);
        assert_eq!(found.mean, 2.5);
        assert!((found.half - 1.96 * 1.25_f64.sqrt() / 2.0).abs() < 1e-12);
        assert!((found.upper() - found.lower() - 2.0 * found.half).abs() < 1e-12);
        assert_eq!(Interval::of(&[3.0]), Interval { mean: 3.0, half: 0.0 });
    }
}
