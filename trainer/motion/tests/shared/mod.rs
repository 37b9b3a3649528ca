//! Finds the reference data and prints the distance of a result from it.

#![allow(dead_code, unused_imports, reason = "each test binary uses its own part of this module")]

use motion::DataPath;
use std::fs;
use std::path::{Path, PathBuf};

pub(crate) use fixtures::data;
use motion::npy::{self, Array};

/// Reads f32 or f64.
pub(crate) fn load(file: &Path) -> Array {
    npy::read_any_float(&DataPath::local(file)).unwrap_or_else(|e| panic!("{e}"))
}

/// Folders in `folder`, sorted by name.
pub(crate) fn folders(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap_or_else(|e| panic!("{}: {e}", folder.display()))
        .map(|entry| entry.expect("a folder entry").path())
        .filter(|path| path.is_dir())
        .collect();
    found.sort();
    found
}

/// The largest absolute difference; infinite if one side is NaN or the lengths differ.
pub(crate) fn worst(found: impl IntoIterator<Item = f64>, expected: impl IntoIterator<Item = f64>) -> f64 {
    let (found, expected): (Vec<f64>, Vec<f64>) = (found.into_iter().collect(), expected.into_iter().collect());
    if found.len() != expected.len() {
        return f64::INFINITY;
    }
    let differences = found.iter().zip(&expected).map(|(a, b)| (a - b).abs());
    differences.fold(0.0, |worst, d| if d.is_nan() { f64::INFINITY } else { worst.max(d) })
}

/// f32 values as f64.
pub(crate) fn wide(values: &[f32]) -> impl Iterator<Item = f64> + '_ {
    values.iter().map(|v| f64::from(*v))
}
