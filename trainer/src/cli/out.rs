//! `-o` of the commands that write motions.

use std::path::PathBuf;

use mocap::export::{ExportError, Motion, Outs, Written};

use super::remote::check_parent;
use crate::print::Output;
use crate::problem::{Problem, Result, exit};

/// The word that stands for a report on standard output in place of a file.
const JSON: &str = "json";

/// Files to write, and how to report.
#[derive(Debug, clap::Args)]
pub(super) struct OutArgs {
    /// Where to write, may be repeated: `.html` to look at motions from all sides, `.gif`, `.mp4` (with an ffmpeg on this machine), `.png` for a sheet of poses, `.bvh` and
    /// `.glb` for animation programs, `.npy` for features; `json` for a line of JSON a motion on stdout. Of several motions all are in one `.html` or `.png`, and
    /// every other file gets their numbers
    #[arg(short = 'o', long = "out", value_name = "FILE", required = true)]
    out: Vec<PathBuf>,
    /// Keeps feet that stand where they stand: moves them by 15 cm at most, the knees follow; an `.npy` then has positions
    #[arg(long)]
    plant_feet: bool,
    /// How the report is printed
    #[arg(long, value_enum, default_value_t)]
    report: Output,
}

impl OutArgs {
    /// How the report is printed.
    pub(super) fn report(&self) -> Output {
        if self.out.iter().any(|out| out.as_os_str() == JSON) { Output::Json } else { self.report }
    }

    /// A motion as it is to be written.
    pub(super) fn prepared(&self, motion: Motion) -> Motion {
        if self.plant_feet { motion.planted() } else { motion }
    }

    /// The files for `count` motions, before anything is drawn.
    ///
    /// # Errors
    /// A name that says no form, a folder that is not there, more motions than a form holds, no encoder of video.
    pub(super) fn files(&self, count: usize) -> Result<Outs> {
        let files: Vec<PathBuf> = self.out.iter().filter(|out| out.as_os_str() != JSON).cloned().collect();
        let outs = Outs::new(&files, count).map_err(refused)?;
        files.iter().try_for_each(|file| check_parent(file))?;
        Ok(outs)
    }
}

/// What a user can do something about is wrong usage.
pub(super) fn refused(error: ExportError) -> Problem {
    let code = match error {
        ExportError::Io { .. } | ExportError::Encoder { .. } => exit::FAILED,
        _ => exit::USAGE,
    };
    Problem::new(code, error)
}

/// Names of files for a report.
pub(super) fn names(written: &[Written]) -> impl Iterator<Item = String> + '_ {
    written.iter().map(|written| written.path.display().to_string())
}

/// Metres by which the skeletons of some files are off the motion at most; `None` without such a file.
pub(super) fn off_metres(written: &[Written]) -> Option<f64> {
    written.iter().filter_map(|written| written.off_metres).reduce(f64::max)
}
