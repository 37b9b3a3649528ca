//! The trajectory encoder: computes a few tokens from the frames with joint targets. Source: MotionLCM (Dai et al.,
//! ECCV 2024; v2 of late 2024).
//!
//! The sequence is N learned tokens, then one entry per frame with the hint's joints there. The first N outputs are
//! used, in v2 after a Linear. Frames without a target would be masked, so they are left out: only the position encodes
//! a frame's place.

use burn::module::{Module, Param};
use burn::tensor::{Device, Int, Tensor, TensorData};
use protocol::stage::{LatentShape, Network};

use super::vae::Positions;
use super::{Init, Linear, POSITIONS, SkipStack, StackConfig};
use crate::kernels::{Dropout, KeyMask};

/// Number of coordinates of a joint.
const AXES: usize = 3;

/// Size of a trajectory encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TrajectoryConfig {
    /// Number of joints of the skeleton.
    pub joints: usize,
    /// Shape N x d of the tokens.
    pub latent: LatentShape,
    /// Size of the transformer, whose dropout is an argument of each pass.
    pub network: Network,
    /// Adds a Linear H -> d at the end (v2); without it d is H (v1).
    pub projection: bool,
}

/// Joint targets of a batch, for the frames that have any.
#[derive(Debug, Clone)]
pub struct Hints {
    /// Normalised coordinates [B, M, joints x 3] of those frames, then padding. Coordinates of joints without a target
    /// are zero.
    rows_bmj: Tensor<3>,
    /// Indices of those frames in the motion, 0 for padding; B x M.
    frames: Vec<usize>,
    /// Number of those frames in each motion.
    counts: Vec<usize>,
}

impl Hints {
    /// Selects the frames of normalised `values` [B, T, joints, 3] with any true entry in `given`, which has the same
    /// shape.
    ///
    /// # Panics
    /// If the two differ in length, or are not B x T x joints x 3.
    pub fn new(
        values: &[f32],
        given: &[bool],
        (batch, frames, joints): (usize, usize, usize),
        device: &Device,
    ) -> Self {
        let width = AXES * joints;
        assert_eq!((values.len(), given.len()), (batch * frames * width, batch * frames * width), "values and mask");
        let row = |b: usize, t: usize| (b * frames + t) * width..(b * frames + t + 1) * width;
        let live: Vec<Vec<usize>> =
            (0..batch).map(|b| (0..frames).filter(|t| given[row(b, *t)].contains(&true)).collect()).collect();
        // One row of padding if no motion has a target.
        let most = live.iter().map(Vec::len).max().unwrap_or_default().max(1);
        let mut rows = vec![0.0; batch * most * width];
        let mut numbers = vec![0; batch * most];
        for (b, kept) in live.iter().enumerate() {
            for (m, t) in kept.iter().enumerate() {
                let at = b * most + m;
                numbers[at] = *t;
                for ((to, from), given) in
                    rows[at * width..(at + 1) * width].iter_mut().zip(&values[row(b, *t)]).zip(&given[row(b, *t)])
                {
                    *to = if *given { *from } else { 0.0 };
                }
            }
        }
        Self {
            rows_bmj: Tensor::from_data(TensorData::new(rows, [batch, most, width]), device),
            frames: numbers,
            counts: live.iter().map(Vec::len).collect(),
        }
    }
}

/// The trajectory encoder.
#[derive(Module, Debug)]
pub struct TrajectoryEncoder {
    /// Learned tokens [N, H].
    pub global_motion_token: Param<Tensor<2>>,
    /// joints x 3 -> H.
    pub skel_embedding: Linear,
    /// Positions of tokens and frames.
    pub query_pos_encoder: Positions,
    pub encoder: SkipStack,
    /// H -> d (v2).
    pub latent_proj: Option<Linear>,
}

impl TrajectoryEncoder {
    /// Creates an encoder with initial weights.
    pub fn new(config: &TrajectoryConfig, init: &mut Init<'_>) -> Self {
        let LatentShape { tokens, dim } = config.latent;
        let width = config.network.width;
        Self {
            global_motion_token: init.normal([tokens, width]),
            skel_embedding: Linear::new(init, AXES * config.joints, width),
            query_pos_encoder: Positions::new(init, width),
            encoder: SkipStack::new(init, &StackConfig::of(&config.network)),
            latent_proj: config.projection.then(|| Linear::new(init, width, dim)),
        }
    }

    /// Encodes hints as tokens [B, N, d], the shape of a latent.
    ///
    /// # Panics
    /// If the frame of a hint has no position.
    pub fn forward(&self, hints: &Hints, dropout: &mut Dropout) -> Tensor<3> {
        let [batch, most, _] = hints.rows_bmj.dims();
        let [tokens, width] = self.global_motion_token.dims();
        let positions: Vec<i64> = hints.frames.iter().map(|t| (tokens + t) as i64).collect();
        assert!(positions.iter().all(|p| *p < POSITIONS as i64), "a hint behind the longest motion");
        let table = self.query_pos_encoder.pe.val().reshape([POSITIONS, width]);
        let indices = Tensor::<1, Int>::from_data(TensorData::new(positions, [batch * most]), &table.device());
        let at_frames = table.select(0, indices).reshape([batch, most, width]);
        let embedded = self.skel_embedding.forward(hints.rows_bmj.clone()) + at_frames;
        let own = self.global_motion_token.val().reshape([1, tokens, width]) + self.query_pos_encoder.rows(tokens);
        let x = Tensor::cat(vec![own.expand([batch, tokens, width]), embedded], 1);
        let mask = KeyMask::new(&hints.counts, tokens);
        let out = self.encoder.forward(x, None, Some(&mask), dropout).slice([0..batch, 0..tokens, 0..width]);
        match &self.latent_proj {
            Some(project) => project.forward(out),
            None => out,
        }
    }
}
