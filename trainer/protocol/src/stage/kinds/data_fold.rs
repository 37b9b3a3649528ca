//! `data.fold`: a dataset with another validation split, for cross-validation. Source: ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Output, Problems, Ref, Shape, StageSpec};

/// `data.fold`: divides the train and validation clips of a dataset into folds and holds one of them out for validation.
/// The test split stays. Clips of one recording are in one fold.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DataFold {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Number of folds.
    #[schemars(range(min = 2, max = 100), extend("x-unit" = "folds"))]
    pub folds: usize,
    /// The fold that is held out, from 1. With 0 the stage exists once for each fold, as `NAME_1`, `NAME_2` and so on,
    /// and so do the stages that read it.
    #[schemars(range(min = 0, max = 100))]
    pub fold: usize,
}

impl Default for DataFold {
    fn default() -> Self {
        Self { dataset: "dataset".into(), folds: 5, fold: 0 }
    }
}

impl StageSpec for DataFold {
    const KIND: &'static str = "data.fold";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "dataset", kind: ArtifactKind::Dataset };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset)]
    }

    fn check(&self, p: &mut Problems) {
        if self.fold > self.folds {
            let message = format!("`fold` is {}, but there are {} folds", self.fold, self.folds);
            p.add("fold", message, "0 makes one stage for each fold");
        }
    }
}
