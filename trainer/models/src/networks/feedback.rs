//! The feedback network: predicts a change of a latent from its decoded motion and the distance of that from the
//! target. Source: iterative error feedback (Carreira et al., CVPR 2016) and learned descent (Song et al., ECCV 2020),
//! which fit poses to images this way; ours fits motions.
//!
//! It is a transformer over the N tokens of the latent and the frames of its motion. The first N outputs pass a Linear
//! that is initialised to zero and are the change. So a fresh network changes nothing.

use burn::module::{Module, Param};
use burn::tensor::Tensor;
use protocol::stage::{LatentShape, Network};

use super::vae::Positions;
use super::{Init, Linear, SkipStack, StackConfig};
use crate::kernels::{Dropout, KeyMask};

/// Size of a feedback network.
#[derive(Debug, Clone, PartialEq)]
pub struct FeedbackConfig {
    /// Shape N x d of a latent.
    pub latent: LatentShape,
    /// Inputs per frame.
    pub inputs: usize,
    /// Size of the transformer, whose dropout is an argument of each pass.
    pub network: Network,
}

/// The feedback network.
#[derive(Module, Debug)]
pub struct Feedback {
    /// Learned tokens [N, H].
    pub latent_token: Param<Tensor<2>>,
    /// d -> H.
    pub latent_embedding: Linear,
    /// Inputs of a frame -> H.
    pub frame_embedding: Linear,
    /// Positions of tokens and frames.
    pub position_encoder: Positions,
    pub encoder: SkipStack,
    /// H -> d.
    pub change: Linear,
}

impl Feedback {
    /// Creates a network with initial weights.
    pub fn new(config: &FeedbackConfig, init: &mut Init<'_>) -> Self {
        let LatentShape { tokens, dim } = config.latent;
        let width = config.network.width;
        Self {
            latent_token: init.normal([tokens, width]),
            latent_embedding: Linear::new(init, dim, width),
            frame_embedding: Linear::new(init, config.inputs, width),
            position_encoder: Positions::new(init, width),
            encoder: SkipStack::new(init, &StackConfig::of(&config.network)),
            change: Linear::zero(init, width, dim),
        }
    }

    /// The change [B, N, d] of latents [B, N, d]. `frames_btf` [B, T, inputs] describes their motions; motion b has
    /// `lengths[b]` frames.
    ///
    /// # Panics
    /// If a motion is longer than there are positions.
    pub fn forward(
        &self,
        latent_bnd: Tensor<3>,
        frames_btf: Tensor<3>,
        lengths: &[usize],
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let [batch, tokens, _] = latent_bnd.dims();
        let [_, frames, _] = frames_btf.dims();
        let width = self.latent_token.dims()[1];
        let own = self.latent_token.val().reshape([1, tokens, width]);
        let latent = self.latent_embedding.forward(latent_bnd) + own;
        let x = Tensor::cat(vec![latent, self.frame_embedding.forward(frames_btf)], 1);
        let x = x + self.position_encoder.rows(tokens + frames);
        let mask = KeyMask::new(lengths, tokens);
        let out = self.encoder.forward(x, None, Some(&mask), dropout);
        self.change.forward(out.slice([0..batch, 0..tokens, 0..width]))
    }
}
