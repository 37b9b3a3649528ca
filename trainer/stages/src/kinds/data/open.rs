//! `data.open`: stores a dataset as an artifact. A file lists every clip and caption left out with its reason.

use motion::Dataset;
use motion::dataset::OpenReport;
use protocol::stage::DataOpen;

use crate::context::{AttemptContext, Outcome, StageError};
use crate::dataset::pack;
use crate::external;
use crate::kinds::shape::Plain;

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
