//! Reads and writes `.npy` files of f32, with errors that name the file and the expected content.
//!
//! A truncated or foreign file is an error. The parser allocates nothing before it has compared the size that the header
//! declares with that of the file. `docs/decisions/0033-packages.md` says why it is not a library's.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

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
    #[error("{}: not a .npy file ({why})", file.display())]
    Header {
        file: PathBuf,
        /// Defect of the header.
        why: String,
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
    let (header, data) = Header::split(bytes).map_err(|why| NpyError::Header { file: file.into(), why })?;
    let width = match header.descr {
        "<f4" | ">f4" => 4,
        "<f8" | ">f8" if allow_f64 => 8,
        other => {
            let expected = if allow_f64 { "f32 or f64 (<f4, <f8)" } else { "f32 (<f4)" };
            return Err(NpyError::Type { file: file.into(), found: format!("`{}`", excerpt(other)), expected });
        }
    };
    if header.is_column_major && header.shape.len() > 1 {
        return Err(NpyError::Order { file: file.into() });
    }
    let found = data.len() as u64;
    let expected = header.elements.saturating_mul(width);
    if found != expected {
        return Err(NpyError::Size { file: file.into(), shape: header.shape, expected, found });
    }
    let big_endian = header.descr.starts_with('>');
    let data = if width == 4 {
        let value = if big_endian { f32::from_be_bytes } else { f32::from_le_bytes };
        data.as_chunks().0.iter().map(|bytes| value(*bytes)).collect()
    } else {
        let value = if big_endian { f64::from_be_bytes } else { f64::from_le_bytes };
        data.as_chunks().0.iter().map(|bytes| value(*bytes) as f32).collect()
    };
    Ok(Array { shape: header.shape.iter().map(|n| *n as usize).collect(), data })
}

/// The header of a `.npy` file, versions 1 to 3 of NumPy's `numpy.lib.format`: a mapping as Python writes it.
struct Header<'a> {
    /// Type of an element: `<f4` is a little-endian f32. A type with fields is a list.
    descr: &'a str,
    is_column_major: bool,
    shape: Vec<u64>,
    /// Product of the axes.
    elements: u64,
}

impl<'a> Header<'a> {
    /// Returns the header and the bytes after it, or what is wrong.
    fn split(bytes: &'a [u8]) -> Result<(Self, &'a [u8]), String> {
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
        let (header, data) = rest.split_at_checked(length as usize).ok_or("its header is truncated")?;
        let fields = std::str::from_utf8(header).map_err(|_| "its header is not text")?;
        let descr = field(fields, "descr")?;
        let text = QUOTES.iter().find_map(|quote| descr.strip_prefix(*quote)?.split(*quote).next());
        let descr = text.unwrap_or(descr);
        let is_column_major = match field(fields, "fortran_order")? {
            order if order.starts_with("False") => false,
            order if order.starts_with("True") => true,
            _ => return Err("its `fortran_order` is neither True nor False".into()),
        };
        let axes = field(fields, "shape")?.strip_prefix('(').and_then(|axes| axes.split_once(')'));
        let axes = axes.ok_or("its shape is not a tuple")?.0.split(',').map(str::trim).filter(|axis| !axis.is_empty());
        let axes = axes.map(|axis| axis.parse().map_err(|_| "its shape has an axis that is not a number"));
        let shape = axes.collect::<Result<Vec<u64>, _>>()?;
        let elements = shape.iter().try_fold(1_u64, |product, axis| product.checked_mul(*axis));
        let elements = elements.ok_or("its shape has more than 2^64 elements")?;
        Ok((Self { descr, is_column_major, shape, elements }, data))
    }
}

/// Quotes around a text in Python.
const QUOTES: [char; 2] = ['\'', '"'];

/// The text of a mapping from a key's value on.
fn field<'a>(fields: &'a str, key: &str) -> Result<&'a str, String> {
    let after = |quote: &char| Some(fields.split_once(&format!("{quote}{key}{quote}"))?.1);
    let value = QUOTES.iter().find_map(after).and_then(|rest| rest.trim_start().strip_prefix(':'));
    value.map(str::trim_start).ok_or_else(|| format!("its header has no `{key}`"))
}

/// Serialises an f32 array as a `.npy` file of version 1. As NumPy writes it, the data begin at a multiple of 64 bytes.
pub fn to_bytes(shape: &[usize], data: &[f32]) -> Vec<u8> {
    const BEFORE: usize = 10;
    let comma = if shape.len() == 1 { "," } else { "" };
    let axes = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({axes}{comma}), }}");
    let length = (BEFORE + header.len() + 1).next_multiple_of(64) - BEFORE;
    let mut bytes = Vec::with_capacity(BEFORE + length + 4 * data.len());
    bytes.extend(b"\x93NUMPY\x01\x00");
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(format!("{header:<width$}\n", width = length - 1).bytes());
    bytes.extend(data.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// Writes an f32 array.
pub fn write(file: &Path, shape: &[usize], data: &[f32]) -> Result<(), NpyError> {
    let io = |source| NpyError::Io { file: file.into(), source };
    fs::File::create(file).and_then(|mut f| f.write_all(&to_bytes(shape, data))).map_err(io)
}

#[cfg(test)]
mod tests {
    use npyz::WriterBuilder as _;

    use super::*;

    #[test]
    fn an_array_survives_its_file_and_a_truncated_one_is_named() {
        let file = Path::new("clip.npy");
        let data: Vec<f32> = (0..6).map(|v| v as f32 / 3.0).collect();
        let bytes = to_bytes(&[2, 3], &data);
        assert_eq!(parse(file, &bytes, false).unwrap(), Array { shape: vec![2, 3], data });
        let cut = parse(file, &bytes[..bytes.len() - 5], false).unwrap_err().to_string();
        assert!(
            cut.contains("clip.npy: has 19 bytes of data") && cut.contains("expected 24") && cut.contains("truncated"),
            "{cut}"
        );
        assert!(matches!(parse(file, b"hello", false), Err(NpyError::Header { .. })));
    }

    /// `npyz` reads and writes as NumPy does.
    #[test]
    fn another_library_reads_and_writes_the_same_files() {
        let data: Vec<f32> = (0..6).map(|v| v as f32 / 3.0).collect();
        let file = Path::new("clip.npy");
        for shape in [vec![], vec![6], vec![2, 3], vec![1, 2, 3]] {
            let data = &data[..shape.iter().product()];
            let ours = to_bytes(&shape, data);
            let read = npyz::NpyFile::new(&ours[..]).unwrap();
            assert!(read.shape().iter().map(|n| *n as usize).eq(shape.iter().copied()), "{shape:?}");
            assert_eq!(read.into_vec::<f32>().unwrap(), data);
            let wide: Vec<f64> = data.iter().map(|value| f64::from(*value)).collect();
            for theirs in [written("<f4", &shape, data), written(">f4", &shape, data)] {
                assert_eq!(parse(file, &theirs, false).unwrap(), Array { shape: shape.clone(), data: data.to_vec() });
            }
            for theirs in [written("<f8", &shape, &wide), written(">f8", &shape, &wide)] {
                assert_eq!(parse(file, &theirs, true).unwrap(), Array { shape: shape.clone(), data: data.to_vec() });
                assert!(matches!(parse(file, &theirs, false), Err(NpyError::Type { .. })));
            }
        }
    }

    /// A file that `npyz` writes.
    fn written<T: npyz::Serialize + Copy>(descr: &str, shape: &[usize], data: &[T]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let axes: Vec<u64> = shape.iter().map(|n| *n as u64).collect();
        let options = npyz::WriteOptions::new().shape(&axes).dtype(npyz::DType::Plain(descr.parse().unwrap()));
        let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
        writer.extend(data.iter().copied()).unwrap();
        writer.finish().unwrap();
        bytes
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
        refuse(&with_header(1, 2, b"{}", b""), "no `descr`");
        refuse(&shaped("[2]", b""), "not a tuple");
        let order = b"{'descr': '<f4', 'fortran_order': 0, 'shape': ()}";
        refuse(&with_header(1, order.len() as u32, order, b""), "neither True nor False");
        let double = br#"{"descr": "<f4", "fortran_order": False, "shape": (1,)}"#;
        assert_eq!(parse(file, &with_header(1, double.len() as u32, double, &[0; 4]), false).unwrap().data, [0.0]);
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
            let mut good = to_bytes(&[2, 9], &[1.0; 18]);
            let place = at % good.len();
            good[place] = byte;
            good.truncate(good.len() - cut % good.len());
            if let Ok(array) = parse(file, &good, true) {
                proptest::prop_assert!(array.data.len() <= 18);
            }
        }
    }
}
