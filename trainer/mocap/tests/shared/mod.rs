//! Finds the reference data and measures the distance of a result from it.

#![allow(dead_code, reason = "each test binary uses its own part of this module")]

use motion::DataPath;
use std::fs;
use std::path::{Path, PathBuf};

pub(crate) use fixtures::data;
use motion::npy::{self, Array};
use serde_json::Value;

/// Reads f32 or f64.
pub(crate) fn load(file: &Path) -> Array {
    npy::read_any_float(&DataPath::local(file)).unwrap_or_else(|e| panic!("{e}"))
}

/// Reads a JSON file.
pub(crate) fn json(file: &Path) -> Value {
    let text = fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()))
}

/// Entries of `folder` whose names satisfy `wanted`, sorted.
pub(crate) fn entries(folder: &Path, wanted: impl Fn(&str) -> bool) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap_or_else(|e| panic!("{}: {e}", folder.display()))
        .map(|entry| entry.expect("a folder entry").path())
        .filter(|path| wanted(&path.file_name().expect("a name").to_string_lossy()))
        .collect();
    found.sort();
    found
}

/// The largest absolute difference; infinite if one side is NaN or the lengths differ.
pub(crate) fn worst(found: impl IntoIterator<Item = f64>, expected: &[f32]) -> f64 {
    let found: Vec<f64> = found.into_iter().collect();
    if found.len() != expected.len() {
        return f64::INFINITY;
    }
    let differences = found.iter().zip(expected).map(|(a, b)| (a - f64::from(*b)).abs());
    differences.fold(0.0, |worst, d| if d.is_nan() { f64::INFINITY } else { worst.max(d) })
}
