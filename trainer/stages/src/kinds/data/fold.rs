//! `data.fold`: stores a dataset again with another validation split. Only the index differs; the clips are shared.

use std::collections::BTreeMap;

use motion::Dataset;
use motion::dataset::{Fold, INDEX};
use protocol::ArtifactKind;
use protocol::stage::DataFold;

use crate::artifacts::{self, Draft};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::dataset::SOURCES_FILE;
use crate::kinds::shape::Plain;

impl Plain for DataFold {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let blobs = cx.blobs();
        let index = artifacts::file(&*blobs, &manifest, INDEX)?;
        let sources: BTreeMap<String, String> = match manifest.files.contains_key(SOURCES_FILE) {
            true => serde_json::from_slice(&artifacts::file(&*blobs, &manifest, SOURCES_FILE)?)
                .map_err(|e| StageError::Fault(format!("{SOURCES_FILE}: {e}")))?,
            false => BTreeMap::new(),
        };
        let fold = Fold { seed: cx.task().seed, sources: &sources, folds: self.folds, fold: self.fold };
        let divided = Dataset::divided(&index, &fold).map_err(|e| StageError::Input(e.to_string()))?;
        cx.log(&format!(
            "fold {} of {}: {} entries train, {} val, {} test",
            self.fold, self.folds, divided.counts[0], divided.counts[1], divided.counts[2]
        ));
        let names = ["train", "val", "test"].map(str::to_owned);
        let metrics = names.into_iter().zip(divided.counts.map(|count| count as f64)).collect();
        let mut draft = Draft::again(cx, &manifest);
        draft.add(INDEX, divided.index)?;
        Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
    }
}
