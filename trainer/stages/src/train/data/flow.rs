//! Examples for decoders along a flow: windows of motion, their codes, noise and times.
//!
//! Codes are those of a frozen tokenizer, or of a sample of a frozen VAE's posterior as in [`crate::parts::flow_decoder`].
//! Either encodes the window alone, as published. They are computed in each step instead of being kept in memory.

use burn::tensor::{Device, Tensor, TensorData};
use motion::Stream;
use protocol::artifact::Role;
use protocol::stage::{Batch, DataFormat, Training, WindowsOf};
use protocol::{ArtifactKind, Digest, Seed};

use super::windows::TokenWindows;
use crate::artifacts;
use crate::context::{GangContext, StageError};
use crate::parts::flow_decoder::{Backbone, Field, UNIT};
use crate::parts::latent_networks::Autoencoder;
use crate::parts::tokenizer::TrainedTokenizer;
use crate::train::network::{group, slice_result};
use crate::train::{GroupPlan, Losses, Order, SliceResult};

/// Source of the codes.
#[expect(clippy::large_enum_variant, reason = "there is one of it")]
pub(crate) enum Encoder {
    Tokenizer(TrainedTokenizer),
    Vae(Autoencoder),
}

impl Encoder {
    /// Reads the input `vae` if `of_vae`, else `tokenizer`, and returns its role among parts and its digest.
    pub(crate) fn read(cx: &dyn GangContext, of_vae: bool) -> Result<(Self, Role, Digest), StageError> {
        let blobs = cx.blobs();
        if of_vae {
            let (digest, manifest) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
            let vae = Autoencoder::read(&*blobs, &manifest, &cx.device())?;
            return Ok((Self::Vae(vae), Role::VAE, digest));
        }
        let (digest, manifest) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        let tokenizer = TrainedTokenizer::read(&*blobs, &manifest, &cx.device())?;
        Ok((Self::Tokenizer(tokenizer), Role::TOKENIZER, digest))
    }

    fn check_format(&self, format: DataFormat) -> Result<(), StageError> {
        match self {
            Self::Tokenizer(tokenizer) => tokenizer.check_format(format),
            Self::Vae(vae) => vae.check_format(format),
        }
    }

    fn normalise(&self, rows: &mut [f32]) {
        match self {
            Self::Tokenizer(tokenizer) => tokenizer.normalise(rows),
            Self::Vae(vae) => vae.normalise(rows),
        }
    }

    /// Widths of a frame and of a code.
    pub(crate) fn widths(&self) -> (usize, usize) {
        match self {
            Self::Tokenizer(tokenizer) => (tokenizer.meta().features, tokenizer.meta().code_dim),
            Self::Vae(vae) => (vae.meta().features, UNIT * vae.meta().features),
        }
    }

    /// Encodes normalised windows `[windows, frames, features]` as codes `[windows, frames / 4, code]`. `stream` returns the
    /// generator of a window.
    fn codes(&self, windows: &[f32], frames: usize, stream: impl Fn(usize) -> Stream) -> Vec<f32> {
        match self {
            Self::Tokenizer(tokenizer) => tokenizer.codes(&tokenizer.encode_windows(windows.to_vec(), frames)),
            Self::Vae(vae) => {
                let window = |(i, window): (usize, &[f32])| {
                    let z = vae.encode(window.to_vec(), frames).sample(&mut stream(i));
                    vae.decode(z, frames)
                };
                windows.chunks_exact(frames * vae.meta().features).enumerate().flat_map(window).collect()
            }
        }
    }
}

/// Windows in the order of a stage.
pub(crate) struct FlowData {
    windows: TokenWindows,
    encoder: Encoder,
    order: Order,
    batch: Batch,
    frames: usize,
    device: Device,
}

/// One slice of a batch; tensors are not tracked.
pub(crate) struct FlowSlice {
    /// Normalised windows [B, T, F].
    pub(crate) data_btf: Tensor<3>,
    /// Standard normal noise [B, T, F].
    pub(crate) noise_btf: Tensor<3>,
    /// Codes [B, T / 4, d].
    pub(crate) codes_bnd: Tensor<3>,
    /// A uniform draw in [0, 1) per window.
    pub(crate) uniforms: Vec<f32>,
}

impl FlowData {
    /// Reads the input `dataset`.
    pub(crate) fn read(
        cx: &dyn GangContext,
        encoder: Encoder,
        (frames, of): (usize, WindowsOf),
        training: &Training,
    ) -> Result<Self, StageError> {
        let windows = TokenWindows::read(cx, frames, of)?;
        encoder.check_format(windows.dataset.format)?;
        let order = Order::new(windows.seed, &windows.purpose, windows.examples(), training.batch.global, 1);
        Ok(Self { windows, encoder, order, batch: training.batch, frames, device: cx.device() })
    }

    pub(crate) fn format(&self) -> DataFormat {
        self.windows.dataset.format
    }

    pub(crate) fn encoder(&self) -> &Encoder {
        &self.encoder
    }

    /// Seed and name of the stage, which key the draws.
    pub(crate) fn purpose(&self) -> (Seed, &str) {
        (self.windows.seed, &self.windows.purpose)
    }

    pub(crate) fn slice(&mut self, step: u64, slice: usize) -> FlowSlice {
        let range = self.order.slice(slice, self.batch.slices);
        let picks = self.order.batch(step, |_| 0)[range].to_vec();
        let frames = self.frames;
        let width = self.windows.dataset.mean.len();
        let mut rows = self.windows.rows(&picks);
        self.encoder.normalise(&mut rows);
        let stream =
            |what: &str, place| Stream::new(self.windows.seed, &format!("{}/{what}", self.windows.purpose), place, 0);
        let codes = self.encoder.codes(&rows, frames, |i| stream("latent", picks[i].place));
        let mut noise = vec![0.0; rows.len()];
        let mut uniforms = Vec::with_capacity(picks.len());
        for (pick, noise) in picks.iter().zip(noise.chunks_exact_mut(frames * width)) {
            let mut draw = stream("flow", pick.place);
            uniforms.push(draw.uniform() as f32);
            draw.fill_normal(noise);
        }
        let tensor =
            |values: Vec<f32>, shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values, shape), &self.device);
        let shape = [picks.len(), frames, width];
        let codes = tensor(codes, [picks.len(), frames / UNIT, self.encoder.widths().1]);
        FlowSlice { data_btf: tensor(rows, shape), noise_btf: tensor(noise, shape), codes_bnd: codes, uniforms }
    }
}

/// The network of a flow as one group of parameters.
pub(crate) fn field_group(field: &Field, training: &Training, ema: f64) -> GroupPlan {
    match &field.backbone {
        Backbone::Unet(network) => group("model", network, training, ema),
        Backbone::Dit(network) => group("model", network, training, ema),
    }
}

/// The result of a slice: its losses, and their gradient for the network.
pub(crate) fn field_result(field: &Field, losses: &Losses, terms: &[&'static str]) -> Result<SliceResult, StageError> {
    match &field.backbone {
        Backbone::Unet(network) => slice_result(network, losses, terms),
        Backbone::Dit(network) => slice_result(network, losses, terms),
    }
}
