//! Finds, reads and compares the fixtures.
#![allow(
    dead_code,
    unused_imports,
    unreachable_pub,
    reason = "each test binary compiles its own copy and uses a part of it"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub use fixtures::{data as shared, folders, golden};

use burn::tensor::{Device, Tensor, TensorData};
use protocol::stage::Backend;
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// The backend of the tests: `STRIDE_TEST_BACKEND`, or flex.
fn backend() -> Backend {
    let name = std::env::var("STRIDE_TEST_BACKEND").unwrap_or_else(|_| "flex".to_owned());
    serde_json::from_value(Value::String(name)).expect("STRIDE_TEST_BACKEND is flex, ndarray, wgpu or cuda")
}

/// The first device of that backend, without autodiff.
pub fn device() -> Device {
    models::device::open(backend(), 0).unwrap_or_else(|e| panic!("{e}"))
}

/// The first device of that backend, with autodiff.
pub fn tracked() -> Device {
    device().autodiff()
}

/// Factor on gates. They hold for flex; the README of the fixtures allows at least five times as much for other
/// summation orders.
fn slack() -> f64 {
    if backend() == Backend::Flex { 1.0 } else { 5.0 }
}

pub fn name(path: &Path) -> String {
    path.file_name().expect("a folder has a name").to_string_lossy().into_owned()
}

pub fn json(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("cannot read {}: {e}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{} is not JSON: {e}", path.display()))
}

/// A stored array, widened to f64.
#[derive(Debug, Clone)]
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl Array {
    pub fn f32s(&self) -> Vec<f32> {
        self.values.iter().map(|v| *v as f32).collect()
    }

    pub fn usizes(&self) -> Vec<usize> {
        self.values.iter().map(|v| *v as usize).collect()
    }

    pub fn tensor<const D: usize>(&self, device: &Device) -> Tensor<D> {
        assert_eq!(self.shape.len(), D, "stored rank");
        Tensor::from_data(TensorData::new(self.f32s(), self.shape.clone()), device)
    }
}

/// All arrays of a `.safetensors` file.
#[derive(Debug)]
pub struct Arrays {
    pub file: PathBuf,
    arrays: BTreeMap<String, Array>,
}

impl Arrays {
    pub fn read(file: &Path) -> Self {
        let bytes = std::fs::read(file).unwrap_or_else(|e| panic!("cannot read {}: {e}", file.display()));
        let stored = SafeTensors::deserialize(&bytes).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let arrays = stored
            .tensors()
            .into_iter()
            .map(|(name, view)| {
                let values = numbers(view.dtype(), view.data(), &name);
                (name, Array { shape: view.shape().to_vec(), values })
            })
            .collect();
        Self { file: file.to_owned(), arrays }
    }

    pub fn get(&self, name: &str) -> &Array {
        self.find(name).unwrap_or_else(|| panic!("{} has no array `{name}`", self.file.display()))
    }

    pub fn find(&self, name: &str) -> Option<&Array> {
        self.arrays.get(name)
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.arrays.keys().map(String::as_str)
    }

    /// The first parts of array names `case/...`.
    pub fn cases(&self) -> BTreeSet<String> {
        self.names().filter_map(|n| n.split_once('/')).map(|(case, _)| case.to_owned()).collect()
    }
}

fn numbers(dtype: Dtype, data: &[u8], name: &str) -> Vec<f64> {
    match dtype {
        Dtype::F32 => data.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect(),
        Dtype::F64 => data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().expect("eight bytes"))).collect(),
        Dtype::I64 => {
            data.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().expect("eight bytes")) as f64).collect()
        }
        Dtype::F16 => data.chunks_exact(2).map(|b| half(u16::from_le_bytes([b[0], b[1]]))).collect(),
        Dtype::BOOL | Dtype::U8 => data.iter().map(|b| f64::from(*b)).collect(),
        other => panic!("`{name}` has the type {other:?}, which no fixture here has"),
    }
}

/// The value of a float16's bits.
fn half(bits: u16) -> f64 {
    let (sign, exponent, fraction) = (bits >> 15, i32::from(bits >> 10 & 31), f64::from(bits & 1023) / 1024.0);
    let size = match exponent {
        0 => fraction * 2.0_f64.powi(-14),
        31 => panic!("a stored number is not finite"),
        _ => (1.0 + fraction) * 2.0_f64.powi(exponent - 15),
    };
    if sign == 1 { -size } else { size }
}

pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().as_slice::<f32>().expect("f32").to_vec()
}

/// Largest absolute difference over the largest absolute expected value.
pub fn error(found: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len(), "as many values as stored");
    assert!(found.iter().all(|v| v.is_finite()), "a result is not finite");
    let scale = expected.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let off = found.iter().zip(expected).fold(0.0_f64, |m, (f, e)| m.max((f64::from(*f) - e).abs()));
    if scale > 0.0 { off / scale } else { off }
}

/// Entry `i` along the first axis.
pub fn row(array: &Array, i: usize) -> Array {
    let shape = array.shape[1..].to_vec();
    let size: usize = shape.iter().product();
    Array { shape, values: array.values[i * size..(i + 1) * size].to_vec() }
}

/// Relative difference of two scalars.
pub fn relative(found: f64, expected: f64) -> f64 {
    let off = (found - expected).abs();
    if expected == 0.0 { off } else { off / expected.abs() }
}

/// Collects errors against their gates, so that a fixture reports all of them at once.
#[derive(Debug, Default)]
pub struct Gates {
    worst: BTreeMap<&'static str, (f64, String)>,
    failures: Vec<String>,
    checks: usize,
}

impl Gates {
    /// Records the `error` of `what`, of a kind with the gate `gate`.
    pub fn check(&mut self, kind: &'static str, what: impl Into<String>, error: f64, gate: f64) {
        let (what, gate) = (what.into(), gate * slack());
        self.checks += 1;
        if error.is_nan() || error > gate {
            self.failures.push(format!("{kind} `{what}`: {error:.2e} > {gate:.0e}"));
        }
        let worst = self.worst.entry(kind).or_insert((-1.0, String::new()));
        if error.is_nan() || error > worst.0 {
            *worst = (error, what);
        }
    }

    /// Compares a tensor with a stored array.
    pub fn tensor<const D: usize>(
        &mut self,
        kind: &'static str,
        what: impl Into<String>,
        found: Tensor<D>,
        expected: &Array,
        gate: f64,
    ) {
        let what = what.into();
        assert_eq!(found.dims().to_vec(), expected.shape, "shape of `{what}`");
        self.check(kind, what, error(&values(found), &expected.values), gate);
    }

    /// Prints one line, and fails if any gate was missed or nothing was checked.
    pub fn close(self, fixture: &str) {
        let worst: Vec<String> =
            self.worst.iter().map(|(kind, (e, what))| format!("{kind} {e:.1e} ({what})")).collect();
        eprintln!("{fixture}: {} checks; worst: {}", self.checks, worst.join(", "));
        assert!(self.checks > 0, "{fixture}: nothing was checked");
        assert!(self.failures.is_empty(), "{fixture} misses gates:\n  {}", self.failures.join("\n  "));
    }
}
