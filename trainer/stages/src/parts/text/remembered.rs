//! A cache of captions' vectors: training uses a caption many times, and an encoder costs more than the network that
//! reads its vectors.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::context::StageError;

/// Caches of the encoders that this process opened, the most recent last. An encoder's result for a caption never
/// changes, so stages and shards of one process share it.
static SHARED: Mutex<VecDeque<(String, Arc<Remembered>)>> = Mutex::new(VecDeque::new());

/// Number of times that all caches were cleared.
static FORGOTTEN: AtomicU64 = AtomicU64::new(0);

/// Largest number of caches; the vectors and the words of an encoder are two.
const SHARES: usize = 4;

/// Vectors by caption, at most `most` numbers.
#[derive(Debug)]
pub(super) struct Remembered {
    most: usize,
    known: Mutex<Known>,
}

#[derive(Debug, Default)]
struct Known {
    /// The value of [`FORGOTTEN`] when these were computed.
    since: u64,
    numbers: usize,
    rows: HashMap<String, Vec<f32>>,
}

impl Remembered {
    fn new(most: usize) -> Self {
        Self { most, known: Mutex::default() }
    }

    /// The cache for `key`, which must contain everything that the vectors depend on.
    pub(super) fn shared(key: String, most: usize) -> Arc<Self> {
        let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, known)) = shared.iter().find(|(other, _)| *other == key) {
            return Arc::clone(known);
        }
        if shared.len() == SHARES {
            shared.pop_front();
        }
        let new = Arc::new(Self::new(most));
        shared.push_back((key, Arc::clone(&new)));
        new
    }

    /// The vector of a caption, from the cache or from `make`. A full cache is cleared.
    pub(super) fn of(
        &self,
        caption: &str,
        make: impl FnOnce() -> Result<Vec<f32>, StageError>,
    ) -> Result<Vec<f32>, StageError> {
        // A panic elsewhere leaves no partial rows: rows are inserted whole.
        let lock = || {
            let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
            let since = FORGOTTEN.load(Ordering::Relaxed);
            if known.since != since {
                *known = Known { since, ..Known::default() };
            }
            known
        };
        if let Some(row) = lock().rows.get(caption) {
            return Ok(row.clone());
        }
        let row = make()?;
        let mut known = lock();
        if known.numbers + row.len() > self.most {
            *known = Known { since: known.since, ..Known::default() };
        }
        if row.len() <= self.most && known.rows.insert(caption.to_owned(), row.clone()).is_none() {
            known.numbers += row.len();
        }
        Ok(row)
    }
}

/// Clears all caches of this process, before measuring the time of an encoder.
pub fn forget() {
    FORGOTTEN.fetch_add(1, Ordering::Relaxed);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caption_is_embedded_once_while_there_is_room() {
        let remembered = Remembered::new(5);
        let made = std::cell::Cell::new(0);
        let of = |caption: &str| {
            let make = || {
                made.set(made.get() + 1);
                Ok(vec![made.get() as f32; 2])
            };
            remembered.of(caption, make).unwrap()[0]
        };
        assert_eq!([of("a"), of("b"), of("a"), of("b")], [1.0, 2.0, 1.0, 2.0]);
        assert_eq!([of("c"), of("a"), of("c")], [3.0, 4.0, 3.0], "room for two");
        forget();
        assert_eq!([of("a"), of("a")], [5.0, 5.0], "made again, once");
        let shared = Remembered::shared("an encoder".into(), 5);
        assert!(Arc::ptr_eq(&shared, &Remembered::shared("an encoder".into(), 5)));
        assert!(!Arc::ptr_eq(&shared, &Remembered::shared("another".into(), 5)));
        assert!(remembered.of("d", || Err(StageError::Fault("no".into()))).is_err());
    }
}
