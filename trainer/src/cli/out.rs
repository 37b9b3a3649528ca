//! `-o` of the commands that write motions.

use std::path::PathBuf;

use mocap::export::{ExportError, Motion, Outs, Written};

use super::remote::check_parent;
use crate::report::print::Output;
use crate::report::problem::{Problem, Result, exit};

/// The value of `-o` that requests a report on standard output instead of a file.
const JSON: &str = "json";

/// Files to write, and the format of the report.
#[derive(Debug, clap::Args)]
pub(super) struct OutArgs {
    /// Output file, may be repeated: `.html` to view motions from all sides, `.gif`, `.mp4` (needs ffmpeg), `.png` for
    /// a sheet of poses, `.bvh` and `.glb` for animation programs, `.npy` for features; `json` prints one line of JSON
    /// per motion on stdout. One `.html` or `.png` holds all motions; other files are numbered
    #[arg(short = 'o', long = "out", value_name = "FILE", required = true)]
    out: Vec<PathBuf>,
    /// Keeps standing feet in place: moves them by at most 15 cm, and the knees follow; an `.npy` then has positions
    #[arg(long)]
    plant_feet: bool,
    /// Format of the report
    #[arg(long, value_enum, default_value_t)]
    report: Output,
}

impl OutArgs {
    /// Format of the report.
    pub(super) fn report(&self) -> Output {
        if self.out.iter().any(|out| out.as_os_str() == JSON) { Output::Json } else { self.report }
    }

    /// Prepares a motion for writing.
    pub(super) fn prepared(&self, motion: Motion) -> Motion {
        if self.plant_feet { motion.planted() } else { motion }
    }

    /// Checks the names of the files for `count` motions, before any is generated.
    ///
    /// # Errors
    /// If a name has no known format, a folder does not exist, a format cannot hold so many motions, or there is no
    /// video encoder.
    pub(super) fn files(&self, count: usize) -> Result<Outs> {
        let files: Vec<PathBuf> = self.out.iter().filter(|out| out.as_os_str() != JSON).cloned().collect();
        let outs = Outs::new(&files, count).map_err(refused)?;
        files.iter().try_for_each(|file| check_parent(file))?;
        Ok(outs)
    }
}

/// Reports errors that a user can correct as wrong usage.
pub(super) fn refused(error: ExportError) -> Problem {
    let code = match error {
        ExportError::Io { .. } | ExportError::Encoder { .. } => exit::FAILED,
        _ => exit::USAGE,
    };
    Problem::new(code, error)
}

/// Paths of written files for a report.
pub(super) fn names(written: &[Written]) -> impl Iterator<Item = String> + '_ {
    written.iter().map(|written| written.path.display().to_string())
}

/// Largest distance in metres of the written skeletons from the motion; `None` without such a file.
pub(super) fn off_metres(written: &[Written]) -> Option<f64> {
    written.iter().filter_map(|written| written.off_metres).reduce(f64::max)
}
