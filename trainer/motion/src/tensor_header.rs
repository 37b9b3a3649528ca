//! Headers of safetensors files, written and read apart from the data, so that a large file is neither copied nor in
//! memory whole. The order and alignment of files are those of the `safetensors` crate.
//!
//! Not its job: the tensors' values, and files that are small enough for `safetensors` itself.

use protocol::json_mistake;
use safetensors::tensor::{Dtype, Metadata, TensorInfo};

/// The largest header that is read; the header of a thousand tensors has some hundred kilobytes.
pub const MOST_BYTES: u64 = 16 << 20;

/// Fills a buffer with the bytes at an offset of a file.
pub type ReadAt<'a, E> = dyn FnMut(u64, &mut [u8]) -> Result<(), E> + 'a;

/// A file's header.
#[derive(Debug)]
pub struct Header {
    /// Names, types, shapes and offsets of the tensors.
    pub metadata: Metadata,
    /// Offset of the first tensor's data in the file.
    data: u64,
}

impl Header {
    /// Reads the header of a file of `bytes` bytes, and checks it against that length.
    ///
    /// # Errors
    /// The error of `read`; the inner error is the defect, without the file's name and content.
    pub fn read<E>(bytes: u64, read: &mut ReadAt<'_, E>) -> Result<Result<Self, String>, E> {
        let Some(after_length) = bytes.checked_sub(8) else {
            return Ok(Err(format!("has {bytes} bytes, so it is shorter than a header; expected a safetensors file")));
        };
        let mut length = [0; 8];
        read(0, &mut length)?;
        let length = u64::from_le_bytes(length);
        if length > MOST_BYTES.min(after_length) {
            return Ok(Err(format!(
                "declares a header of {length} bytes, but has {bytes} bytes; expected a safetensors file"
            )));
        }
        let mut json = vec![0; usize::try_from(length).unwrap_or_default()];
        read(8, &mut json)?;
        let metadata: Metadata = match serde_json::from_slice(&json) {
            Ok(metadata) => metadata,
            Err(error) => {
                let mistake = json_mistake(&error);
                return Ok(Err(format!("has an invalid header: {mistake}; expected a safetensors file")));
            }
        };
        let declared = metadata.data_len();
        let has = after_length - length;
        if declared as u64 != has {
            return Ok(Err(format!(
                "declares tensors of {declared} bytes, but has {has}; expected a safetensors file"
            )));
        }
        Ok(Ok(Self { metadata, data: 8 + length }))
    }

    /// Offset in the file of a tensor's first byte.
    pub fn place(&self, tensor: &TensorInfo) -> u64 {
        self.data + tensor.data_offsets.0 as u64
    }
}

/// Serialises the header of a file of `tensors`, whose values follow it one after the other in this order. Tensors with
/// larger elements come first.
///
/// # Panics
/// If two tensors have one name.
pub fn header(tensors: impl IntoIterator<Item = (String, Dtype, Vec<usize>)>) -> Vec<u8> {
    let mut end = 0;
    let info = |(name, dtype, shape): (String, Dtype, Vec<usize>)| {
        let begin = end;
        end += shape.iter().product::<usize>() * dtype.bitsize() / 8;
        (name, TensorInfo { dtype, shape, data_offsets: (begin, end) })
    };
    let metadata = Metadata::new(None, tensors.into_iter().map(info).collect()).expect("tensors one after the other");
    let mut json = serde_json::to_vec(&metadata).expect("names and numbers");
    json.resize(json.len().next_multiple_of(8), b' ');
    [&(json.len() as u64).to_le_bytes()[..], &json].concat()
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use safetensors::tensor::TensorView;

    use super::*;

    fn read(file: &[u8]) -> Result<Header, String> {
        let mut fill = |offset: u64, out: &mut [u8]| {
            let from = usize::try_from(offset).unwrap();
            out.copy_from_slice(&file[from..from + out.len()]);
            Ok::<_, Infallible>(())
        };
        let Ok(header) = Header::read(file.len() as u64, &mut fill);
        header
    }

    #[test]
    fn a_header_is_that_of_the_safetensors_crate() {
        let count = 3_i64.to_le_bytes();
        let values = [1.0_f32, -2.0].map(f32::to_le_bytes).concat();
        let ours = [
            header([("z".to_owned(), Dtype::I64, vec![1]), ("a".to_owned(), Dtype::F32, vec![2, 1])]),
            count.to_vec(),
            values.clone(),
        ];
        let tensors = [
            ("a", TensorView::new(Dtype::F32, vec![2, 1], &values).unwrap()),
            ("z", TensorView::new(Dtype::I64, vec![1], &count).unwrap()),
        ];
        let ours = ours.concat();
        assert_eq!(ours, safetensors::serialize(tensors, None).unwrap());
        let found = read(&ours).unwrap();
        assert_eq!(found.place(found.metadata.info("a").unwrap()) as usize, ours.len() - 8);
    }

    #[test]
    fn a_header_that_does_not_fit_the_file_is_refused() {
        let good = [header([("a".to_owned(), Dtype::F32, vec![1])]), vec![0; 4]].concat();
        assert!(read(&good).is_ok());
        let mut long = good.clone();
        long[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        for (file, part) in [
            (&good[..6], "shorter than a header"),
            (&good[..good.len() - 1], "tensors of 4 bytes, but has 3"),
            (&long, "declares a header of 18446744073709551615 bytes"),
            (&[2, 0, 0, 0, 0, 0, 0, 0, b'[', b' '], "has an invalid header"),
        ] {
            let said = read(file).unwrap_err();
            assert!(said.contains(part) && said.ends_with("expected a safetensors file"), "{said}");
        }
    }
}
