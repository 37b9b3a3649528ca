//! Changes of course in real motion, for comparison with junctions.

use std::path::Path;

use motion::{DataPath, Skeleton, npy};
use stages::metrics::junction::{Jump, jumps, usual};

use super::report::Real;
use crate::report::problem::{Problem, Result};

/// Limit of clips read from a folder, in the order of its list.
const CLIPS: usize = 256;
/// Limit of a list of clips in bytes.
const LIST_BYTES: u64 = 8 << 20;
/// Least number of boundaries for a meaningful percentile.
const LEAST: usize = 100;

/// Measures a motion, `.npy` as `trainer export` accepts it, or the training clips of a dataset folder.
pub(super) fn read(path: &Path, skeleton: &'static Skeleton) -> Result<Real> {
    let mut all: Vec<Jump> = Vec::new();
    let name = if path.is_dir() {
        let list = path.join("train.txt");
        let bytes = DataPath::local(&list)
            .read(LIST_BYTES)
            .map_err(|error| Problem::usage(format!("`{}`: {error}; expected a dataset folder", list.display())))?;
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let ids = text.lines().map(str::trim).filter(|id| motion::dataset::is_clip_id(id)).take(CLIPS);
        let mut clips = 0;
        for id in ids {
            let file = path.join("new_joint_vecs").join(format!("{id}.npy"));
            // Lists name missing clips, in the published datasets too.
            if file.exists() {
                all.extend(of_file(&file, skeleton)?);
                clips += 1;
            }
        }
        format!("{clips} training clips of {}", path.display())
    } else {
        all = of_file(path, skeleton)?;
        path.display().to_string()
    };
    match usual(&all) {
        Some(usual) if all.len() >= LEAST => Ok(Real { name, usual }),
        _ => Err(Problem::usage(format!(
            "`{}`: jumps can be measured at {} frames only; expected at least {LEAST}, some seconds of motion",
            path.display(),
            all.len()
        ))),
    }
}

fn of_file(file: &Path, skeleton: &'static Skeleton) -> Result<Vec<Jump>> {
    let refuse = |what: String| Problem::usage(format!("`{}`: {what}", file.display()));
    let array = npy::read_any_float(&DataPath::local(file)).map_err(|error| Problem::usage(error.to_string()))?;
    let joints = match array.shape[..] {
        [_, count, 3] if count == skeleton.joints => array.data.iter().map(|v| f64::from(*v)).collect(),
        [_, width] if width == skeleton.features => motion::features::recover_joints_wide(&array.data, skeleton),
        _ => {
            return Err(refuse(format!(
                "has shape {:?}; expected positions [frames, {}, 3] or features [frames, {}]",
                array.shape, skeleton.joints, skeleton.features
            )));
        }
    };
    let metres: Vec<f64> = joints.iter().map(|v| v * skeleton.metres_per_unit).collect();
    Ok(jumps(&metres, skeleton.joints, skeleton.fps)
        .into_iter()
        .filter(|jump| jump.velocity.is_finite() && jump.acceleration.is_finite())
        .collect())
}
