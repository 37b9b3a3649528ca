//! Moves sampled latents until their motions meet their targets. Source: optimisation at sampling time, of noise in DNO
//! (Karunratanakul et al., CVPR 2024) and of logits in MaskControl (Pinyoanuntapong et al., 2024).
//!
//! Ours: the sampled latent is moved, so that no gradient flows through the denoiser. The loss is the mean squared
//! distance from targets in metres, and the motion's distance from the sampled one: its poses stay, and the root's
//! speed and turn change smoothly. The optimizer is Adam, whose rate falls along half a cosine. Each motion's result
//! depends on that motion alone.

use std::f64::consts::PI;

use burn::tensor::{Device, Tensor, TensorData};
use models::device::host;
use models::losses::{Body, ControlTarget, Pointwise};
use models::optim::AdamW;
use motion::Skeleton;

use crate::parts::hint::{Hint, NormalisedHints};
use crate::parts::latent_networks::Autoencoder;

/// Initial learning rate, in a latent's own unit.
const RATE: f64 = 0.1;
/// Weight of the pose in square metres: the penalty if all features change by one deviation.
const POSE: f64 = 0.1;
/// Weight of the root in square metres, for the frame-to-frame difference of its change of speed and turn.
const ROOT: f64 = 0.1;
const ADAM: AdamW = AdamW { beta1: 0.9, beta2: 0.99, eps: 1e-8, weight_decay: 0.0 };

/// Refines latents `[batch, N, d]` of motions of `lengths` frames in `steps` steps towards the targets of `hints`.
pub(crate) fn refine(vae: &Autoencoder, z: &mut [f32], lengths: &[usize], hints: &[Hint], steps: usize) {
    let meta = vae.meta();
    let skeleton = Skeleton::of(meta.format);
    let latent = meta.latent;
    let device = vae.device();
    let body = Body::new(skeleton, &meta.mean, &meta.std, device);
    let told = Target::new(hints, device);
    let wanted = Target::new(&hints.iter().map(Hint::wants).collect::<Vec<_>>(), device);
    let tracked = device.clone().autodiff();
    let at = |z: &[f32], device| {
        Tensor::<3>::from_data(TensorData::new(z.to_vec(), [lengths.len(), latent.tokens, latent.dim]), device)
    };
    let as_drawn = AsDrawn::new(vae.decode_tensor(at(z, device), lengths), lengths, skeleton);
    let mut m = vec![0.0; z.len()];
    let mut v = vec![0.0; z.len()];
    for step in 0..steps {
        let z_bnd = at(z, &tracked).require_grad();
        let features = vae.decode_tensor(z_bnd.clone(), lengths);
        let joints = body.joints(features.clone()) * skeleton.metres_per_unit;
        let loss = told.loss(joints.clone()) + wanted.loss(joints) + as_drawn.loss(features);
        let gradient = z_bnd.grad(&loss.backward()).expect("motion depends on its latent");
        let gradient = host(gradient);
        let lr = RATE * (1.0 + (PI * step as f64 / steps as f64).cos()) / 2.0;
        ADAM.step(step as u64 + 1, lr, z, &gradient, &mut m, &mut v);
    }
}

/// The sampled motions of a batch, to which the result must stay near.
struct AsDrawn {
    /// Features [B, T, D], normalised, 0 past each motion's end.
    features: Tensor<3>,
    /// Number of leading features, the root's turn and speed.
    root: usize,
    /// Index of the first feature of the pose.
    pose: usize,
    /// Divisors [B, 1, 1] that make a mean of a sum over a motion's pose features.
    poses: Tensor<3>,
    /// Divisors [B, T - 1, 1] for differences of two frames, 0 past a motion's end; `None` if no motion has two frames.
    moves: Option<Tensor<3>>,
}

impl AsDrawn {
    fn new(features: Tensor<3>, lengths: &[usize], skeleton: &Skeleton) -> Self {
        let [batch, frames, width] = features.dims();
        let layout = skeleton.layout();
        let root = layout.root_velocity.end;
        let pose = layout.positions.start;
        let row = |values: Vec<f64>, frames: usize| {
            let values: Vec<f32> = values.into_iter().map(|v| v as f32).collect();
            Tensor::from_data(TensorData::new(values, [batch, frames, 1]), &features.device())
        };
        let poses = lengths.iter().map(|len| POSE / (len * (width - pose)) as f64).collect();
        let each = |len: &usize| {
            let pairs = len.saturating_sub(1);
            let weight = ROOT / (pairs.max(1) * root) as f64;
            (0..frames - 1).map(move |t| if t < pairs { weight } else { 0.0 })
        };
        let moves = (frames > 1).then(|| row(lengths.iter().flat_map(each).collect(), frames - 1));
        let poses = row(poses, 1);
        Self { features, root, pose, poses, moves }
    }

    fn loss(&self, features: Tensor<3>) -> Tensor<1> {
        let [_, frames, width] = features.dims();
        let away = features - self.features.clone();
        let poses = away.clone().narrow(2, self.pose, width - self.pose).powi_scalar(2) * self.poses.clone();
        let Some(weights) = &self.moves else { return poses.sum() };
        let root = away.narrow(2, 0, self.root);
        let moves = root.clone().narrow(1, 1, frames - 1) - root.narrow(1, 0, frames - 1);
        poses.sum() + (moves.powi_scalar(2) * weights.clone()).sum()
    }
}

/// Targets of the motions of a batch.
struct Target {
    of: ControlTarget,
    /// Weights that make a mean of the sum over a motion's targets.
    weights: Vec<f32>,
}

impl Target {
    /// Collects the targets of `hints`, in metres.
    fn new(hints: &[Hint], device: &Device) -> Self {
        let coordinates = 3 * hints.first().map(Hint::joints).unwrap_or_default();
        let zero = vec![0.0; coordinates];
        let one = vec![1.0; coordinates];
        let told = NormalisedHints::of(hints, &zero, &one);
        let of = ControlTarget::new(&told.values, &told.given, told.shape, (&zero, &one), true, device);
        let weights = of.entries().iter().map(|own| 1.0 / (*own).max(1) as f32).collect();
        Self { of, weights }
    }

    /// The mean squared distance of each motion's joints `[batch, frames, joints, 3]`, summed over the batch.
    fn loss(&self, joints: Tensor<4>) -> Tensor<1> {
        self.of.loss(joints, Pointwise::L2, &self.weights)
    }
}
