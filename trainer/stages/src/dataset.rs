//! Storing a dataset as an artifact.
//!
//! Files: those of [`Dataset::write_files`], and `report.txt`, which lists every clip and caption left out with its
//! reason.

use std::collections::BTreeMap;

use motion::Dataset;
use motion::dataset::{PackError, Split};
use protocol::ArtifactKind;
use protocol::stage::DataFormat;

use crate::artifacts::{DatasetMeta, Draft, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};

/// The file that lists the clips and captions left out.
const REPORT_FILE: &str = "report.txt";

/// The file with the recording of each clip, for `data.fold`.
pub(crate) const SOURCES_FILE: &str = "sources.json";

/// An additional file of a dataset.
pub(crate) type Extra = (&'static str, Vec<u8>);

/// Uploads a dataset with its report and additional files.
pub(crate) fn pack(
    cx: &mut dyn AttemptContext,
    dataset: &Dataset,
    skipped: usize,
    report: String,
    extras: Vec<Extra>,
) -> Result<Outcome, StageError> {
    let meta = DatasetMeta {
        format: dataset.format,
        clips: dataset.clips.len(),
        captions: dataset.captions.len(),
        entries: dataset.entries.len(),
        frames: dataset.clips.iter().map(|c| c.frames).sum(),
        skipped,
    };
    cx.log(&summary(dataset, &meta));
    let metrics = [("clips", meta.clips), ("captions", meta.captions), ("frames", meta.frames), ("skipped", skipped)]
        .into_iter()
        .map(|(name, count)| (name.to_owned(), count as f64))
        .collect::<BTreeMap<_, _>>();

    let mut draft = Draft::new(cx, ArtifactKind::Dataset, to_meta(&meta));
    draft.add(REPORT_FILE, report.into_bytes())?;
    for (name, bytes) in extras {
        draft.add(name, bytes)?;
    }
    let written = dataset.write_files::<Failure>(|name, bytes| {
        if cx.interrupted() {
            return Err(Failure::Interrupted);
        }
        draft.add(&name, bytes).map_err(Failure::Store)
    });
    match written {
        Ok(()) => {}
        Err(Failure::Interrupted) => return Ok(Outcome::Yielded { at: 0 }),
        Err(Failure::Store(error)) => return Err(error),
        Err(Failure::Pack(error)) => return Err(StageError::Fault(error.to_string())),
    }
    Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
}

/// An error that prevented a file from being stored.
enum Failure {
    Interrupted,
    Store(StageError),
    Pack(PackError),
}

impl From<PackError> for Failure {
    fn from(error: PackError) -> Self {
        Self::Pack(error)
    }
}

fn summary(dataset: &Dataset, meta: &DatasetMeta) -> String {
    let count = |split: Split| dataset.entries.iter().filter(|e| e.split == split).count();
    let format = match meta.format {
        DataFormat::Humanml3d => "humanml3d",
        DataFormat::Kit => "kit",
    };
    format!(
        "{format}: {} clips ({:.1} minutes), {} captions, entries {} train, {} val, {} test; {} left out",
        meta.clips,
        meta.frames as f64 / dataset.skeleton().fps / 60.0,
        meta.captions,
        count(Split::Train),
        count(Split::Val),
        count(Split::Test),
        meta.skipped
    )
}
