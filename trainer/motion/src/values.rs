//! Numbers in their own memory, or in shared bytes such as a mapped file that many processes use.

use std::fmt;
use std::ops::Deref;

use bytemuck::Pod;
use bytes::Bytes;

/// A read-only row of numbers. Clones share it.
#[derive(Clone)]
pub struct Values<T>(Held<T>);

#[derive(Clone)]
enum Held<T> {
    Owned(std::sync::Arc<Vec<T>>),
    /// Bytes aligned for `T` that hold a whole number of values.
    Shared(Bytes),
}

/// Single-precision numbers, such as the features of a clip.
pub type Floats = Values<f32>;

impl<T: Pod> Values<T> {
    /// Views little-endian numbers in `bytes`, without a copy if they are aligned; `None` if the length is no multiple
    /// of theirs.
    pub fn view(bytes: Bytes) -> Option<Self> {
        if !bytes.len().is_multiple_of(size_of::<T>()) {
            return None;
        }
        // All supported machines are little-endian; another one would have to swap bytes here.
        const { assert!(cfg!(target_endian = "little"), "tensors are stored in little-endian order") };
        if bytemuck::try_cast_slice::<u8, T>(&bytes).is_ok() {
            return Some(Self(Held::Shared(bytes)));
        }
        Some(Self::from(bytemuck::pod_collect_to_vec::<u8, T>(&bytes)))
    }

    /// Copies the numbers to a vector.
    pub fn into_vec(self) -> Vec<T> {
        match self.0 {
            Held::Owned(values) => std::sync::Arc::try_unwrap(values).unwrap_or_else(|shared| shared.to_vec()),
            Held::Shared(bytes) => bytemuck::cast_slice(&bytes).to_vec(),
        }
    }
}

impl<T> From<Vec<T>> for Values<T> {
    fn from(values: Vec<T>) -> Self {
        Self(Held::Owned(values.into()))
    }
}

impl<T: Pod> Deref for Values<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.0 {
            Held::Owned(values) => values,
            Held::Shared(bytes) => bytemuck::cast_slice(bytes),
        }
    }
}

impl<T: Pod + PartialEq> PartialEq for Values<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T: Pod + fmt::Debug> fmt::Debug for Values<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const FEW: usize = 8;
        f.debug_list().entries(self.iter().take(FEW)).finish()?;
        if self.len() > FEW { write!(f, " and {} more", self.len() - FEW) } else { Ok(()) }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn aligned_bytes_are_read_in_place_and_others_copied() {
        let numbers: Vec<f32> = (0..10).map(|i| i as f32 / 3.0).collect();
        // Room for the numbers at each offset of the first eight bytes.
        let mut room = vec![0_u8; 8 + 40];
        let aligned = room.as_ptr().align_offset(4);
        for at in [aligned, aligned + 1] {
            room[at..at + 40].copy_from_slice(bytemuck::cast_slice(&numbers));
            let bytes = Bytes::from_owner(std::mem::take(&mut room));
            let begin = bytes[at..].as_ptr();
            let view = Floats::view(bytes.slice(at..at + 40)).unwrap();
            assert_eq!(view.as_ptr().cast::<u8>() == begin, at == aligned, "copied only where it has to be");
            assert_eq!(*view, numbers);
            assert_eq!(view, Floats::from(numbers.clone()));
            assert_eq!(view.into_vec(), numbers);
            assert!(Floats::view(bytes.slice(at..at + 39)).is_none());
            room = bytes.to_vec();
            if room.as_ptr().align_offset(4) != aligned {
                return;
            }
        }
    }
}
