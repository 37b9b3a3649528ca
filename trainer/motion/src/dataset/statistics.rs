//! Mean and Std as defined by the published sets.

use crate::skeleton::Skeleton;

/// Mean and Std `[D]` over all frames of all clips. Std is the population standard deviation, averaged over each group
/// of features, so that it is constant inside a group. Sums are in f64, in the order of the clips.
///
/// A group that never varies (for instance contacts of a set without a step) has the scale 1.
pub fn statistics<'a>(skeleton: &Skeleton, clips: impl Iterator<Item = &'a [f32]> + Clone) -> (Vec<f64>, Vec<f64>) {
    let width = skeleton.features;
    let rows = || clips.clone().flat_map(|clip| clip.chunks_exact(width));
    let count = rows().count().max(1) as f64;
    let mut mean = vec![0.0; width];
    for row in rows() {
        for (sum, value) in mean.iter_mut().zip(row) {
            *sum += f64::from(*value);
        }
    }
    mean.iter_mut().for_each(|sum| *sum /= count);
    let mut std = vec![0.0; width];
    for row in rows() {
        for ((sum, value), mean) in std.iter_mut().zip(row).zip(&mean) {
            *sum += (f64::from(*value) - mean).powi(2);
        }
    }
    std.iter_mut().for_each(|sum| *sum = (*sum / count).sqrt());
    for group in skeleton.layout().groups() {
        let scale = std[group.clone()].iter().sum::<f64>() / group.len() as f64;
        std[group].fill(if scale > 1e-9 { scale } else { 1.0 });
    }
    (mean, std)
}
