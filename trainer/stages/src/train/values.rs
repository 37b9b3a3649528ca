//! The values that every training records besides its own terms, and the means of the newest ones.

use std::collections::BTreeMap;

/// A value that every training records besides its own terms.
pub(super) const GRADIENT_NORM: &str = "gradient_norm";
pub(super) const LEARNING_RATE: &str = "lr";

/// True for steps whose values are recorded: the first 2,000 steps of a stage, then every tenth, and the last.
pub(super) fn due(step: u64, steps: u64) -> bool {
    step <= 2000 || step.is_multiple_of(10) || step == steps
}

/// Running means of the newest values.
#[derive(Debug, Default)]
pub(super) struct Recent {
    rows: std::collections::VecDeque<Vec<(String, f64)>>,
}

impl Recent {
    const LEN: usize = 100;

    pub(super) fn push(&mut self, values: &[(&str, f64)]) {
        if self.rows.len() == Self::LEN {
            self.rows.pop_front();
        }
        self.rows.push_back(values.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect());
    }

    #[expect(clippy::cast_precision_loss, reason = "at most a hundred rows")]
    pub(super) fn means(&self) -> BTreeMap<String, f64> {
        let mut sums: BTreeMap<String, f64> = BTreeMap::new();
        for (key, value) in self.rows.iter().flatten() {
            *sums.entry(key.clone()).or_default() += value;
        }
        let count = self.rows.len().max(1) as f64;
        sums.into_iter().map(|(key, sum)| (key, sum / count)).collect()
    }
}
