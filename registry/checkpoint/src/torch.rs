//! Writer of weights in the format of `torch.save`: an uncompressed zip archive with a pickle that lists the tensors,
//! and a file of numbers for each.
//!
//! The pickle holds a dict from names to tensors, or that dict under a key. It uses protocol 2 and only the opcodes
//! that PyTorch's reader with `weights_only` allows. The same tensors always give the same bytes.

use std::collections::BTreeMap;
use std::io::{self, Seek, Write};

use safetensors::tensor::TensorView;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

/// Folder in the archive; PyTorch uses this name for unnamed files.
const FOLDER: &str = "archive";
/// PyTorch aligns tensors so that they can be mapped.
const ALIGNMENT: u16 = 64;

/// A tensor of 32-bit floats.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tensor<'a> {
    pub shape: Vec<usize>,
    /// Its numbers in row-major order, little-endian.
    pub bytes: &'a [u8],
}

impl<'a> Tensor<'a> {
    /// Wraps a tensor of a safetensors file.
    pub fn of(view: &TensorView<'a>) -> Self {
        Self { shape: view.shape().to_vec(), bytes: view.data() }
    }
}

/// Writes `tensors` as one dict, or under `key` in another.
///
/// # Errors
/// Returns an error if `out` cannot be written.
pub fn write<W: Write + Seek>(out: W, key: Option<&str>, tensors: &BTreeMap<String, Tensor<'_>>) -> io::Result<()> {
    let mut archive = ZipWriter::new(out);
    let plain = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(DateTime::default())
        .with_alignment(ALIGNMENT);
    let mut entry = |name: &str, bytes: &[u8]| -> io::Result<()> {
        archive.start_file(format!("{FOLDER}/{name}"), plain).map_err(io::Error::other)?;
        archive.write_all(bytes)
    };
    entry("data.pkl", &pickle(key, tensors))?;
    entry("byteorder", b"little")?;
    for (i, tensor) in tensors.values().enumerate() {
        entry(&format!("data/{i}"), tensor.bytes)?;
    }
    entry("version", b"3\n")?;
    archive.finish().map_err(io::Error::other)?.flush()
}

/// Pickles the dict; the numbers of tensor i are in the file `data/i`.
fn pickle(key: Option<&str>, tensors: &BTreeMap<String, Tensor<'_>>) -> Vec<u8> {
    let mut out = Pickle(vec![0x80, 2]);
    if let Some(key) = key {
        out.0.extend(b"}(");
        out.text(key);
    }
    out.0.extend(b"}(");
    for (i, (name, tensor)) in tensors.iter().enumerate() {
        out.text(name);
        out.tensor(i, tensor);
    }
    out.0.push(b'u');
    if key.is_some() {
        out.0.push(b'u');
    }
    out.0.push(b'.');
    out.0
}

struct Pickle(Vec<u8>);

impl Pickle {
    fn text(&mut self, text: &str) {
        self.0.push(b'X');
        self.0.extend(u32::try_from(text.len()).unwrap_or(u32::MAX).to_le_bytes());
        self.0.extend(text.as_bytes());
    }

    fn whole(&mut self, number: usize) {
        if let Ok(small) = u8::try_from(number) {
            self.0.extend([b'K', small]);
        } else if let Ok(number) = i32::try_from(number) {
            self.0.push(b'J');
            self.0.extend(number.to_le_bytes());
        } else {
            // Eight bytes and a zero byte, so that it is not read as a negative number.
            self.0.extend([0x8a, 9]);
            self.0.extend((number as u64).to_le_bytes());
            self.0.push(0);
        }
    }

    fn wholes(&mut self, numbers: &[usize]) {
        self.0.push(b'(');
        numbers.iter().for_each(|number| self.whole(*number));
        self.0.push(b't');
    }

    /// Writes a call of `_rebuild_tensor_v2(storage, offset, shape, strides, requires_grad, hooks)`.
    fn tensor(&mut self, number: usize, tensor: &Tensor<'_>) {
        let mut strides = vec![1; tensor.shape.len()];
        for axis in (1..strides.len()).rev() {
            strides[axis - 1] = strides[axis] * tensor.shape[axis];
        }
        self.0.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        self.text("storage");
        self.0.extend(b"ctorch\nFloatStorage\n");
        self.text(&number.to_string());
        self.text("cpu");
        self.whole(tensor.shape.iter().product());
        self.0.extend(b"tQ");
        self.whole(0);
        self.wholes(&tensor.shape);
        self.wholes(&strides);
        self.0.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    #[test]
    fn a_pickle_names_each_tensor_with_its_shape_and_strides() {
        let bytes = [0_u8; 24];
        let tensors = BTreeMap::from([
            ("b".to_owned(), Tensor { shape: vec![2, 3], bytes: &bytes }),
            ("a".to_owned(), Tensor { shape: vec![], bytes: &bytes[..4] }),
        ]);
        let said = pickle(Some("state_dict"), &tensors);
        let text = String::from_utf8_lossy(&said);
        assert!(text.contains("state_dict") && text.contains("FloatStorage"), "{text}");
        // Shape (2, 3), strides (3, 1).
        assert!(said.windows(12).any(|part| part == b"(K\x02K\x03t(K\x03K\x01t"), "{said:?}");
        assert_eq!(said.last(), Some(&b'.'));
        let mut large = Pickle(Vec::new());
        [255, 256, 1 << 31].into_iter().for_each(|number| large.whole(number));
        let expected = b"K\xffJ\x00\x01\x00\x00\x8a\x09\x00\x00\x00\x80\x00\x00\x00\x00\x00";
        assert_eq!(large.0, expected);

        let mut file = Cursor::new(Vec::new());
        write(&mut file, None, &tensors).unwrap();
        let mut again = Cursor::new(Vec::new());
        write(&mut again, None, &tensors).unwrap();
        assert_eq!(file.get_ref(), again.get_ref(), "the same bytes");
        let mut archive = zip::ZipArchive::new(file).unwrap();
        assert_eq!(archive.len(), 5);
        let data = archive.by_name("archive/data/1").unwrap();
        assert_eq!((data.size(), data.data_start().unwrap_or_default() % 64), (24, 0));
    }
}
