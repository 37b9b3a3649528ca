//! `data.open` and `data.synthetic`: stores a dataset as an artifact.
//!
//! Files: those of [`Dataset::write_files`], and `report.txt`, which lists every clip and caption left out with its
//! reason.

use std::cell::RefCell;
use std::collections::BTreeMap;

use motion::Dataset;
use motion::dataset::{OpenReport, PackError, Split};
use protocol::ArtifactKind;
use protocol::stage::{DataFormat, DataOpen, DataSynthetic};

use super::Plain;
use crate::artifacts::{DatasetMeta, Draft, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::external;

/// The file that lists the clips and captions left out.
const REPORT_FILE: &str = "report.txt";

impl Plain for DataOpen {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let opened = external::read(cx, |cx, given| {
            let opened = Dataset::open_while(given.path("path")?, self.format, &|_| !cx.interrupted());
            opened.map_err(|e| StageError::Input(e.to_string()))
        })?;
        let Some((dataset, report)) = opened else { return Ok(Outcome::Yielded { at: 0 }) };
        log_report(cx, &report);
        pack(cx, &dataset, report.skips.len(), report.to_string(), vec![])
    }
}

/// Logs a line for each clip left out, and the totals.
fn log_report(cx: &mut dyn AttemptContext, report: &OpenReport) {
    for skip in &report.skips {
        cx.log(&format!("skipped {skip}, {}: {}", skip.split, skip.reason.heading()));
    }
    if !report.shared.is_empty() {
        cx.log(&format!("warning: clips in more than one split: {}", report.shared.join(", ")));
    }
}

impl Plain for DataSynthetic {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        if self.clips == 0 {
            return Err(StageError::Input("`clips` is 0; expected at least 1".into()));
        }
        let (seed, clips) = (cx.task().seed, self.clips as u64);
        let world = RefCell::new(&mut *cx);
        let go_on = |made: usize| {
            let mut cx = world.borrow_mut();
            cx.progress(made as u64, clips, "clips", &[]);
            !cx.interrupted()
        };
        let made = motion::synthetic::generate_while(self, seed, &go_on);
        let Some(dataset) = made else { return Ok(Outcome::Yielded { at: 0 }) };
        let text = format!("made by the program: {} clips, {} captions\n", dataset.clips.len(), dataset.captions.len());
        pack(cx, &dataset, 0, text, vec![])
    }
}

/// An additional file of a dataset.
pub(super) type Extra = (&'static str, Vec<u8>);

/// Uploads a dataset with its report and additional files.
pub(super) fn pack(
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
