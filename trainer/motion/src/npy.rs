//! Reads and writes `.npy` files of f32, with errors that name the file and the expected content.
//!
//! A thin layer over `npyz`: its checks on type, order and size report a truncated or foreign file instead of returning
//! wrong numbers.

use std::fs;
use std::io::{Error, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use npyz::{DType, NpyHeader, Order, TypeChar, WriterBuilder as _};
use protocol::{excerpt, limits};

use crate::files::DataPath;

/// An array of a file, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    /// Length of each axis.
    pub shape: Vec<usize>,
    /// Values of all elements.
    pub data: Vec<f32>,
}

/// A `.npy` file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum NpyError {
    /// The file system reported an error.
    #[error("{}: {source}", file.display())]
    Io {
        file: PathBuf,
        /// Error of the file system.
        source: std::io::Error,
    },
    /// The header is not that of a `.npy` file.
    #[error("{}: not a .npy file ({source})", file.display())]
    Header {
        file: PathBuf,
        /// Defect of the header.
        source: std::io::Error,
    },
    /// The element type is not the expected one.
    #[error("{}: has type {found}; expected {expected}; save it with numpy.save(..., x.astype(numpy.float32))", file.display())]
    Type {
        file: PathBuf,
        /// Type in the header.
        found: String,
        /// Types that can be read here.
        expected: &'static str,
    },
    /// The array is column-major.
    #[error("{}: is stored in column-major order (fortran_order); expected row-major; save numpy.ascontiguousarray(x)", file.display())]
    Order { file: PathBuf },
    /// The file is shorter or longer than its header declares.
    #[error("{}: has {} bytes of data for shape {shape:?}; expected {expected}; the file is {}", file.display(), found,
        if found < expected { "truncated: copy or download it again" } else { "longer than its header declares" })]
    Size {
        file: PathBuf,
        /// Shape in the header.
        shape: Vec<u64>,
        /// Number of bytes of this shape.
        expected: u64,
        /// Number of bytes after the header.
        found: u64,
    },
}

impl NpyError {
    /// Returns true if the file does not exist.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound)
    }
}

/// Reads an f32 array, one clip's features.
pub fn read(file: &DataPath) -> Result<Array, NpyError> {
    parse(file.shown(), &bytes_of(file, limits::CLIP_BYTES)?, false)
}

/// Reads an f32 or f64 array, rounding f64. For statistics, which published sets store in either type.
pub fn read_any_float(file: &DataPath) -> Result<Array, NpyError> {
    parse(file.shown(), &bytes_of(file, limits::ARRAY_BYTES)?, true)
}

fn bytes_of(file: &DataPath, limit: u64) -> Result<Vec<u8>, NpyError> {
    file.read(limit).map_err(|source| NpyError::Io { file: file.shown().into(), source })
}

/// Reads an array from bytes; `file` is only its name in errors.
pub fn parse(file: &Path, bytes: &[u8], allow_f64: bool) -> Result<Array, NpyError> {
    let header_error = |source| NpyError::Header { file: file.into(), source };
    check_header(bytes).map_err(|what| header_error(Error::new(ErrorKind::InvalidData, what)))?;
    let mut rest = bytes;
    let header = NpyHeader::from_reader(&mut rest).map_err(|error| header_error(quoted(&error)))?;
    let expected = if allow_f64 { "f32 or f64 (<f4, <f8)" } else { "f32 (<f4)" };
    let wrong_type = |found: String| NpyError::Type { file: file.into(), found, expected };
    let width = match header.dtype() {
        DType::Plain(ty)
            if ty.type_char() == TypeChar::Float && (ty.size_field() == 4 || (allow_f64 && ty.size_field() == 8)) =>
        {
            ty.size_field()
        }
        other => return Err(wrong_type(format!("`{}`", excerpt(&other.descr())))),
    };
    if header.order() == Order::Fortran && header.shape().len() > 1 {
        return Err(NpyError::Order { file: file.into() });
    }
    let size = |shape: &[u64]| shape.iter().try_fold(width, |n, axis| n.checked_mul(*axis));
    let found = rest.len() as u64;
    let expected = size(header.shape()).unwrap_or(u64::MAX);
    if found != expected {
        return Err(NpyError::Size { file: file.into(), shape: header.shape().to_vec(), expected, found });
    }
    let shape: Vec<usize> = header.shape().iter().map(|n| *n as usize).collect();
    let body = npyz::NpyFile::with_header(header, rest);
    let data = if width == 4 {
        body.into_vec::<f32>()
    } else {
        body.into_vec::<f64>().map(|v| v.into_iter().map(|x| x as f32).collect())
    };
    Ok(Array { shape, data: data.map_err(|error| header_error(quoted(&error)))? })
}

/// Hides the reader's message about a header, which may quote it.
fn quoted(error: &Error) -> Error {
    Error::new(error.kind(), format!("cannot read its header: {}", excerpt(&error.to_string())))
}

/// Largest nesting of brackets; the header of a plain array has a mapping and a tuple in it.
const DEPTH: usize = 4;

/// Checks the header before its reader trusts it: the length, for which it allocates, the nesting, and the shape, whose
/// axes it multiplies.
fn check_header(bytes: &[u8]) -> Result<(), String> {
    let [b'\x93', b'N', b'U', b'M', b'P', b'Y', major, _, rest @ ..] = bytes else {
        return Err("its first bytes are not those of a .npy file".into());
    };
    let (length, rest) = match (major, rest) {
        (1, [a, b, rest @ ..]) => (u32::from(u16::from_le_bytes([*a, *b])), rest),
        (2 | 3, [a, b, c, d, rest @ ..]) => (u32::from_le_bytes([*a, *b, *c, *d]), rest),
        (1..=3, _) => return Err("its header is truncated".into()),
        (other, _) => return Err(format!("it has version {other}; expected 1 to 3")),
    };
    if length as usize > limits::ARRAY_HEADER_BYTES {
        return Err(format!("its header has {length} bytes; expected at most {}", limits::ARRAY_HEADER_BYTES));
    }
    let header = rest.get(..length as usize).ok_or("its header is truncated")?;
    // The reader's time doubles with each level.
    let mut depth = 0_usize;
    for byte in header {
        match byte {
            b'(' | b'[' | b'{' => depth += 1,
            b')' | b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > DEPTH {
            return Err(format!("its header has brackets nested more than {DEPTH} levels deep"));
        }
    }
    let header = String::from_utf8_lossy(header);
    for after in header.split("shape").skip(1) {
        let axes = after.split_once('(').and_then(|(_, axes)| axes.split_once(')')).map_or("", |(axes, _)| axes);
        let axes = axes.split(',').map(str::trim).filter(|axis| !axis.is_empty());
        let mut numbers =
            axes.map(|axis| axis.parse::<u64>().map_err(|_| "its shape has an axis that is not a number"));
        numbers.try_fold(1_u64, |product, axis| {
            product.checked_mul(axis?).ok_or("its shape has more than 2^64 elements")
        })?;
    }
    Ok(())
}

/// Serialises an f32 array as a `.npy` file.
pub fn to_bytes(shape: &[usize], data: &[f32]) -> std::io::Result<Vec<u8>> {
    let shape: Vec<u64> = shape.iter().map(|n| *n as u64).collect();
    let mut bytes = Vec::with_capacity(128 + 4 * data.len());
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(&shape).writer(&mut bytes).begin_nd()?;
    writer.extend(data.iter().copied())?;
    writer.finish()?;
    Ok(bytes)
}

/// Writes an f32 array.
pub fn write(file: &Path, shape: &[usize], data: &[f32]) -> Result<(), NpyError> {
    let io = |source| NpyError::Io { file: file.into(), source };
    let bytes = to_bytes(shape, data).map_err(io)?;
    fs::File::create(file).and_then(|mut f| f.write_all(&bytes)).map_err(io)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_survives_its_file_and_a_truncated_one_is_named() {
        let file = Path::new("clip.npy");
        let data: Vec<f32> = (0..6).map(|v| v as f32 / 3.0).collect();
        let bytes = to_bytes(&[2, 3], &data).unwrap();
        assert_eq!(parse(file, &bytes, false).unwrap(), Array { shape: vec![2, 3], data });
        let cut = parse(file, &bytes[..bytes.len() - 5], false).unwrap_err().to_string();
        assert!(
            cut.contains("clip.npy: has 19 bytes of data") && cut.contains("expected 24") && cut.contains("truncated"),
            "{cut}"
        );
        assert!(matches!(parse(file, b"hello", false), Err(NpyError::Header { .. })));
    }

    /// A file of `version` with the header `header`, which declares `length` bytes.
    fn with_header(version: u8, length: u32, header: &[u8], data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY".to_vec();
        bytes.extend([version, 0]);
        match version {
            1 => bytes.extend((length as u16).to_le_bytes()),
            _ => bytes.extend(length.to_le_bytes()),
        }
        bytes.extend(header);
        bytes.extend(data);
        bytes
    }

    #[test]
    fn a_header_that_asks_for_much_gets_nothing() {
        let file = Path::new("clip.npy");
        let refuse = |bytes: &[u8], part: &str| {
            let said = parse(file, bytes, true).unwrap_err().to_string();
            assert!(said.contains(part), "{part}: {said}");
        };
        refuse(&with_header(2, u32::MAX, b"{}", b""), "its header has 4294967295 bytes");
        refuse(&with_header(1, 900, b"{}", b""), "truncated");
        refuse(&with_header(9, 2, b"{}", b""), "version 9");
        let shaped = |shape: &str, data: &[u8]| {
            let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n");
            with_header(1, header.len() as u32, header.as_bytes(), data)
        };
        let most = u64::MAX;
        refuse(&shaped(&format!("({most}, {most})"), b""), "more than 2^64 elements");
        refuse(&shaped("(4611686018427387904, 4)", b""), "more than 2^64 elements");
        refuse(&shaped("(0xffffffffffffffff, 2)", b""), "an axis that is not a number");
        refuse(&shaped(&format!("({most},)"), b""), "truncated");
        // An axis of zero has no elements, for any other axes.
        assert_eq!(parse(file, &shaped("(0, 9000000000)", b""), false).unwrap().data, [0.0; 0]);
        let nested = "(".repeat(900);
        assert!(parse(file, &with_header(1, 900, nested.as_bytes(), b""), false).is_err());
    }

    proptest::proptest! {
        /// Arbitrary bytes must not cause a panic, nor use more memory than the file has.
        #[test]
        fn no_bytes_break_the_reader(
            bytes in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..300),
            cut in 0_usize..200,
            at in 0_usize..200,
            byte in proptest::prelude::any::<u8>(),
        ) {
            let file = Path::new("clip.npy");
            let _ = parse(file, &bytes, true);
            let mut good = to_bytes(&[2, 9], &[1.0; 18]).unwrap();
            let place = at % good.len();
            good[place] = byte;
            good.truncate(good.len() - cut % good.len());
            if let Ok(array) = parse(file, &good, true) {
                proptest::prop_assert!(array.data.len() <= 18);
            }
        }
    }
}
