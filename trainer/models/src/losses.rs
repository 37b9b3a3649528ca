//! The training losses, in a form that adds up over slices of a batch.
//!
//! Every function returns the *sum over the examples* of per-example means, shape [1]. The caller adds the slices and
//! divides by the global batch. The result is the mean over the batch for any division into slices.
//!
//! Source: MLD and MotionLCM (VAE terms, noise loss), Luo et al. (pseudo-Huber), Lim and Ye, arXiv:1705.02894 (hinge).
//! Departs: MotionLCM divides the joint term of KIT-ML like that of HumanML3D although its unit is not the metre; here
//! [`Body::metres_per_unit`] is the length of one unit.
//!
//! Not its job: dividing by the batch, and choosing the network that computes the arguments.

use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};
use motion::skeleton::Skeleton;
use protocol::stage::VaeLoss;

use crate::kernels::{self, Derivative};
use crate::networks::Posterior;

pub use crate::kernels::Pointwise;

/// Mean squared error of each example, summed. [B, N, d].
pub fn mse(found: Tensor<3>, expected: Tensor<3>) -> Tensor<1> {
    per_example((found - expected).square())
}

/// `sqrt((found - expected)^2 + c^2) - c`, mean of each example, summed. [B, N, d]. It approximates squared error over
/// 2c for differences well below `c`, and absolute error well above it.
pub fn pseudo_huber(found: Tensor<3>, expected: Tensor<3>, c: f64) -> Tensor<1> {
    let c = c as f32;
    per_example(((found - expected).square() + c * c).sqrt() - c)
}

/// KL divergence from the standard normal, mean of each example, summed.
pub fn kl(posterior: &Posterior) -> Tensor<1> {
    let mu = posterior.mu_bnd.clone();
    let logvar = posterior.logvar_bnd.clone();
    per_example((mu.square() + logvar.clone().exp() - 1.0 - logvar) * 0.5)
}

/// Hinge loss of a discriminator: scores of data above 1, of fakes below -1. One tensor [B, N, 1] per head; the mean of
/// each example over heads and tokens, summed.
pub fn hinge_discriminator(real: Vec<Tensor<3>>, fake: Vec<Tensor<3>>) -> Tensor<1> {
    let heads = real.len() as f32;
    let terms = real.into_iter().zip(fake).map(|(real, fake)| per_example(relu(1.0 - real) + relu(fake + 1.0)));
    total(terms) / heads
}

/// Hinge loss of the generator: scores of fakes above 1. Shapes and sums as in [`hinge_discriminator`].
pub fn hinge_generator(fake: Vec<Tensor<3>>) -> Tensor<1> {
    let heads = fake.len() as f32;
    total(fake.into_iter().map(|fake| per_example(relu(1.0 - fake)))) / heads
}

/// # Panics
/// If there are no terms: a discriminator has at least one head.
fn total(terms: impl Iterator<Item = Tensor<1>>) -> Tensor<1> {
    terms.reduce(|a, b| a + b).expect("a discriminator has heads")
}

fn per_example(elements: Tensor<3>) -> Tensor<1> {
    let [_, tokens, width] = elements.dims();
    elements.sum() / ((tokens * width) as f32)
}

/// Weight of each frame of a padded batch.
#[derive(Debug, Clone)]
pub struct FrameWeights {
    /// Weights of shape [B, T, 1].
    weights: Tensor<3>,
}

impl FrameWeights {
    /// Counts the first `lengths[b]` frames of clip b, each with weight `1 / lengths[b]`.
    pub fn masked(lengths: &[usize], frames: usize, device: &Device) -> Self {
        Self::of(lengths, frames, device, |length, t| if t < length { 1.0 / length as f32 } else { 0.0 })
    }

    /// Counts every frame with weight 1 / T, padding included (v1).
    pub fn plain(lengths: &[usize], frames: usize, device: &Device) -> Self {
        Self::of(lengths, frames, device, |_, _| 1.0 / frames as f32)
    }

    fn of(lengths: &[usize], frames: usize, device: &Device, weight: impl Fn(usize, usize) -> f32) -> Self {
        let values = lengths.iter().flat_map(|l| (0..frames).map(|t| weight(*l, t)).collect::<Vec<_>>()).collect();
        Self { weights: Tensor::from_data(TensorData::new(values, [lengths.len(), frames, 1]), device) }
    }

    /// Mean over the width, weighted mean over the frames, sum over the examples. [B, T, width].
    pub fn compare(&self, distance: Pointwise, found: Tensor<3>, expected: Tensor<3>) -> Tensor<1> {
        let width = found.dims()[2] as f32;
        kernels::weighted_distance(distance, found, expected, self.weights.clone()) / width
    }
}

/// Conversion of normalised features into joints.
#[derive(Debug, Clone)]
pub struct Body {
    skeleton: &'static Skeleton,
    /// Factor on joints before they are compared: `Skeleton::metres_per_unit`, or 1 to keep the data's unit.
    pub metres_per_unit: f64,
    mean: Tensor<3>,
    std: Tensor<3>,
}

impl Body {
    /// Creates the conversion; `mean` and `std` [D] are the normalisation of the features.
    ///
    /// # Panics
    /// If they are not as wide as the skeleton's feature rows.
    pub fn new(skeleton: &'static Skeleton, mean: &[f32], std: &[f32], device: &Device) -> Self {
        assert_eq!((mean.len(), std.len()), (skeleton.features, skeleton.features), "widths of mean and std");
        let row = |v: &[f32]| Tensor::from_data(TensorData::new(v.to_vec(), [1, 1, v.len()]), device);
        Self { skeleton, metres_per_unit: skeleton.metres_per_unit, mean: row(mean), std: row(std) }
    }

    /// 1 where an ankle or a foot stands from a frame to the next, 0 elsewhere: [B, T - 1, 3 per foot]. The contacts in the
    /// normalised features [B, T, D] say so; T is at least 2.
    fn standing(&self, features: &Tensor<3>) -> Tensor<3> {
        let [batch, frames, _] = features.dims();
        let contacts = self.skeleton.layout().contacts;
        let of = |x: &Tensor<3>, frames: usize| {
            let [batch, _, _] = x.dims();
            x.clone().slice([0..batch, 0..frames, contacts.clone()])
        };
        let contacts = of(features, frames - 1) * of(&self.std, 1) + of(&self.mean, 1);
        let feet = contacts.dims()[2];
        let stands = contacts.greater_elem(0.5).float().reshape([batch, frames - 1, feet, 1]);
        stands.repeat_dim(3, 3).reshape([batch, frames - 1, 3 * feet])
    }

    /// Joints [B, T, J, 3] of normalised features [B, T, D], in the data's unit. Gradients flow through the running sums
    /// of turns and steps. The differentiable equivalent of `motion::features::recover_joints`.
    pub fn joints(&self, features: Tensor<3>) -> Tensor<4> {
        self.scaled(features, 1.0)
    }

    /// [`joints`](Self::joints) in the unit of the joint term.
    fn metres(&self, features: Tensor<3>) -> Tensor<4> {
        self.scaled(features, self.metres_per_unit)
    }

    fn scaled(&self, features: Tensor<3>, scale: f64) -> Tensor<4> {
        kernels::joints(features, self.mean.clone(), self.std.clone(), scale, self.skeleton)
    }
}

/// Target positions of the joints of a batch, for a loss on the positions found. Source: MotionLCM, whose temporal
/// setting compares normalised coordinates and whose spatial setting compares metres.
#[derive(Debug, Clone)]
pub struct ControlTarget {
    /// Target coordinates [B, T, joints x 3].
    target: Tensor<3>,
    /// 1 for a coordinate that counts, 0 for the others.
    given: Tensor<3>,
    /// Number of frames and joints of each sample that count.
    entries: Vec<usize>,
    /// Mean and deviation of each coordinate [1, 1, joints x 3], if normalised coordinates are compared.
    normal: Option<(Tensor<3>, Tensor<3>)>,
}

impl ControlTarget {
    /// Creates targets from hints [B, T, joints, 3] that are normalised by `mean` and `std` [joints x 3]; only those
    /// marked in `given` count. With `metres` the hints are converted back to the data's unit before the comparison.
    ///
    /// # Panics
    /// If a list has another length than its shape requires.
    pub fn new(
        hints: &[f32],
        given: &[bool],
        (batch, frames, joints): (usize, usize, usize),
        (mean, std): (&[f32], &[f32]),
        metres: bool,
        device: &Device,
    ) -> Self {
        let width = 3 * joints;
        let shape = [batch, frames, width];
        assert_eq!((hints.len(), given.len()), (batch * frames * width, batch * frames * width), "hints and mask");
        let value = |(i, hint): (usize, &f32)| if metres { hint * std[i % width] + mean[i % width] } else { *hint };
        let target: Vec<f32> = hints.iter().enumerate().map(value).collect();
        let live: Vec<f32> = given.iter().map(|given| if *given { 1.0 } else { 0.0 }).collect();
        let entries = given.chunks_exact((frames * width).max(1));
        let entries = entries.map(|sample| sample.chunks_exact(3).filter(|axes| axes.contains(&true)).count());
        let row = |values: &[f32]| Tensor::from_data(TensorData::new(values.to_vec(), [1, 1, width]), device);
        Self {
            target: Tensor::from_data(TensorData::new(target, shape), device),
            given: Tensor::from_data(TensorData::new(live, shape), device),
            entries: entries.collect(),
            normal: (!metres).then(|| (row(mean), row(std))),
        }
    }

    /// Number of frames and joints of each sample that count.
    pub fn entries(&self) -> Vec<usize> {
        self.entries.clone()
    }

    /// The distance of `joints` [B, T, joints, 3], in the data's unit, from their targets. It is summed over the
    /// coordinates of a sample that count, multiplied by `weights[b]`, and summed over samples. A sample without such
    /// coordinates adds nothing.
    pub fn loss(&self, joints: Tensor<4>, distance: Pointwise, weights: &[f32]) -> Tensor<1> {
        let found = joints.reshape(self.target.dims());
        let found = match &self.normal {
            Some((mean, std)) => (found - mean.clone()) / std.clone(),
            None => found,
        };
        let weights = weights.iter().zip(&self.entries).map(|(weight, own)| if *own > 0 { *weight } else { 0.0 });
        let weights: Vec<f32> = weights.collect();
        let weights = Tensor::<3>::from_data(TensorData::new(weights, [self.entries.len(), 1, 1]), &found.device());
        (distance.of(found - self.target.clone()) * self.given.clone() * weights).sum()
    }
}

/// Weights and distances of the VAE's loss.
#[derive(Debug, Clone, PartialEq)]
pub struct VaeRecipe {
    /// The terms' weights, and whether padding is left out.
    pub weights: VaeLoss,
    /// Distance of the feature term.
    pub feature: Pointwise,
    /// Distance of the joint term.
    pub joint: Pointwise,
    /// Distance of the local position term.
    pub velocity: Pointwise,
    /// Distance of the term on foot velocities.
    pub feet: Pointwise,
    /// Distance of the term on the velocities of feet that stand.
    pub contact: Pointwise,
    /// Distance of the term on the velocities of all joints.
    pub joint_velocity: Pointwise,
    /// Distance of the term on the accelerations of all joints.
    pub joint_acceleration: Pointwise,
}

impl From<VaeLoss> for VaeRecipe {
    /// Uses smooth L1 for all terms, as published.
    fn from(weights: VaeLoss) -> Self {
        let [feature, joint, velocity, feet, contact, joint_velocity, joint_acceleration] = [Pointwise::SmoothL1; 7];
        Self { weights, feature, joint, velocity, feet, contact, joint_velocity, joint_acceleration }
    }
}

/// The VAE's terms, each already multiplied by its weight; a term of weight 0 is absent.
#[derive(Debug, Clone)]
pub struct VaeTerms {
    /// The term on normalised features.
    pub feature: Option<Tensor<1>>,
    /// The term on recovered joints.
    pub joint: Option<Tensor<1>>,
    /// The term on local positions, which upstream calls velocity.
    pub velocity: Option<Tensor<1>>,
    /// The term on the velocities of ankles and feet.
    pub feet: Option<Tensor<1>>,
    /// The term on the velocities of ankles and feet that stand.
    pub contact: Option<Tensor<1>>,
    /// The term on the velocities of all joints.
    pub joint_velocity: Option<Tensor<1>>,
    /// The term on the accelerations of all joints.
    pub joint_acceleration: Option<Tensor<1>>,
    /// The KL divergence of the posterior.
    pub kl: Option<Tensor<1>>,
}

impl VaeTerms {
    /// The sum of the terms.
    pub fn total(&self) -> Option<Tensor<1>> {
        self.named().into_iter().filter_map(|(_, term)| term).reduce(|a, b| a + b)
    }

    /// The terms by the names under which they are recorded.
    pub fn named(&self) -> [(&'static str, Option<Tensor<1>>); 8] {
        let Self { feature, joint, velocity, feet, contact, joint_velocity, joint_acceleration, kl } = self.clone();
        [
            ("feature", feature),
            ("joint", joint),
            ("velocity", velocity),
            ("feet", feet),
            ("contact", contact),
            ("joint_velocity", joint_velocity),
            ("joint_acceleration", joint_acceleration),
            ("kl", kl),
        ]
    }
}

/// Computes the VAE's loss. `decoded` and `features` [B, T, D], normalised.
pub fn vae(
    recipe: &VaeRecipe,
    body: &Body,
    decoded: Tensor<3>,
    features: Tensor<3>,
    posterior: &Posterior,
    lengths: &[usize],
) -> VaeTerms {
    let ([batch, frames, _], device) = (decoded.dims(), features.device());
    let weights = &recipe.weights;
    let frame_weights = if weights.masked {
        FrameWeights::masked(lengths, frames, &device)
    } else {
        FrameWeights::plain(lengths, frames, &device)
    };
    let term = |weight: f64, value: &dyn Fn() -> Tensor<1>| (weight != 0.0).then(|| value() * (weight as f32));
    let positions = body.skeleton.layout().positions;
    let local = |x: &Tensor<3>| x.clone().slice([0..batch, 0..frames, positions.clone()]);
    // Recovering the joints takes many operations, so all terms on joints share the result.
    let joints = weights.compares_joints().then(|| [body.metres(decoded.clone()), body.metres(features.clone())]);
    let compared = |x: &Tensor<4>| x.clone().reshape([batch, frames, 3 * body.skeleton.joints]);
    let change =
        |weight: f64, distance: Pointwise, which: &[usize], derivative: Derivative, mask: Option<Tensor<3>>| {
            let [found, expected] = joints.as_ref().filter(|_| frames > derivative.order())?;
            let lengths: Vec<usize> = lengths.iter().map(|length| length.saturating_sub(derivative.order())).collect();
            let each = FrameWeights::masked(&lengths, frames - derivative.order(), &device);
            let of = |x: &Tensor<4>| {
                let all = kernels::joint_derivative(x.clone(), which, derivative, body.skeleton.fps);
                mask.iter().fold(all, |all, mask| all * mask.clone())
            };
            term(weight, &|| each.compare(distance, of(found), of(expected)))
        };
    let feet: Vec<usize> = body.skeleton.left_foot.iter().chain(&body.skeleton.right_foot).copied().collect();
    let all: Vec<usize> = (0..body.skeleton.joints).collect();
    let standing = (weights.contact != 0.0 && frames > 1).then(|| body.standing(&features));
    VaeTerms {
        feature: term(weights.feature, &|| frame_weights.compare(recipe.feature, decoded.clone(), features.clone())),
        joint: joints.as_ref().and_then(|[found, expected]| {
            term(weights.joint, &|| frame_weights.compare(recipe.joint, compared(found), compared(expected)))
        }),
        velocity: term(weights.velocity, &|| frame_weights.compare(recipe.velocity, local(&decoded), local(&features))),
        feet: change(weights.feet, recipe.feet, &feet, Derivative::Velocity, None),
        contact: change(weights.contact, recipe.contact, &feet, Derivative::Velocity, standing),
        joint_velocity: change(weights.joint_velocity, recipe.joint_velocity, &all, Derivative::Velocity, None),
        joint_acceleration: change(
            weights.joint_acceleration,
            recipe.joint_acceleration,
            &all,
            Derivative::Acceleration,
            None,
        ),
        kl: term(weights.kl, &|| kl(posterior)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use motion::features::recover_joints;
    use protocol::stage::DataFormat;

    /// Rows that turn, walk and wobble.
    fn rows(skeleton: &Skeleton, frames: usize, seed: usize) -> Vec<f32> {
        let value = |t: usize, k: usize| ((t * 7 + k * 13 + seed * 5) as f32 * 0.37).sin();
        let scale = |k: usize| if k < 3 { 0.05 } else { 0.8 };
        (0..frames).flat_map(|t| (0..skeleton.features).map(move |k| scale(k) * value(t, k))).collect()
    }

    /// A body whose features are not normalised.
    fn plain(skeleton: &'static Skeleton) -> Body {
        Body::new(skeleton, &vec![0.0; skeleton.features], &vec![1.0; skeleton.features], &Device::flex())
    }

    #[test]
    fn joints_are_those_of_the_data_code() {
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            for frames in [1, 2, 60] {
                let skeleton = Skeleton::of(format);
                let clips: Vec<Vec<f32>> = (0..3).map(|seed| rows(skeleton, frames, seed)).collect();
                let data = TensorData::new(clips.concat(), [3, frames, skeleton.features]);
                let found = plain(skeleton).joints(Tensor::from_data(data, &Device::flex()));
                assert_eq!(found.dims(), [3, frames, skeleton.joints, 3]);
                let expected: Vec<f32> = clips.iter().flat_map(|c| recover_joints(c, skeleton)).collect();
                let data = found.into_data();
                for (f, e) in data.as_slice::<f32>().unwrap().iter().zip(&expected) {
                    assert!((f - e).abs() < 2e-5, "{format:?}, {frames} frames: {f} instead of {e}");
                }
            }
        }
    }

    #[test]
    fn gradients_of_joints_agree_with_differences() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let frames = 6;
        let device = Device::flex();
        let base = rows(skeleton, frames, 1);
        let loss = |x: Tensor<3>| {
            let found = plain(skeleton).joints(x);
            let n = found.shape().num_elements();
            let weights: Vec<f32> = (0..n).map(|i| (i as f32 * 0.71).cos()).collect();
            let weights = Tensor::<4>::from_data(TensorData::new(weights, found.dims()), &found.device());
            (found * weights).sum()
        };
        let at = |values: &[f32], device: &Device| {
            Tensor::<3>::from_data(TensorData::new(values.to_vec(), [1, frames, skeleton.features]), device)
        };
        let x = at(&base, &device.clone().autodiff()).require_grad();
        let gradients = loss(x.clone()).backward();
        let found = x.grad(&gradients).unwrap().into_data();
        let found = found.as_slice::<f32>().unwrap();
        let number = |x: Tensor<3>| loss(x).into_data().as_slice::<f32>().unwrap()[0];
        for (t, k) in [(0, 0), (2, 0), (1, 1), (3, 2), (4, 3), (2, 10), (5, 40), (5, 0), (3, 200)] {
            let i = t * skeleton.features + k;
            let h = 4e-3;
            let mut moved = base.clone();
            moved[i] += h;
            let up = number(at(&moved, &device));
            moved[i] -= 2.0 * h;
            let slope = (up - number(at(&moved, &device))) / (2.0 * h);
            assert!(
                (slope - found[i]).abs() < 1e-2 * (1.0 + slope.abs()),
                "row {t} feature {k}: {} and {slope}",
                found[i]
            );
        }
    }

    #[test]
    fn feet_cost_what_they_slide() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let device = Device::flex();
        let body = Body::new(skeleton, &vec![0.0; skeleton.features], &vec![1.0; skeleton.features], &device);
        let stands = vec![0.0; 2 * 5 * skeleton.features];
        let mut glides = stands.clone();
        // The second clip has three frames and glides ahead by a decimetre a frame: 2 m/s. Frames after its end have no
        // effect.
        for t in 0..5 {
            glides[(5 + t) * skeleton.features + 2] = if t < 2 { 0.1 } else { 7.0 };
        }
        let rows =
            |values: &[f32]| Tensor::from_data(TensorData::new(values.to_vec(), [2, 5, skeleton.features]), &device);
        let weights = VaeLoss { feature: 0.0, joint: 0.0, feet: 3.0, kl: 0.0, ..VaeLoss::default() };
        let zeros = || Tensor::zeros([2, 1, 1], &device);
        let posterior = Posterior { mu_bnd: zeros(), logvar_bnd: zeros() };
        let terms = vae(&weights.into(), &body, rows(&glides), rows(&stands), &posterior, &[5, 3]);
        assert!(terms.joint.is_none() && terms.feature.is_none());
        let found = terms.feet.expect("it has a weight").into_data().as_slice::<f32>().unwrap()[0];
        // One axis of three counts; smooth L1 of 2 is 1.5.
        assert!((found - 3.0 * 1.5 / 3.0).abs() < 1e-5, "{found}");

        // One ankle of the second clip stands in the first frame.
        let mut lands = stands;
        lands[5 * skeleton.features + skeleton.layout().contacts.start] = 1.0;
        let weights = VaeLoss { feature: 0.0, joint: 0.0, contact: 3.0, kl: 0.0, ..VaeLoss::default() };
        let terms = vae(&weights.into(), &body, rows(&glides), rows(&lands), &posterior, &[5, 3]);
        let found = terms.contact.expect("it has a weight").into_data().as_slice::<f32>().unwrap()[0];
        // One axis of twelve counts, in one of the clip's two steps.
        assert!((found - 3.0 * 1.5 / 12.0 / 2.0).abs() < 1e-5, "{found}");
    }

    #[test]
    fn accelerations_cost_what_shakes() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let device = Device::flex();
        let body = Body::new(skeleton, &vec![0.0; skeleton.features], &vec![1.0; skeleton.features], &device);
        let stands = vec![0.0; 5 * skeleton.features];
        let mut shakes = stands.clone();
        // The height of all joints but the root goes up and down by .001 m each frame: 1.6 m/s^2 twice a frame.
        let positions = skeleton.layout().positions;
        for t in 0..5 {
            for i in positions.clone().skip(1).step_by(3) {
                shakes[t * skeleton.features + i] = if t % 2 == 0 { 0.001 } else { -0.001 };
            }
        }
        let rows =
            |values: &[f32]| Tensor::from_data(TensorData::new(values.to_vec(), [1, 5, skeleton.features]), &device);
        let weights = VaeLoss { feature: 0.0, joint: 0.0, joint_acceleration: 2.0, kl: 0.0, ..VaeLoss::default() };
        let zeros = || Tensor::zeros([1, 1, 1], &device);
        let posterior = Posterior { mu_bnd: zeros(), logvar_bnd: zeros() };
        let terms = vae(&weights.into(), &body, rows(&shakes), rows(&stands), &posterior, &[5]);
        assert!(terms.joint.is_none() && terms.joint_velocity.is_none() && terms.feet.is_none());
        let found = terms.joint_acceleration.expect("it has a weight").into_data().as_slice::<f32>().unwrap()[0];
        // Smooth L1 of 4 x .001 x 20^2 = 1.6 is 1.1; one axis of three, 21 joints of 22.
        let expected = 2.0 * 1.1 / 3.0 * 21.0 / 22.0;
        assert!((found - expected).abs() < 1e-4, "{found}, expected {expected}");
    }

    #[test]
    fn slices_add_up_to_the_batch() {
        let device = Device::flex();
        let make = |seed: usize| {
            let values = (0..4 * 5 * 3).map(|i| ((i + seed) as f32 * 0.3).sin() * 2.0).collect::<Vec<_>>();
            Tensor::<3>::from_data(TensorData::new(values, [4, 5, 3]), &device)
        };
        let part = |x: &Tensor<3>, r: std::ops::Range<usize>| x.clone().slice([r, 0..5, 0..3]);
        let number = |x: Tensor<1>| x.into_data().as_slice::<f32>().unwrap()[0];
        let a = make(0);
        let b = make(9);
        let lengths = [5, 2, 3, 1];
        let masked = |r: std::ops::Range<usize>| {
            let weights = FrameWeights::masked(&lengths[r.clone()], 5, &device);
            number(weights.compare(Pointwise::SmoothL1, part(&a, r.clone()), part(&b, r)))
        };
        assert!((masked(0..4) - masked(0..1) - masked(1..4)).abs() < 1e-5);
        let huber = |r: std::ops::Range<usize>| number(pseudo_huber(part(&a, r.clone()), part(&b, r), 0.5));
        assert!((huber(0..4) - huber(0..3) - huber(3..4)).abs() < 1e-5);
    }

    #[test]
    fn undecided_scores_cost_the_known_amounts() {
        let zeros = || vec![Tensor::<3>::zeros([2, 3, 1], &Device::flex()); 4];
        let number = |x: Tensor<1>| x.into_data().as_slice::<f32>().unwrap()[0] / 2.0;
        assert_eq!(number(hinge_discriminator(zeros(), zeros())), 2.0);
        assert_eq!(number(hinge_generator(zeros())), 1.0);
    }
}
