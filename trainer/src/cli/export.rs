//! `trainer export`: converts the motion of an array or a recording to another format.

use std::path::PathBuf;

use clap::Args;
use mocap::detect::Up;
use mocap::export::Motion;
use mocap::joint_map::JointMap;
use mocap::take::Reading;
use serde_json::json;

use super::out::{self, OutArgs};
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

#[derive(Debug, Args)]
pub(crate) struct ExportArgs {
    /// Motions: `.npy` with features [frames, 263 or 251] or positions [frames, 22 or 21, 3], or recordings, `.bvh`
    #[arg(required = true, value_name = "FILE")]
    input: Vec<PathBuf>,
    #[command(flatten)]
    out: OutArgs,
    /// Title of pictures and pages [default: the file's name]
    #[arg(long, value_name = "TEXT")]
    caption: Option<String>,
    /// Joint map of a recording: the name of a shipped map, or a file [default: detected from the names of the joints]
    #[arg(long, value_name = "MAP")]
    joint_map: Option<String>,
    /// Metres per unit of a recording [default: detected from the length of its legs]
    #[arg(long, value_name = "METRES")]
    unit: Option<f64>,
    /// Vertical axis of a recording: x, y, z, -x, -y or -z [default: the direction from the ankles to the neck]
    #[arg(long, value_name = "AXIS", value_parser = up, allow_hyphen_values = true)]
    up: Option<Up>,
}

fn up(word: &str) -> std::result::Result<Up, String> {
    Up::parse(word).ok_or_else(|| "expected x, y, z, -x, -y or -z".to_owned())
}

impl ExportArgs {
    /// Format of the report.
    pub(super) fn report(&self) -> Output {
        self.out.report()
    }

    fn reading(&self) -> Result<Reading> {
        let map = self.joint_map.as_deref().map(JointMap::load).transpose().map_err(Problem::usage)?;
        if let Some(unit) = self.unit.filter(|unit| !(unit.is_finite() && *unit > 0.0)) {
            return Err(Problem::usage(format!("`--unit {unit}`: expected metres above 0")));
        }
        Ok(Reading { map, metres_per_unit: self.unit, up: self.up })
    }
}

pub(crate) fn export(args: &ExportArgs) -> Result<u8> {
    let outs = args.out.files(args.input.len())?;
    let reading = args.reading()?;
    let (mut motions, mut lines) = (Vec::new(), Vec::new());
    for (i, file) in args.input.iter().enumerate() {
        let mut motion = args.out.prepared(Motion::read(file, &reading).map_err(out::refused)?);
        if let Some(caption) = &args.caption {
            motion.caption.clone_from(caption);
        }
        let written = outs.write(i + 1, &motion).map_err(out::refused)?;
        lines.push((file, motion.frames(), motion.note.clone(), written));
        if outs.wants_all() {
            motions.push(motion);
        }
    }
    let title = match motions.as_slice() {
        [motion] => motion.caption.clone(),
        motions => format!("{} motions", motions.len()),
    };
    let together = outs.finish(&title, &[(String::new(), motions.iter().collect())]).map_err(out::refused)?;
    for (file, frames, said, written) in lines {
        let files: Vec<String> = out::names(&written).chain(out::names(&together)).collect();
        let off = out::off_metres(&written);
        match args.report() {
            Output::Json => print::out(
                &json!({
                    "schema_version": 1,
                    "file": file.display().to_string(),
                    "frames": frames,
                    "read_as": said,
                    "files": files,
                    "skeleton_error_m": off,
                })
                .to_string(),
            ),
            Output::Table => {
                let said = if said.is_empty() { said } else { format!("; {said}") };
                let off = off
                    .map(|off| format!("; joints are up to {:.2} mm off, because bones keep their lengths", 1e3 * off));
                let off = off.unwrap_or_default();
                print::out(&format!("{} from {}: {frames} frames{said}{off}", files.join(", "), file.display()));
            }
        }
    }
    Ok(0)
}
