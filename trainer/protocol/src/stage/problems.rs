//! Violated rules of a stage, collected by its checks.

use crate::limits;

/// Frames of a token of every published tokenizer.
const FRAMES_A_TOKEN: usize = 4;

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

    pub(crate) fn above_zero(&mut self, field: &str, value: f64) {
        if value <= 0.0 {
            self.add(field, format!("`{field}` is {value}; expected a number above 0"), "");
        }
    }

    pub(crate) fn not_negative(&mut self, field: &str, value: f64) {
        if !(value >= 0.0 && value.is_finite()) {
            self.add(field, format!("`{field}` is {value}; expected 0 or more"), "");
        }
    }

    /// Requires the smaller number of a range first.
    pub(crate) fn ascending(&mut self, field: &str, range: (f64, f64)) {
        let (low, high) = range;
        if low > high {
            self.add(field, format!("`{field}` is [{low}, {high}]; expected the smaller number first"), "");
        }
    }

    /// Requires a number of frames that tokens of four frames fill.
    pub(crate) fn whole_tokens(&mut self, field: &str, frames: usize) {
        if !frames.is_multiple_of(FRAMES_A_TOKEN) {
            let message = format!("`{field}` is {frames}; expected a multiple of {FRAMES_A_TOKEN}");
            self.add(field, message, "a token stands for 4 frames");
        }
    }

    /// Requires a solver's step that divides the 1000 timesteps.
    pub(crate) fn divides_timesteps(&mut self, field: &str, skip: usize, help: &str) {
        if skip == 0 || !1000_usize.is_multiple_of(skip) {
            self.add(field, format!("`{field}` is {skip}; expected a divisor of the 1000 timesteps"), help);
        }
    }

    /// Requires attention heads of equal width; `heads` and `width` are the fields' paths.
    pub(crate) fn equal_heads(&mut self, heads: &str, count: usize, width: &str, channels: usize) {
        if count > 0 && !channels.is_multiple_of(count) {
            let message = format!("`{heads}` is {count}, which does not divide `{width}` ({channels})");
            self.add(heads, message, "");
        }
    }

    /// Limits the parameters of `network`; `count` is a lower estimate.
    pub(crate) fn parameters(&mut self, count: usize) {
        if count > limits::PARAMETERS {
            let message =
                format!("the network has at least {count} parameters; expected at most {}", limits::PARAMETERS);
            self.add("network", message, "use fewer or narrower layers");
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
