//! Persistent collections, whose copies share unchanged data, and serde functions for values in an `Arc`.

use std::sync::Arc;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// An ordered map with constant-time copies and logarithmic changes.
pub type Map<K, V> = rpds::RedBlackTreeMapSync<K, V>;

/// An ordered set with the costs of [`Map`].
pub type Set<T> = rpds::RedBlackTreeSetSync<T>;

/// A list with the costs of [`Map`].
pub type List<T> = rpds::VectorSync<T>;

pub(crate) fn serialize<T: Serialize, S: Serializer>(value: &Arc<T>, serializer: S) -> Result<S::Ok, S::Error> {
    T::serialize(value, serializer)
}

pub(crate) fn deserialize<'de, T: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<Arc<T>, D::Error> {
    T::deserialize(deserializer).map(Arc::new)
}
