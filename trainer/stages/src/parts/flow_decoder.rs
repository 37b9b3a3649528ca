//! Trained flow decoders from artifacts: they convert token ids or latents to motion along a rectified flow. Source:
//! DisCoRD (Cho et al., arXiv:2411.19527).
//!
//! Arrays are those of [`crate::parts::tokenizer`]: ids `[tokens, Q]`, normalised rows `[4 tokens, features]`. Clips are
//! decoded one by one, so that padding after a clip's end does not affect it.
//!
//! A VAE's latent has no time axis, so its codes are computed by the VAE's own decoder: a code is the normalised rows
//! of four frames, one after the other. That is our choice; the paper decodes only tokens.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::device::host;
use models::flat::{self, Values};
use models::flow::{Solver, between, follow, jump};
use models::kernels::Dropout;
use models::networks::{DitConfig, FlowDit, FlowUnet, Init, Projection, TimeFeatures, UnetConfig};
use motion::Stream;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, FlowBackbone, FlowNetwork, FlowPrediction, FlowProjection, FlowSolver};
use protocol::{Digest, Manifest};
use serde::{Deserialize, Serialize};

use super::latent_networks::Autoencoder;
use super::tokenizer::TrainedTokenizer;
use super::warm_start::WarmStart;
use super::weights;
use crate::artifacts;
use crate::context::StageError;

/// Widths of the U-Net's two levels as multiples of the first.
const MULTIPLES: [usize; 2] = [1, 2];
/// Width of a head of the U-Net's attention in the middle.
pub(crate) const HEAD: usize = 32;
/// Feed-forward width of the transformer as a multiple of its width.
const RATE: usize = 4;
/// Frames of a code.
pub const UNIT: usize = 4;
/// Base of the time's frequencies.
const THETA: f64 = 10_000.0;

/// Lower limit of the remaining time in the conversion to a velocity. It is less than half the last step of any solver
/// in use.
const LEAST: f32 = 0.01;

/// Meta of an artifact of kind `flow-decoder`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FlowMeta {
    /// Format of the training data.
    pub format: DataFormat,
    /// Width of a feature vector.
    pub features: usize,
    /// Width of a code: four frames of a VAE.
    pub code_dim: usize,
    /// Network that predicts the velocity.
    pub backbone: FlowBackbone,
    /// Quantity that the network predicts.
    pub prediction: FlowPrediction,
    /// Size of the network.
    pub network: FlowNetwork,
    /// Path from noise to motion.
    pub solver: FlowPath,
    /// Steps of the solver.
    pub steps: usize,
    /// The part that it was trained with: the tokenizer, or the VAE, whose codes it reads.
    pub fits: Parts,
}

/// Path from noise to motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FlowPath {
    /// The flow with one evaluation of the network per step.
    Euler,
    /// The flow with two evaluations of the network per step.
    Midpoint,
    /// A student's jumps to the data, with fresh noise between them.
    Jumps,
}

impl From<FlowSolver> for FlowPath {
    fn from(solver: FlowSolver) -> Self {
        match solver {
            FlowSolver::Euler => Self::Euler,
            FlowSolver::Midpoint => Self::Midpoint,
        }
    }
}

impl FlowPath {
    /// The solver that follows the flow; `None` for jumps.
    pub fn followed(self) -> Option<Solver> {
        match self {
            Self::Euler => Some(Solver::Euler),
            Self::Midpoint => Some(Solver::Midpoint),
            Self::Jumps => None,
        }
    }
}

/// The network of either backbone.
#[derive(Debug, Clone)]
#[expect(clippy::large_enum_variant, reason = "there is one of it")]
pub(crate) enum Backbone {
    Unet(FlowUnet),
    Dit(FlowDit),
}

/// The velocity at any point and time.
#[derive(Debug, Clone)]
pub(crate) struct Field {
    pub(crate) backbone: Backbone,
    prediction: FlowPrediction,
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

    /// Creates a network with initial weights.
    pub(crate) fn field(&self, init: &mut Init<'_>) -> Field {
        let backbone = match self.backbone {
            FlowBackbone::Unet => Backbone::Unet(FlowUnet::new(&self.unet(), init)),
            FlowBackbone::Dit => Backbone::Dit(FlowDit::new(&self.dit(), init)),
        };
        Field { backbone, prediction: self.prediction }
    }
}

impl Backbone {
    fn forward(&self, x_btf: Tensor<3>, times: &[f32], codes_bnd: Tensor<3>, dropout: &mut Dropout) -> Tensor<3> {
        match self {
            Self::Unet(network) => network.forward(x_btf, times, codes_bnd, dropout),
            Self::Dit(network) => network.forward(x_btf, times, codes_bnd, None, None, dropout),
        }
    }
}

impl Field {
    /// Reads the parameters in declaration order.
    pub(crate) fn params(&self) -> Vec<f32> {
        match &self.backbone {
            Backbone::Unet(network) => flat::read(network),
            Backbone::Dit(network) => flat::read(network),
        }
    }

    /// Loads the initial weights of a warm start.
    ///
    /// # Errors
    /// If the network of `init` predicts another quantity: its shapes would fit, but its weights would be meaningless
    /// here.
    pub(crate) fn begun_with(self, start: &mut WarmStart) -> Result<Self, StageError> {
        if let Some(theirs) = start.part() {
            let theirs: FlowMeta = artifacts::meta(theirs, "the flow decoder of `init`")?;
            if theirs.prediction != self.prediction {
                return Err(StageError::Input(format!(
                    "the network of `init` predicts the {}, but this stage trains one that predicts the {}; use a \
                     decoder with the same `prediction`",
                    theirs.prediction.name(),
                    self.prediction.name()
                )));
            }
        }
        let backbone = match self.backbone {
            Backbone::Unet(network) => Backbone::Unet(start.take(network, "")?),
            Backbone::Dit(network) => Backbone::Dit(start.take(network, "")?),
        };
        Ok(Self { backbone, ..self })
    }

    /// Replaces the parameters.
    pub(crate) fn take(&mut self, params: Values<'_>) {
        match &mut self.backbone {
            Backbone::Unet(network) => params.assign(network),
            Backbone::Dit(network) => params.assign(network),
        }
    }

    /// The velocity [B, T, F] at `times`, given codes [B, T / 4, d].
    pub(crate) fn velocity(
        &self,
        x_btf: Tensor<3>,
        times: &[f32],
        codes_bnd: Tensor<3>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let found = self.backbone.forward(x_btf.clone(), times, codes_bnd, dropout);
        match self.prediction {
            FlowPrediction::Velocity => found,
            FlowPrediction::Data => {
                let rates: Vec<f32> = times.iter().map(|t| 1.0 / (1.0 - t).max(LEAST)).collect();
                let count = rates.len();
                let rates = Tensor::<3>::from_data(TensorData::new(rates, [count, 1, 1]), &x_btf.device());
                (found - x_btf) * rates
            }
        }
    }

    /// The network's output at `times`, on mixtures of data and noise, and its target, each [B, T, F].
    pub(crate) fn compared(
        &self,
        (data_btf, noise_btf): (Tensor<3>, Tensor<3>),
        times: &[f32],
        codes_bnd: Tensor<3>,
        dropout: &mut Dropout,
    ) -> (Tensor<3>, Tensor<3>) {
        let mixed = between(data_btf.clone(), noise_btf.clone(), times);
        let found = self.backbone.forward(mixed, times, codes_bnd, dropout);
        match self.prediction {
            FlowPrediction::Velocity => (found, data_btf - noise_btf),
            FlowPrediction::Data => (found, data_btf),
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
    /// Reads an artifact of kind `flow-decoder` for a tokenizer or a VAE, given as its role among parts and its digest.
    ///
    /// # Errors
    /// If it was trained on another one.
    pub fn read(
        blobs: &dyn Blobs,
        manifest: &Manifest,
        (role, encoder): (&Role, Digest),
        device: &Device,
    ) -> Result<Self, StageError> {
        let meta: FlowMeta = artifacts::meta(manifest, "the flow decoder")?;
        if meta.fits.get(role) != Some(&encoder) {
            let what = match meta.fits.contains_key(role) {
                true => format!("another {role}"),
                false => meta.fits.keys().map(|other| format!("a {other} instead of a {role}")).collect(),
            };
            return Err(StageError::Input(format!(
                "the flow decoder was trained with {what}; use the {role} that it was trained with"
            )));
        }
        let device = device.clone().inner();
        let what = "the flow decoder's weights";
        let blank = meta.field(&mut Init::blank(&device));
        let backbone = match blank.backbone {
            Backbone::Unet(network) => Backbone::Unet(weights::load(network, blobs, manifest, what)?),
            Backbone::Dit(network) => Backbone::Dit(weights::load(network, blobs, manifest, what)?),
        };
        Ok(Self { field: Field { backbone, ..blank }, meta, device })
    }

    /// Changes the number of steps.
    #[must_use]
    pub fn with_steps(mut self, steps: usize) -> Self {
        self.meta.steps = steps;
        self
    }

    /// The network, on the plain device.
    pub(crate) fn into_field(self) -> Field {
        self.field
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &FlowMeta {
        &self.meta
    }

    /// Decodes one motion's ids `[tokens, Q]` to normalised rows `[4 tokens, features]`, from noise of `stream`.
    pub fn decode(&self, tokenizer: &TrainedTokenizer, ids: &[i64], stream: &mut Stream) -> Vec<f32> {
        self.decode_codes(tokenizer.codes(ids), stream)
    }

    /// Decodes a VAE's latent `[N, d]` to normalised rows `[frames, features]`, from noise of `stream`.
    pub fn decode_latent(&self, vae: &Autoencoder, z: Vec<f32>, frames: usize, stream: &mut Stream) -> Vec<f32> {
        let mut rows = self.decode_codes(vae.decode(z, frames.next_multiple_of(UNIT)), stream);
        rows.truncate(frames * self.meta.features);
        rows
    }

    /// Decodes codes `[tokens, code_dim]` to normalised rows `[4 tokens, features]`.
    fn decode_codes(&self, codes: Vec<f32>, stream: &mut Stream) -> Vec<f32> {
        let tokens = codes.len() / self.meta.code_dim;
        let frames = tokens * UNIT;
        let mut noise = vec![0.0; frames * self.meta.features];
        stream.fill_normal(&mut noise);
        let tensor =
            |values: Vec<f32>, shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values, shape), &self.device);
        let codes = tensor(codes, [1, tokens, self.meta.code_dim]);
        let noise = tensor(noise, [1, frames, self.meta.features]);
        let velocity = |x, t| self.field.velocity(x, &[t], codes.clone(), &mut Dropout::off());
        let rows = match self.meta.solver.followed() {
            Some(solver) => follow(solver, self.meta.steps, noise, velocity, |_| ()),
            None => {
                let fresh = |_| {
                    let mut noise = vec![0.0; frames * self.meta.features];
                    stream.fill_normal(&mut noise);
                    tensor(noise, [1, frames, self.meta.features])
                };
                jump(self.meta.steps, noise, velocity, fresh)
            }
        };
        host(rows)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Tolerance;
    use protocol::Seed;
    use protocol::stage::{Positions, TrainDiscord};

    use super::*;

    fn meta(prediction: FlowPrediction) -> FlowMeta {
        let settings = TrainDiscord::default();
        FlowMeta {
            format: DataFormat::Humanml3d,
            features: 6,
            code_dim: 5,
            backbone: FlowBackbone::Unet,
            prediction,
            network: FlowNetwork { width: 8, condition: 4, ..settings.network },
            solver: FlowPath::Euler,
            steps: 1,
            fits: Parts::new(),
        }
    }

    /// A network that predicts the data reaches it in one step from any point. A step of the published flow reaches the
    /// same point.
    #[test]
    fn a_step_to_the_end_arrives_at_the_data_that_is_predicted() {
        let device = Device::flex();
        let random = |shape: [usize; 3], number| {
            let mut values = vec![0.0; shape.iter().product()];
            Stream::new(Seed(4), "random", number, 0).fill_normal(&mut values);
            Tensor::<3>::from_data(TensorData::new(values, shape), &device)
        };
        let x = random([1, 16, 6], 0);
        let codes = random([1, 4, 5], 1);
        let field = |prediction| meta(prediction).field(&mut Init::new(Seed(1), "net", Positions::Uniform, &device));
        let data = field(FlowPrediction::Data);
        let given = data.backbone.forward(x.clone(), &[0.25], codes.clone(), &mut Dropout::off());
        let velocity = data.velocity(x.clone(), &[0.25], codes.clone(), &mut Dropout::off());
        let arrived = x.clone() + velocity * 0.75;
        arrived.into_data().assert_approx_eq::<f32>(&given.clone().into_data(), Tolerance::absolute(1e-5));
        let published = field(FlowPrediction::Velocity).velocity(x, &[0.25], codes, &mut Dropout::off());
        published.into_data().assert_eq(&given.into_data(), true);
    }
}
