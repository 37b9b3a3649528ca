//! MDM: predicts the clean motion from a noised motion, a timestep and a caption's vector. Source: Tevet et al.,
//! arXiv:2209.14916 (`trans_enc`).
//!
//! The sequence is a condition token (time plus text) and the frames, with sinusoidal positions. A post-norm encoder
//! follows, and all outputs but the first are used. A caption is dropped by zeroing its vector before the projection,
//! so that the projection's bias remains. The published model attends to frames of padding; its authors call the key
//! mask over them a fix, and use it in their model of 50 steps.

#![expect(non_snake_case, reason = "fields have the published names")]

use burn::module::Module;
use burn::tensor::Tensor;
use burn::tensor::activation::silu;
use protocol::stage::MdmNetwork;

use super::transformer::NORM_EPS;
use super::{Init, Layers, Linear, StackConfig, position_sinusoid};
use crate::kernels::{Dropout, KeyMask, dropout};

/// Size of an MDM.
#[derive(Debug, Clone, PartialEq)]
pub struct MdmConfig {
    /// Features per frame: 263 or 251.
    pub features: usize,
    /// Size of the transformer, whose dropout is an argument of each pass.
    pub network: MdmNetwork,
    /// Width of a caption's vector.
    pub text_dim: usize,
}

/// Features -> H.
#[derive(Module, Debug)]
pub struct InputProcess {
    /// Linear applied to every frame.
    pub poseEmbedding: Linear,
}

/// H -> features.
#[derive(Module, Debug)]
pub struct OutputProcess {
    /// Linear applied to every frame.
    pub poseFinal: Linear,
}

/// Two layers on the timestep's position sinusoid.
#[derive(Module, Debug)]
pub struct TimestepEmbedder {
    /// H -> H.
    pub time_embed_0: Linear,
    /// H -> H, after SiLU.
    pub time_embed_2: Linear,
}

/// MDM's layers under their published names.
#[derive(Module, Debug)]
pub struct Mdm {
    /// Features -> H.
    pub input_process: InputProcess,
    pub seqTransEncoder: Layers,
    /// Timestep -> H.
    pub embed_timestep: TimestepEmbedder,
    /// Caption -> H.
    pub embed_text: Linear,
    /// H -> features.
    pub output_process: OutputProcess,
}

impl Mdm {
    /// Creates a network with initial weights.
    pub fn new(config: &MdmConfig, init: &mut Init<'_>) -> Self {
        let MdmConfig { features, text_dim, .. } = *config;
        let MdmNetwork { width, layers, heads, feed_forward, .. } = config.network;
        let stack = StackConfig { width, layers, heads, feed_forward, norm_eps: NORM_EPS, memory: false };
        Self {
            input_process: InputProcess { poseEmbedding: Linear::new(init, features, width) },
            seqTransEncoder: Layers::new(init, &stack),
            embed_timestep: TimestepEmbedder {
                time_embed_0: Linear::new(init, width, width),
                time_embed_2: Linear::new(init, width, width),
            },
            embed_text: Linear::new(init, text_dim, width),
            output_process: OutputProcess { poseFinal: Linear::new(init, width, features) },
        }
    }

    /// Predicts the clean motion [B, T, F], normalised, from `x_btf` [B, T, F] at `timesteps`. `text_bc` [B, text_dim]
    /// is zero for a dropped caption. With `lengths`, frames past them are not attended to.
    pub fn forward(
        &self,
        x_btf: Tensor<3>,
        timesteps: &[usize],
        text_bc: Tensor<2>,
        lengths: Option<&[usize]>,
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let [batch, frames, _] = x_btf.dims();
        assert_eq!(timesteps.len(), batch, "one timestep a sample");
        let width = self.embed_text.weight.dims()[0];
        let device = x_btf.device();
        let time = &self.embed_timestep;
        let sinusoid = position_sinusoid(timesteps.iter().copied(), width, &device);
        let time = time.time_embed_2.forward(silu(time.time_embed_0.forward(sinusoid)));
        let condition = (self.embed_text.forward(text_bc) + time).reshape([batch, 1, width]);

        let embedded = self.input_process.poseEmbedding.forward(x_btf);
        let positions = position_sinusoid(0..frames + 1, width, &device).reshape([1, frames + 1, width]);
        let x = dropout(Tensor::cat(vec![condition, embedded], 1) + positions, drop);
        let mask = lengths.map(|lengths| KeyMask::new(lengths, 1));
        let out = self.seqTransEncoder.forward(x, mask.as_ref(), drop);
        self.output_process.poseFinal.forward(out.slice([0..batch, 1..frames + 1, 0..width]))
    }
}
