//! Means and deviations of published training data, as numpy files.

use motion::{DataPath, npy};

use crate::context::StageError;

/// Reads a statistic of a folder: the first existing file of `names`, with `len` finite numbers.
fn statistic(folder: &DataPath, names: [&str; 2], len: usize) -> Result<Vec<f32>, StageError> {
    let refuse = |what: String| StageError::Input(format!("{}: {what}", folder.display()));
    let file = names.iter().map(|name| folder.join(name)).find(DataPath::has_entry);
    let file = file.ok_or_else(|| refuse(format!("the folder has no `{}`", names.join("` or `"))))?;
    let array = npy::read_any_float(&file).map_err(|e| StageError::Input(e.to_string()))?;
    let refuse = |what: String| StageError::Input(format!("{}: {what}", file.display()));
    if array.data.len() != len {
        return Err(refuse(format!("has shape {:?}; expected {len} numbers", array.shape)));
    }
    if let Some(i) = array.data.iter().position(|v| !v.is_finite()) {
        return Err(refuse(format!("value {i} is {}; expected a finite number", array.data[i])));
    }
    Ok(array.data)
}

/// Reads mean and deviation from a folder.
pub(super) fn statistics(
    folder: &DataPath,
    names: [[&str; 2]; 2],
    len: usize,
) -> Result<(Vec<f32>, Vec<f32>), StageError> {
    let mean = statistic(folder, names[0], len)?;
    let std = statistic(folder, names[1], len)?;
    if let Some(i) = std.iter().position(|s| *s <= 0.0) {
        return Err(StageError::Input(format!(
            "{}: {}: value {i} is {}; expected a number above 0",
            folder.display(),
            names[1][0],
            std[i]
        )));
    }
    Ok((mean, std))
}

/// File names of the statistics of features.
pub(super) const FEATURES: [[&str; 2]; 2] = [["mean.npy", "Mean.npy"], ["std.npy", "Std.npy"]];
/// File names of the statistics of joints.
pub(super) const JOINTS: [[&str; 2]; 2] = [["Mean_raw.npy", "mean_raw.npy"], ["Std_raw.npy", "std_raw.npy"]];
