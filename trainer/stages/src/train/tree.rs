//! The fixed tree along which the slices of a step are summed, for a gang in one process. A gang over a network sums
//! the same tree piece by piece (`worker::gang`); its tests compare the two.

/// The sum of `parts` along the fixed tree: a range is split at the largest power of two below its length.
///
/// # Panics
/// If there are no parts, or parts of different lengths.
pub fn tree_sum(parts: &[Vec<f32>]) -> Vec<f32> {
    if let [only] = parts {
        return only.clone();
    }
    let (left, right) = parts.split_at(parts.len().next_power_of_two() / 2);
    let mut sum = tree_sum(left);
    let right = tree_sum(right);
    assert_eq!(sum.len(), right.len(), "slices give vectors of one length");
    for (a, b) in sum.iter_mut().zip(right) {
        *a += b;
    }
    sum
}
