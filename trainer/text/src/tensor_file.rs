//! Safetensors read tensor by tensor from bytes, in their stored type.

use std::collections::BTreeMap;

use half::{bf16, f16};
use motion::tensor_header::Header;
use safetensors::tensor::{Dtype, TensorInfo};

use crate::network::TensorSpec;

/// Stored type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Element {
    /// IEEE single precision, 32 bits.
    F32,
    /// IEEE half precision, 16 bits.
    F16,
    /// The upper 16 bits of an IEEE single.
    Bf16,
}

impl Element {
    /// Number of bytes of a number.
    pub fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    pub(crate) fn dtype(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::F16 => Dtype::F16,
            Self::Bf16 => Dtype::BF16,
        }
    }

    fn of(dtype: Dtype) -> Option<Self> {
        match dtype {
            Dtype::F32 => Some(Self::F32),
            Dtype::F16 => Some(Self::F16),
            Dtype::BF16 => Some(Self::Bf16),
            _ => None,
        }
    }
}

/// Converts little-endian numbers to f32.
///
/// # Panics
/// If their number is not the length of `out`.
pub fn widen(element: Element, bytes: &[u8], out: &mut [f32]) {
    assert_eq!(bytes.len(), out.len() * element.bytes(), "bytes for as many numbers");
    let halves = || bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b));
    match element {
        Element::F32 => {
            out.iter_mut().zip(bytes.as_chunks::<4>().0).for_each(|(out, b)| *out = f32::from_le_bytes(*b));
        }
        Element::F16 => out.iter_mut().zip(halves()).for_each(|(out, half)| *out = f16::from_bits(half).to_f32()),
        Element::Bf16 => {
            out.iter_mut().zip(halves()).for_each(|(out, half)| *out = bf16::from_bits(half).to_f32());
        }
    }
}

/// Bytes that are read on demand.
pub trait ReadAt {
    /// Number of bytes.
    fn bytes(&self) -> u64;

    /// Fills `out` with the bytes at `offset`.
    ///
    /// # Errors
    /// The reason that they cannot be read.
    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String>;
}

impl<R: ReadAt + ?Sized> ReadAt for Box<R> {
    fn bytes(&self) -> u64 {
        (**self).bytes()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        (**self).read_at(offset, out)
    }
}

impl ReadAt for [u8] {
    fn bytes(&self) -> u64 {
        self.len() as u64
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        let start = usize::try_from(offset).ok();
        let range = start.and_then(|start| Some(start..start.checked_add(out.len())?));
        out.copy_from_slice(range.and_then(|range| self.get(range)).ok_or("the file is too short")?);
        Ok(())
    }
}

/// A tensor's place in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorFile {
    /// Stored type of its numbers; `None` for other types than floats of at most 32 bits.
    pub element: Option<Element>,
    /// Length of each axis.
    pub shape: Vec<usize>,
    /// Offset of its first byte.
    pub offset: u64,
}

/// A safetensors file whose header was read.
#[derive(Debug)]
pub struct WeightsFile<R> {
    pub(crate) source: R,
    /// Tensors by name.
    pub tensors: BTreeMap<String, TensorFile>,
}

impl<R: ReadAt> WeightsFile<R> {
    /// Reads the header and checks it against the length.
    ///
    /// # Errors
    /// The defect, without the file's name.
    pub fn open(source: R) -> Result<Self, String> {
        let header = Header::read(source.bytes(), &mut |offset, out| source.read_at(offset, out))??;
        let place = |info: &TensorInfo| TensorFile {
            element: Element::of(info.dtype),
            shape: info.shape.clone(),
            offset: header.place(info),
        };
        let tensors = header.metadata.tensors().into_iter().map(|(name, info)| (name, place(info))).collect();
        Ok(Self { source, tensors })
    }

    /// Refuses a file without one of `specs`, whose names have `prefix` there. Called before a network of these sizes
    /// is created.
    ///
    /// # Errors
    /// The first tensor that is missing or has another shape.
    pub fn holds(&self, specs: &[TensorSpec], prefix: &str) -> Result<(), String> {
        for TensorSpec { name, shape } in specs {
            let found = self.tensors.get(&format!("{prefix}{name}")).filter(|tensor| tensor.element.is_some());
            if found.is_none_or(|tensor| tensor.shape != *shape) {
                return Err(format!("no tensor `{prefix}{name}` {shape:?}"));
            }
        }
        Ok(())
    }

    /// Reads the numbers of the tensor `name` into `out`.
    ///
    /// # Errors
    /// If there is no tensor of floats with that number of elements, or it cannot be read.
    pub fn read(&self, name: &str, out: &mut [f32]) -> Result<(), String> {
        let missing = || format!("no tensor `{name}` with {} numbers", out.len());
        let tensor = self.tensors.get(name).ok_or_else(missing)?;
        let element = tensor.element.ok_or_else(missing)?;
        if tensor.shape.iter().product::<usize>() != out.len() {
            return Err(missing());
        }
        let mut bytes = vec![0; out.len() * element.bytes()];
        self.source.read_at(tensor.offset, &mut bytes)?;
        widen(element, &bytes, out);
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    #[test]
    fn halves_are_widened_exactly() {
        for (bits, value) in [
            (0x0000_u16, 0.0_f32),
            (0x8000, -0.0),
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65_504.0),
            (0x0400, 2.0_f32.powi(-14)),
            (0x0001, 2.0_f32.powi(-24)),
            (0x83ff, -1023.0 * 2.0_f32.powi(-24)),
            (0x7c00, f32::INFINITY),
        ] {
            let mut out = [1.0];
            widen(Element::F16, &bits.to_le_bytes(), &mut out);
            assert_eq!(out[0].to_bits(), value.to_bits(), "{bits:#x}");
        }
        let mut out = [0.0; 2];
        widen(Element::F16, &[0x01, 0x7e, 0, 0], &mut out);
        assert!(out[0].is_nan());
        widen(Element::Bf16, &[0x80, 0x3f, 0x49, 0xc0], &mut out);
        assert_eq!(out, [1.0, -3.140_625]);
    }

    pub(crate) fn file(header: &str, data: &[u8]) -> Vec<u8> {
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), data].concat()
    }

    #[test]
    fn headers_are_held_against_the_file() {
        let good = file(r#"{"a":{"dtype":"F16","shape":[2],"data_offsets":[0,4]}}"#, &[0, 0x3c, 0, 0xc0]);
        let open = |bytes: &[u8]| WeightsFile::open(Bytes(bytes.to_vec()));
        let mut out = [0.0; 2];
        open(&good).unwrap().read("a", &mut out).unwrap();
        assert_eq!(out, [1.0, -2.0]);
        let spec = |shape: &[usize]| [TensorSpec { name: "a".into(), shape: shape.to_vec() }];
        open(&good).unwrap().holds(&spec(&[2]), "").unwrap();
        assert_eq!(open(&good).unwrap().holds(&spec(&[1, 2]), "").unwrap_err(), "no tensor `a` [1, 2]");
        assert!(open(&good).unwrap().holds(&spec(&[2]), "x.").is_err());
        assert!(open(&good).unwrap().read("a", &mut [0.0; 3]).unwrap_err().contains("no tensor `a` with 3"));
        let mut long = good.clone();
        long[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        for (bytes, part) in [
            (long, "declares a header of"),
            (good[..6].to_vec(), "shorter than a header"),
            (good[..good.len() - 1].to_vec(), "tensors of 4 bytes, but has 3"),
            (file(r#"{"a":{"dtype":"F32","shape":[9],"data_offsets":[0,4]}}"#, &[0; 4]), "expected a safetensors"),
            (
                file(r#"{"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,4]}}"#, &[0; 4]),
                "expected a",
            ),
            (file("[", &[]), "expected a safetensors"),
        ] {
            let said = open(&bytes).unwrap_err();
            assert!(said.contains(part), "{said}");
        }
    }

    #[derive(Debug)]
    pub(crate) struct Bytes(pub(crate) Vec<u8>);

    impl ReadAt for Bytes {
        fn bytes(&self) -> u64 {
            self.0.len() as u64
        }

        fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
            self.0[..].read_at(offset, out)
        }
    }
}
