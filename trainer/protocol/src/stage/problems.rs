//! Violated rules of a stage, collected by its checks.

use crate::limits;

/// A violated rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Field as a path inside the stage; empty for the stage itself.
    pub field: String,
    /// Mistake and expected value.
    pub message: String,
    /// Remedy, if there is one.
    pub help: Option<String>,
}

/// Problems of one stage, in the order in which they were found.
#[derive(Debug, Default)]
pub struct Problems(pub Vec<Problem>);

impl Problems {
    /// Adds a problem; an empty `help` means none.
    pub fn add(&mut self, field: &str, message: impl Into<String>, help: &str) {
        let help = (!help.is_empty()).then(|| help.to_owned());
        self.0.push(Problem { field: field.to_owned(), message: message.into(), help });
    }

    pub(crate) fn positive(&mut self, field: &str, value: usize) {
        if value == 0 {
            self.add(field, format!("`{field}` is 0; expected at least 1"), "");
        }
    }

    pub(crate) fn above_zero(&mut self, field: &str, value: f64) {
        if !(value > 0.0 && value.is_finite()) {
            self.add(field, format!("`{field}` is {value}; expected a number above 0"), "");
        }
    }

    pub(crate) fn not_negative(&mut self, field: &str, value: f64) {
        if !(value >= 0.0 && value.is_finite()) {
            self.add(field, format!("`{field}` is {value}; expected 0 or more"), "");
        }
    }

    /// Requires 0 <= value <= 1, or < 1 if `open`.
    pub(crate) fn fraction(&mut self, field: &str, value: f64, open: bool) {
        let fits = value >= 0.0 && if open { value < 1.0 } else { value <= 1.0 };
        if !fits {
            let range = if open { "at least 0 and below 1" } else { "between 0 and 1" };
            self.add(field, format!("`{field}` is {value}; expected {range}"), "");
        }
    }

    /// Checks the number of shards of a map stage.
    pub(crate) fn shards(&mut self, shards: usize) {
        if !(1..=limits::SHARDS).contains(&(shards as u64)) {
            self.add("shards", format!("`shards` is {shards}; expected 1 to {}", limits::SHARDS), "");
        }
    }

    /// Limits the product of `factors`, which are all in memory at once.
    pub(crate) fn product(&mut self, field: &str, factors: &[(&str, usize)], most: usize) {
        let product = factors.iter().fold(1_usize, |product, (_, factor)| product.saturating_mul(*factor));
        // A factor that is out of range is reported at its own field.
        if product > most && factors.iter().all(|(_, factor)| *factor <= most) {
            let names = factors.iter().map(|(name, _)| format!("`{name}`")).collect::<Vec<_>>().join(" x ");
            self.add(field, format!("{names} is {product}; expected at most {most}"), "");
        }
    }
}
