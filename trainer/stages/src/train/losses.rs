//! The loss of a slice as a sum of named terms with weights.

use burn::tensor::Tensor;

/// Terms may be added in any order. Their names and weights decide the recorded values and the training loss.
#[derive(Debug)]
pub struct Losses {
    global: f32,
    total: Option<Tensor<1>>,
    terms: Vec<(&'static str, f32)>,
}

impl Losses {
    /// Name of the total loss in records.
    pub const TOTAL: &'static str = "loss";

    /// Starts without terms, for a slice of a batch of `global` examples.
    pub fn new(global: usize) -> Self {
        Self { global: global as f32, total: None, terms: Vec::new() }
    }

    /// Adds `weight` times `sum`, the term's sum over the slice's examples. The value recorded as `name` is without the
    /// weight.
    pub fn add(&mut self, name: &'static str, sum: Tensor<1>, weight: f64) {
        let mean = sum / self.global;
        self.note(name, mean.clone().inner().into_scalar::<f32>());
        let weighted = if weight == 1.0 { mean } else { mean * weight as f32 };
        self.total = Some(match self.total.take() {
            Some(total) => total + weighted,
            None => weighted,
        });
    }

    /// Records a value that is not part of the loss; it must already be divided by the batch.
    pub fn note(&mut self, name: &'static str, value: f32) {
        self.terms.push((name, value));
    }

    /// The loss to train on; `None` without terms.
    pub fn total(&self) -> Option<Tensor<1>> {
        self.total.clone()
    }

    /// The values of `names`, in order: the total for [`TOTAL`](Self::TOTAL), 0 for a term that this slice does not
    /// have.
    pub fn values(&self, names: &[&'static str]) -> Vec<f32> {
        let total = || self.total.as_ref().map_or(0.0, |total| total.clone().inner().into_scalar::<f32>());
        let value = |name: &&'static str| {
            let found = self.terms.iter().find(|(known, _)| known == name).map(|(_, value)| *value);
            found.unwrap_or_else(|| if *name == Self::TOTAL { total() } else { 0.0 })
        };
        names.iter().map(value).collect()
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    #[test]
    fn terms_are_weighted_in_the_total_and_recorded_as_they_are() {
        let device = Device::flex().autodiff();
        let x = Tensor::<1>::from_floats([3.0], &device).require_grad();
        let mut losses = Losses::new(2);
        losses.add("first", x.clone() * 2.0, 1.0);
        losses.add("second", x.clone().square(), 0.5);
        losses.note("seen", 7.0);
        assert_eq!(losses.values(&["loss", "second", "first", "seen", "absent"]), [5.25, 4.5, 3.0, 7.0, 0.0]);
        let gradient = x.grad(&losses.total().unwrap().backward()).unwrap().into_scalar::<f32>();
        assert_eq!(gradient, 1.0 + 0.5 * 3.0);
        assert!(Losses::new(1).total().is_none());
    }
}
