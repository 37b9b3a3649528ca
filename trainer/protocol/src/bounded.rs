//! Lists of messages that end at their limit, before a body of short entries fills memory.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};

use crate::limits::BATCH_ENTRIES;

/// Reads a list of at most [`BATCH_ENTRIES`].
pub(crate) fn batch<'de, T: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    deserializer.deserialize_seq(Batch(PhantomData))
}

struct Batch<T>(PhantomData<T>);

impl<'de, T: Deserialize<'de>> Visitor<'de> for Batch<T> {
    type Value = Vec<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "at most {BATCH_ENTRIES} entries")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Vec<T>, A::Error> {
        let mut all = Vec::new();
        while let Some(entry) = entries.next_element()? {
            if all.len() == BATCH_ENTRIES {
                let message = format!("the batch has more than {BATCH_ENTRIES} entries; send several batches");
                return Err(A::Error::custom(message));
            }
            all.push(entry);
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_ends_at_its_limit() {
        #[derive(serde::Deserialize)]
        struct Lines(#[serde(deserialize_with = "batch")] Vec<String>);
        let read = |count: usize| serde_json::from_str::<Lines>(&format!("[{}]", vec!["\"\""; count].join(",")));
        assert_eq!(read(BATCH_ENTRIES).map(|lines| lines.0.len()).ok(), Some(BATCH_ENTRIES));
        let refused = read(BATCH_ENTRIES + 1).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(refused.contains("more than 10000 entries"), "{refused}");
    }
}
