//! Maps whose copies share all that neither copy changes, and serde for what is behind an `Arc`.

use std::sync::Arc;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// An ordered map. A copy costs nothing, and a change what lies on the way to it.
pub type Map<K, V> = rpds::RedBlackTreeMapSync<K, V>;

/// An ordered set, as [`Map`].
pub type Set<T> = rpds::RedBlackTreeSetSync<T>;

/// A list, as [`Map`].
pub type List<T> = rpds::VectorSync<T>;

pub(crate) fn serialize<T: Serialize, S: Serializer>(value: &Arc<T>, serializer: S) -> Result<S::Ok, S::Error> {
    T::serialize(value, serializer)
}

pub(crate) fn deserialize<'de, T: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<Arc<T>, D::Error> {
    T::deserialize(deserializer).map(Arc::new)
}
