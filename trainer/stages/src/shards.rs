//! The division of work into shards.

use std::ops::Range;

/// Shard `index` of `of` of a range of `count` items.
pub(crate) fn shard_range(count: usize, index: usize, of: usize) -> Range<usize> {
    count * index / of..count * (index + 1) / of
}
