//! Joint positions of feature rows, and velocities and accelerations of joints, each in one pass.
//!
//! The turn feature is half the yaw increment, so twice its running sum is the yaw. Row t holds the increment from frame
//! t to t + 1; turn and velocity of the last row are not used. Derived by hand: a gradient of a running sum is the
//! running sum of gradients from the end.

use burn::tensor::Tensor;
use motion::skeleton::Skeleton;

#[cfg(feature = "flex")]
use super::fused;

/// `scale` times the global joints [B, T, J, 3] of `features` [B, T, D], which `mean` and `std` [1, 1, D] normalise.
pub fn joints(
    features: Tensor<3>,
    mean: Tensor<3>,
    std: Tensor<3>,
    scale: f64,
    skeleton: &'static Skeleton,
) -> Tensor<4> {
    #[expect(clippy::cast_possible_truncation, reason = "a unit")]
    let scale = scale as f32;
    #[cfg(feature = "flex")]
    if fused::takes(&features) {
        return fused::run(kernel::Joints { skeleton, scale }, [features.into(), mean.into(), std.into()]);
    }
    composed(features * std + mean, skeleton) * scale
}

/// A derivative of a joint's path by time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Derivative {
    /// Difference of neighbouring frames.
    Velocity,
    /// Difference of neighbouring velocities.
    Acceleration,
}

impl Derivative {
    /// Number of frames by which it is shorter than the path.
    pub const fn order(self) -> usize {
        match self {
            Self::Velocity => 1,
            Self::Acceleration => 2,
        }
    }

    /// Factors on successive frames.
    const fn factors(self) -> &'static [f32] {
        match self {
            Self::Velocity => &[-1.0, 1.0],
            Self::Acceleration => &[1.0, -2.0, 1.0],
        }
    }
}

/// The derivative [B, T - order, 3 per joint] of the joints `which`, at `fps` frames a second. `joints` [B, T, J, 3],
/// with more frames than the derivative's order.
pub fn joint_derivative(joints: Tensor<4>, which: &[usize], derivative: Derivative, fps: f64) -> Tensor<3> {
    #[expect(clippy::cast_possible_truncation, reason = "frames per second, at most squared")]
    let rate = (0..derivative.order()).fold(1.0, |rate, _| rate * fps) as f32;
    #[cfg(feature = "flex")]
    if fused::takes(&joints) {
        return fused::run(kernel::Change { which: which.to_vec(), derivative, rate }, [joints.into()]);
    }
    let [batch, frames, _, _] = joints.dims();
    let width = 3 * which.len();
    let one = |j: &usize| joints.clone().slice([0..batch, 0..frames, *j..j + 1, 0..3]);
    let chosen = Tensor::cat(which.iter().map(one).collect(), 2).reshape([batch, frames, width]);
    let left = frames - derivative.order();
    let from = |(t, factor): (usize, &f32)| chosen.clone().slice([0..batch, t..t + left, 0..width]) * *factor;
    let terms = derivative.factors().iter().enumerate().map(from);
    terms.reduce(|sum, term| sum + term).expect("a derivative has factors") * rate
}

/// Joints of features that are not normalised.
fn composed(features: Tensor<3>, skeleton: &Skeleton) -> Tensor<4> {
    let [batch, frames, _] = features.dims();
    let device = features.device();
    let others = skeleton.joints - 1;
    let columns = |range: std::ops::Range<usize>| features.clone().slice([0..batch, 0..frames, range]);
    // Row t holds the increment that leads *to* frame t; the first row is zero.
    let before = |x: Tensor<3>| {
        let width = x.dims()[2];
        let first = Tensor::zeros([batch, 1, width], &device);
        if frames == 1 {
            return first;
        }
        Tensor::cat(vec![first, x.slice([0..batch, 0..frames - 1, 0..width])], 1)
    };
    let yaw = before(columns(0..1)).cumsum(1) * 2.0;
    let sin = yaw.clone().sin();
    let cos = yaw.cos();

    let step_x = before(columns(1..2));
    let step_z = before(columns(2..3));
    let root_x = (cos.clone() * step_x.clone() - sin.clone() * step_z.clone()).cumsum(1);
    let root_z = (sin.clone() * step_x + cos.clone() * step_z).cumsum(1);
    let root = Tensor::cat(vec![root_x.clone(), columns(3..4), root_z.clone()], 2).reshape([batch, frames, 1, 3]);

    let local = columns(skeleton.layout().positions).reshape([batch, frames, others, 3]);
    let axis = |k: usize| local.clone().slice([0..batch, 0..frames, 0..others, k..k + 1]);
    let wide = |x: Tensor<3>| x.reshape([batch, frames, 1, 1]);
    let x = axis(0);
    let z = axis(2);
    let sin = wide(sin);
    let cos = wide(cos);
    let turned_x = cos.clone() * x.clone() - sin.clone() * z.clone() + wide(root_x);
    let turned_z = sin * x + cos * z + wide(root_z);
    Tensor::cat(vec![root, Tensor::cat(vec![turned_x, axis(1), turned_z], 3)], 2)
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;
    use motion::skeleton::Skeleton;

    use super::Derivative;
    use crate::kernels::fused::{Fused, make, shape, slice};

    /// Feature columns of turn, velocity along x and z, and height.
    const TURN: usize = 0;
    const STEP_X: usize = 1;
    const STEP_Z: usize = 2;
    const HEIGHT: usize = 3;

    #[derive(Debug, Clone)]
    pub(super) struct Joints {
        pub(super) skeleton: &'static Skeleton,
        pub(super) scale: f32,
    }

    /// Sine and cosine of a frame's yaw, and the root's step to the frame in the heading frame.
    #[derive(Debug, Clone, Copy)]
    pub(super) struct Heading {
        sin: f32,
        cos: f32,
        step_x: f32,
        step_z: f32,
    }

    impl Joints {
        /// The headings of a clip's frames.
        fn headings(&self, clip: &[f32], mean: &[f32], std: &[f32]) -> Vec<Heading> {
            let width = self.skeleton.features;
            let mut turned = 0.0;
            let mut headings = Vec::with_capacity(clip.len() / width);
            for t in 0..clip.len() / width {
                let mut step_x = 0.0;
                let mut step_z = 0.0;
                if t > 0 {
                    let value = |k: usize| clip[(t - 1) * width + k] * std[k] + mean[k];
                    turned += value(TURN);
                    (step_x, step_z) = (value(STEP_X), value(STEP_Z));
                }
                let (sin, cos) = (turned * 2.0_f32).sin_cos();
                headings.push(Heading { sin, cos, step_x, step_z });
            }
            headings
        }

        /// Appends the joints of a clip.
        fn place(&self, clip: &[f32], mean: &[f32], std: &[f32], headings: &[Heading], out: &mut Vec<f32>) {
            let at = self.skeleton.layout().positions;
            let mean_at = &mean[at.clone()];
            let std_at = &std[at.clone()];
            let mut root_x = 0.0;
            let mut root_z = 0.0;
            for (row, heading) in clip.chunks_exact(self.skeleton.features).zip(headings) {
                let Heading { sin, cos, step_x, step_z } = *heading;
                root_x += cos * step_x - sin * step_z;
                root_z += sin * step_x + cos * step_z;
                let height = row[HEIGHT] * std[HEIGHT] + mean[HEIGHT];
                out.extend([root_x, height, root_z].map(|v| v * self.scale));
                let row = &row[at.clone()];
                for j in (0..row.len()).step_by(3) {
                    let value = |k: usize| row[j + k] * std_at[j + k] + mean_at[j + k];
                    let x = value(0);
                    let z = value(2);
                    let joint = [cos * x - sin * z + root_x, value(1), sin * x + cos * z + root_z];
                    out.extend(joint.map(|v| v * self.scale));
                }
            }
        }

        /// Writes the gradient of a clip's features to `out`, from `dout` of its joints.
        fn gradient(
            &self,
            clip: &[f32],
            mean: &[f32],
            std: &[f32],
            headings: &[Heading],
            dout: &[f32],
            out: &mut [f32],
        ) {
            let width = self.skeleton.features;
            let at = self.skeleton.layout().positions;
            let mean_at = &mean[at.clone()];
            let std_at = &std[at.clone()];
            // Gradients of the root's place and of the sum of turns, summed from the last frame to this one.
            let mut root_x = 0.0;
            let mut root_z = 0.0;
            let mut turned = 0.0;
            for (t, heading) in headings.iter().enumerate().rev() {
                let Heading { sin, cos, step_x, step_z } = *heading;
                let row = &clip[t * width..][..width][at.clone()];
                let to = &mut out[t * width..][..width];
                let dout = &dout[t * 3 * self.skeleton.joints..][..3 * self.skeleton.joints];
                to[HEIGHT] = dout[1] * self.scale * std[HEIGHT];
                let mut sum_x = dout[0] * self.scale;
                let mut sum_z = dout[2] * self.scale;
                let mut dsin = 0.0;
                let mut dcos = 0.0;
                let to = &mut to[at.clone()];
                for (j, d) in dout[3..].chunks_exact(3).enumerate() {
                    let value = |k: usize| row[3 * j + k] * std_at[3 * j + k] + mean_at[3 * j + k];
                    let x = value(0);
                    let z = value(2);
                    let dx = d[0] * self.scale;
                    let dy = d[1] * self.scale;
                    let dz = d[2] * self.scale;
                    sum_x += dx;
                    sum_z += dz;
                    dsin += x * dz - z * dx;
                    dcos += x * dx + z * dz;
                    to[3 * j] = (cos * dx + sin * dz) * std_at[3 * j];
                    to[3 * j + 1] = dy * std_at[3 * j + 1];
                    to[3 * j + 2] = (cos * dz - sin * dx) * std_at[3 * j + 2];
                }
                root_x += sum_x;
                root_z += sum_z;
                dcos += root_x * step_x + root_z * step_z;
                dsin += root_z * step_x - root_x * step_z;
                turned += 2.0 * (dsin * cos - dcos * sin);
                if t > 0 {
                    let before = &mut out[(t - 1) * width..][..width];
                    before[TURN] = turned * std[TURN];
                    before[STEP_X] = (root_x * cos + root_z * sin) * std[STEP_X];
                    before[STEP_Z] = (root_z * cos - root_x * sin) * std[STEP_Z];
                }
            }
        }
    }

    impl Fused<3> for Joints {
        type Kept = ([FlexTensor; 3], Vec<Heading>);

        fn forward(&self, inputs: [FlexTensor; 3]) -> (FlexTensor, Self::Kept) {
            let [features, mean, std] = inputs.each_ref().map(slice);
            let sizes = shape(&inputs[0]);
            let batch = sizes[0];
            let frames = sizes[1];
            let mut out = Vec::with_capacity(batch * frames * 3 * self.skeleton.joints);
            let mut headings = Vec::with_capacity(batch * frames);
            for clip in features.chunks_exact(frames * self.skeleton.features) {
                let own = self.headings(clip, mean, std);
                self.place(clip, mean, std, &own, &mut out);
                headings.extend(own);
            }
            (make(out, &[batch, frames, self.skeleton.joints, 3]), (inputs, headings))
        }

        /// # Panics
        /// If a gradient of the normalisation is wanted.
        fn backward(
            &self,
            (inputs, headings): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 3],
        ) -> [Option<FlexTensor>; 3] {
            assert!(!wanted[1] && !wanted[2], "a normalisation is constant");
            let [features, mean, std] = inputs.each_ref().map(slice);
            let frames = shape(&inputs[0])[1];
            // Features that joints do not depend on have no gradient.
            let mut out = vec![0.0; features.len()];
            let clips = features.chunks_exact(frames * self.skeleton.features);
            let places = out.chunks_exact_mut(frames * self.skeleton.features);
            let gradients = slice(&dy).chunks_exact(frames * 3 * self.skeleton.joints);
            for (((clip, to), dout), own) in clips.zip(places).zip(gradients).zip(headings.chunks_exact(frames)) {
                self.gradient(clip, mean, std, own, dout, to);
            }
            [Some(make(out, &shape(&inputs[0]))), None, None]
        }
    }

    #[derive(Debug, Clone)]
    pub(super) struct Change {
        pub(super) which: Vec<usize>,
        pub(super) derivative: Derivative,
        pub(super) rate: f32,
    }

    impl Change {
        /// Coordinates of the joints in a frame.
        fn coordinates(&self) -> Vec<usize> {
            self.which.iter().flat_map(|j| 3 * j..3 * j + 3).collect()
        }
    }

    impl Fused<1> for Change {
        /// The shape of the joints.
        type Kept = Vec<usize>;

        fn forward(&self, [joints]: [FlexTensor; 1]) -> (FlexTensor, Vec<usize>) {
            let sizes = shape(&joints);
            let batch = sizes[0];
            let frames = sizes[1];
            let width = 3 * sizes[2];
            let coordinates = self.coordinates();
            let left = frames - self.derivative.order();
            let mut out = Vec::with_capacity(batch * left * coordinates.len());
            for clip in slice(&joints).chunks_exact(frames * width) {
                for t in 0..left {
                    let from = &clip[t * width..];
                    match self.derivative {
                        Derivative::Velocity => {
                            out.extend(coordinates.iter().map(|i| (from[width + i] - from[*i]) * self.rate));
                        }
                        Derivative::Acceleration => out.extend(
                            coordinates
                                .iter()
                                .map(|i| (from[2 * width + i] - 2.0 * from[width + i] + from[*i]) * self.rate),
                        ),
                    }
                }
            }
            (make(out, &[batch, left, coordinates.len()]), sizes)
        }

        fn backward(&self, sizes: Vec<usize>, dy: FlexTensor, _: [bool; 1]) -> [Option<FlexTensor>; 1] {
            let frames = sizes[1];
            let width = 3 * sizes[2];
            let coordinates = self.coordinates();
            let left = frames - self.derivative.order();
            let mut out = vec![0.0; sizes.iter().product()];
            let gradients = slice(&dy).chunks_exact(left * coordinates.len());
            for (clip, dy) in out.chunks_exact_mut(frames * width).zip(gradients) {
                for (t, dy) in dy.chunks_exact(coordinates.len()).enumerate() {
                    for (k, factor) in self.derivative.factors().iter().enumerate() {
                        let to = &mut clip[(t + k) * width..][..width];
                        for (i, d) in coordinates.iter().zip(dy) {
                            to[*i] += d * (self.rate * factor);
                        }
                    }
                }
            }
            [Some(make(out, &sizes))]
        }
    }
}
