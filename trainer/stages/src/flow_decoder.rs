//! Trained flow decoders out of artifacts: token ids to motion along a rectified flow. Source: DisCoRD (Cho et al., arXiv:2411.19527).
//!
//! Arrays are those of [`crate::tokenizer`]: ids `[tokens, Q]`, normalised rows `[4 tokens, features]`. Clips are decoded one by one, so that
//! nothing behind a clip's end flows into it.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::flow::{Solver, follow};
use models::kernels::Dropout;
use models::networks::{DitConfig, FlowDit, FlowUnet, Init, Projection, TimeFeatures, UnetConfig};
use motion::Stream;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, FlowBackbone, FlowNetwork, FlowProjection, FlowSolver, Positions};
use protocol::{Digest, Manifest, Seed};
use serde::{Deserialize, Serialize};

use crate::artifacts;
use crate::context::StageError;
use crate::tokenizer::TrainedTokenizer;
use crate::weights;

/// Widths of the U-Net's two levels, over the first.
const MULTIPLES: [usize; 2] = [1, 2];
/// Width of a head of the U-Net's attention in the middle.
const HEAD: usize = 32;
/// Feed-forward width of the transformer, over its width.
const RATE: usize = 4;
/// Base of the time's frequencies.
const THETA: f64 = 10_000.0;

/// Meta of an artifact of kind `flow-decoder`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FlowMeta {
    /// The data it was trained on.
    pub format: DataFormat,
    /// Width of a feature vector.
    pub features: usize,
    /// Width of a code.
    pub code_dim: usize,
    /// What the velocity is predicted by.
    pub backbone: FlowBackbone,
    /// Size.
    pub network: FlowNetwork,
    /// How the flow is followed.
    pub solver: FlowSolver,
    /// Steps of the solver.
    pub steps: usize,
    /// The part that it was trained with: the tokenizer whose codes it reads.
    pub fits: Parts,
}

/// The network of either backbone.
#[derive(Debug, Clone)]
#[expect(clippy::large_enum_variant, reason = "there is one of it")]
pub(crate) enum Field {
    Unet(FlowUnet),
    Dit(FlowDit),
}

impl FlowMeta {
    fn unet(&self) -> UnetConfig {
        UnetConfig {
            features: self.features,
            width: self.network.width,
            multiples: MULTIPLES.to_vec(),
            token_dim: self.code_dim,
            condition_dim: self.network.condition,
            blocks: self.network.layers,
            projection: match self.network.projection {
                FlowProjection::Stack => Projection::Stack,
                FlowProjection::Repeat => Projection::Repeat,
                FlowProjection::Transposed => Projection::Transposed,
            },
            attention: self.network.attention.then_some((self.network.heads, HEAD)),
            time: TimeFeatures::Sinusoid,
            theta: THETA,
            learned_variance: false,
        }
    }

    fn dit(&self) -> DitConfig {
        DitConfig {
            features: self.features,
            width: self.network.width,
            token_dim: self.code_dim,
            condition_dim: self.network.condition,
            heads: self.network.heads,
            rate: RATE,
            layers: self.network.layers,
            positions: false,
            alibi: true,
            text_dim: None,
        }
    }

    /// A fresh network.
    pub(crate) fn field(&self, init: &mut Init<'_>) -> Field {
        match self.backbone {
            FlowBackbone::Unet => Field::Unet(FlowUnet::new(&self.unet(), init)),
            FlowBackbone::Dit => Field::Dit(FlowDit::new(&self.dit(), init)),
        }
    }
}

impl Field {
    /// Velocity [B, T, F] at `times`, under codes [B, T / 4, d].
    pub(crate) fn velocity(
        &self,
        x_btf: Tensor<3>,
        times: &[f32],
        codes_bnd: Tensor<3>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        match self {
            Self::Unet(network) => network.forward(x_btf, times, codes_bnd, dropout),
            Self::Dit(network) => network.forward(x_btf, times, codes_bnd, None, None, dropout),
        }
    }
}

/// A trained flow decoder.
#[derive(Debug)]
pub struct FlowDecoder {
    field: Field,
    meta: FlowMeta,
    device: Device,
}

impl FlowDecoder {
    /// Reads an artifact of kind `flow-decoder` for a tokenizer.
    ///
    /// # Errors
    /// If it was trained on another one.
    pub fn read(
        blobs: &dyn Blobs,
        manifest: &Manifest,
        tokenizer: Digest,
        device: &Device,
    ) -> Result<Self, StageError> {
        let meta: FlowMeta = artifacts::meta(manifest, "the flow decoder")?;
        if meta.fits.get(&Role::TOKENIZER) != Some(&tokenizer) {
            return Err(StageError::Input(
                "the flow decoder was trained on the codes of another tokenizer; name the one that it was trained with"
                    .into(),
            ));
        }
        let device = device.clone().inner();
        let what = "the flow decoder's weights";
        let field = match meta.field(&mut Init::new(Seed(0), "blank", Positions::Uniform, &device)) {
            Field::Unet(network) => Field::Unet(weights::load(network, blobs, manifest, what)?),
            Field::Dit(network) => Field::Dit(weights::load(network, blobs, manifest, what)?),
        };
        Ok(Self { field, meta, device })
    }

    /// What it is.
    pub fn meta(&self) -> &FlowMeta {
        &self.meta
    }

    /// Normalised rows `[4 tokens, features]` of one motion's ids `[tokens, Q]`, from noise of `stream`.
    pub fn decode(&self, tokenizer: &TrainedTokenizer, ids: &[i64], stream: &mut Stream) -> Vec<f32> {
        let codes = tokenizer.codes(ids);
        let tokens = codes.len() / self.meta.code_dim;
        let frames = tokens * tokenizer.unit();
        let mut noise = vec![0.0; frames * self.meta.features];
        stream.fill_normal(&mut noise);
        let tensor =
            |values: Vec<f32>, shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values, shape), &self.device);
        let codes = tensor(codes, [1, tokens, self.meta.code_dim]);
        let noise = tensor(noise, [1, frames, self.meta.features]);
        let solver = match self.meta.solver {
            FlowSolver::Euler => Solver::Euler,
            FlowSolver::Midpoint => Solver::Midpoint,
        };
        let velocity = |x, t| self.field.velocity(x, &[t], codes.clone(), &mut Dropout::off());
        let rows = follow(solver, self.meta.steps, noise, velocity, |_| ());
        rows.into_data().try_into_vec::<f32>().expect("networks compute in f32")
    }
}
