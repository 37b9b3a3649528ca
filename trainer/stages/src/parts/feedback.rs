//! Rounds of feedback: a drawn latent is decoded, its motion compared with the target positions, and the latent changed
//! by a [`Feedback`] network. The network's module lists the sources; the use for motions is ours. Not its job: the
//! training (`train.control`).
//!
//! The inputs of a frame are the root's place and facing direction. Each joint with a target adds its distance from the
//! target and the growth of that distance, seen from the root. The root is needed because a latent describes motion
//! from frame to frame in the root's own directions, but a path is in world coordinates. Distances are divided by the
//! motion's root mean square distance, and the change is multiplied by it. So a small error is corrected as precisely
//! as a large one, and a motion that meets its targets is not changed. Each motion's result depends on that motion
//! alone. It is the result of the best round: on a path unlike those of training a round may increase the error.

use burn::tensor::{Tensor, TensorData};
use models::device::host;
use models::kernels::Dropout;
use models::networks::Feedback;
use motion::Skeleton;
use motion::features::{recover_joints_wide, root_path};
use motion::quaternion::{self as quat, Vec3};

use super::hint::Hint;
use super::latent_networks::Autoencoder;

/// Inputs of the root: height, place, facing direction, and the logarithm of the motion's mean distance.
const ROOT: usize = 6;
/// Inputs of a joint: a flag for its target, three coordinates of its distance, and three of the distance's change.
const JOINT: usize = 7;
/// Lower limit of distances, metres.
const LEAST: f64 = 1e-3;
/// Upper limit of the distance that scales a change, metres. Far from the target the right latent is another one, not
/// the same changed further.
const MOST: f64 = 1.0;

/// Number of inputs of a frame for a skeleton of `joints` joints.
pub(crate) fn inputs(joints: usize) -> usize {
    ROOT + JOINT * joints
}

/// Inputs of the network for a batch of motions.
#[derive(Debug)]
pub(crate) struct Seen {
    /// Inputs of shape [B, T, inputs].
    frames_btf: Tensor<3>,
    /// Factor on changes [B, 1, 1].
    scale_b11: Tensor<3>,
    /// Root mean square distance of each motion, metres; 0 without targets.
    distances: Vec<f64>,
    lengths: Vec<usize>,
}

impl Seen {
    /// Computes inputs from decoded, normalised motions [B, T, D]. Motion b has `lengths[b]` frames and the targets
    /// `hints[b]`.
    pub(crate) fn of(vae: &Autoencoder, features: Tensor<3>, lengths: &[usize], hints: &[Hint]) -> Self {
        let skeleton = Skeleton::of(vae.meta().format);
        let [batch, frames, width] = features.dims();
        let mut rows = host(features);
        vae.denormalise(&mut rows);
        let size = inputs(skeleton.joints);
        let mut told = vec![0.0; batch * frames * size];
        let mut distances = Vec::with_capacity(batch);
        for (b, (length, hint)) in lengths.iter().zip(hints).enumerate() {
            let motion = &rows[b * frames * width..][..length * width];
            distances.push(tell(&mut told[b * frames * size..][..length * size], motion, skeleton, hint));
        }
        let device = vae.device();
        let tensor = |values, shape| Tensor::from_data(TensorData::new(values, shape), device);
        let scales: Vec<f32> = distances.iter().map(|distance| distance.min(MOST) as f32).collect();
        Self {
            frames_btf: tensor(told, [batch, frames, size]),
            scale_b11: tensor(scales, [batch, 1, 1]),
            distances,
            lengths: lengths.to_vec(),
        }
    }

    /// The change that `network` predicts for the latents [B, N, d] of these motions.
    pub(crate) fn change(&self, network: &Feedback, latent_bnd: Tensor<3>, dropout: &mut Dropout) -> Tensor<3> {
        network.forward(latent_bnd, self.frames_btf.clone(), &self.lengths, dropout) * self.scale_b11.clone()
    }
}

/// Writes the inputs of one motion's frames from rows that are not normalised. Returns its root mean square distance,
/// or 0 without targets.
fn tell(out: &mut [f32], rows: &[f32], skeleton: &Skeleton, hint: &Hint) -> f64 {
    let unit = skeleton.metres_per_unit;
    let joints = recover_joints_wide(rows, skeleton);
    let path = root_path(rows, skeleton);
    let off = |t: usize, j: usize, position: [f32; 3]| -> Vec3 {
        let at = 3 * (t * skeleton.joints + j);
        std::array::from_fn(|axis| f64::from(position[axis]) - joints[at + axis] * unit)
    };
    let frames = path.len();
    let here = || hint.iter().filter(|(t, ..)| *t < frames);
    let squares: f64 = here().map(|(t, j, position)| quat::dot(off(t, j, position), off(t, j, position))).sum();
    let count = here().count();
    if count == 0 {
        return 0.0;
    }
    let mean = (squares / count as f64).sqrt().max(LEAST);
    let size = inputs(skeleton.joints);
    for ((heading, root), to) in path.iter().zip(out.chunks_exact_mut(size)) {
        // A heading's angle is half of its turn.
        let cos = heading[0];
        let sin = heading[2];
        let told = [root[0] * unit, root[1] * unit, root[2] * unit, cos * cos - sin * sin, 2.0 * sin * cos, mean.ln()];
        to.iter_mut().zip(told).for_each(|(to, value)| *to = value as f32);
    }
    let mut before: Vec<Option<(usize, Vec3)>> = vec![None; skeleton.joints];
    for (t, j, position) in here() {
        let distance = quat::scale(off(t, j, position), 1.0 / mean);
        let rate = match before[j].replace((t, distance)) {
            Some((was, last)) => quat::scale(quat::sub(distance, last), skeleton.fps / (t - was) as f64),
            None => [0.0; 3],
        };
        let to = &mut out[t * size + ROOT + j * JOINT..][..JOINT];
        to[0] = 1.0;
        for (to, value) in to[1..].chunks_exact_mut(3).zip([distance, rate]) {
            let seen = quat::rotate(path[t].0, value);
            to.iter_mut().zip(seen).for_each(|(to, value)| *to = value as f32);
        }
    }
    mean
}

/// Corrects latents `[batch, N, d]` of motions of `lengths` frames in `rounds` rounds, each change multiplied by
/// `strength`. Each latent is the one whose motion came nearest to its targets, the uncorrected one included.
pub(crate) fn correct(
    network: &Feedback,
    vae: &Autoencoder,
    mut z: Vec<f32>,
    (lengths, hints): (&[usize], &[Hint]),
    rounds: usize,
    strength: f64,
) -> Vec<f32> {
    if rounds == 0 {
        return z;
    }
    let latent = vae.meta().latent;
    let shape = [lengths.len(), latent.tokens, latent.dim];
    let size = latent.tokens * latent.dim;
    let mut z_bnd = Tensor::<3>::from_data(TensorData::new(z.clone(), shape), vae.device());
    let see = |z_bnd: &Tensor<3>| Seen::of(vae, vae.decode_tensor(z_bnd.clone(), lengths), lengths, hints);
    let mut seen = see(&z_bnd);
    let mut nearest = seen.distances.clone();
    for _ in 0..rounds {
        z_bnd = z_bnd.clone() + seen.change(network, z_bnd, &mut Dropout::off()) * (strength as f32);
        seen = see(&z_bnd);
        let changed = host(z_bnd.clone());
        let motions = z.chunks_exact_mut(size).zip(changed.chunks_exact(size));
        for ((kept, changed), (nearest, distance)) in motions.zip(nearest.iter_mut().zip(&seen.distances)) {
            if distance < nearest {
                *nearest = *distance;
                kept.copy_from_slice(changed);
            }
        }
    }
    z
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A motion that turns left by the same angle each frame while it walks. Its targets are its own positions, except
    /// for one joint's height and, late, the root.
    #[test]
    fn distances_are_seen_from_the_root_and_measured_by_their_mean() {
        let skeleton = Skeleton::of(protocol::stage::DataFormat::Humanml3d);
        let mut rows = vec![0.0; 4 * skeleton.features];
        for row in rows.chunks_exact_mut(skeleton.features) {
            // A quarter turn over all three steps.
            row[0] = std::f32::consts::PI / 12.0;
            (row[2], row[3]) = (0.1, 1.0);
        }
        let joints = recover_joints_wide(&rows, skeleton);
        let at = |t: usize, j: usize, add: [f64; 3]| -> [f32; 3] {
            std::array::from_fn(|axis| (joints[3 * (t * skeleton.joints + j) + axis] + add[axis]) as f32)
        };
        let size = inputs(skeleton.joints);
        let mut out = vec![0.0; 4 * size];
        assert_eq!(
            tell(&mut out, &rows, skeleton, &Hint::none(4, skeleton.joints)),
            0.0,
            "told nothing, changed by nothing"
        );
        assert!(out.iter().all(|value| *value == 0.0));

        let mut hint = Hint::none(4, skeleton.joints);
        hint.tell(1, 20, at(1, 20, [0.0, 0.3, 0.0]));
        hint.tell(0, 0, at(0, 0, [0.0; 3]));
        hint.tell(3, 0, at(3, 0, [0.4, 0.0, 0.0]));
        let mean = (0.25_f64 / 3.0).sqrt();
        let distance = tell(&mut out, &rows, skeleton, &hint);
        assert!((distance - mean).abs() < 1e-6, "{distance}");
        let joint = |t: usize, j: usize| &out[t * size + ROOT + j * JOINT..][..JOINT];
        let near = |found: &[f32], expected: &[f64]| {
            let same = found.iter().zip(expected).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5);
            assert!(same, "{found:?}, expected {expected:?}");
        };
        near(joint(1, 20), &[1.0, 0.0, 0.3 / mean, 0.0, 0.0, 0.0, 0.0]);
        near(joint(0, 0), &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        // The root has turned by a quarter, so a distance along x is along its own z; it grew from zero over three
        // frames.
        let after = joint(3, 0);
        let ahead = f64::from(after[3]);
        assert!((ahead.abs() - 0.4 / mean).abs() < 1e-5 && after[1].abs() < 1e-5, "{after:?}");
        near(&after[4..], &[0.0, 0.0, ahead * skeleton.fps / 3.0]);
        assert!(joint(2, 0).iter().all(|value| *value == 0.0), "not told");
        near(&out[3 * size..][3..ROOT], &[0.0, f64::from(out[3 * size + 4]), mean.ln()]);
    }
}
