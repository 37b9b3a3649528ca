//! Reconstruction of real motion by a VAE or a tokenizer, either with a flow decoder.

use motion::Stream;
use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::DataFormat;

use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::parts::flow_decoder::FlowDecoder;
use crate::parts::latent_networks::Autoencoder;
use crate::parts::tokenizer::TrainedTokenizer;

/// Encodes and decodes clips.
#[expect(clippy::large_enum_variant, reason = "there is one of it")]
pub(crate) enum Reconstructor {
    Vae(Autoencoder, Option<FlowDecoder>),
    Tokenizer(TrainedTokenizer, Option<FlowDecoder>),
}

impl Reconstructor {
    /// Opens those of the inputs `vae`, `tokenizer` and `decoder` that the stage has. A flow decoder makes `steps`
    /// steps; 0 means its own number.
    pub(crate) fn read(cx: &dyn AttemptContext, steps: usize) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let has = |field: &str| cx.task().inputs.contains_key(field);
        let decoder = |role: &Role, encoder| -> Result<Option<FlowDecoder>, StageError> {
            if !has("decoder") {
                return Ok(None);
            }
            let (_, manifest) = artifacts::input(cx, "decoder", ArtifactKind::FlowDecoder)?;
            let decoder = FlowDecoder::read(&*blobs, &manifest, (role, encoder), &cx.device())?;
            Ok(Some(if steps > 0 { decoder.with_steps(steps) } else { decoder }))
        };
        if !has("tokenizer") {
            let (digest, vae) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
            let vae = Autoencoder::read(&*blobs, &vae, &cx.device())?;
            return Ok(Self::Vae(vae, decoder(&Role::VAE, digest)?));
        }
        let (digest, manifest) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        let tokenizer = TrainedTokenizer::read(&*blobs, &manifest, &cx.device())?;
        Ok(Self::Tokenizer(tokenizer, decoder(&Role::TOKENIZER, digest)?))
    }

    /// Refuses data of another format than the training data.
    pub(crate) fn check_format(&self, format: DataFormat) -> Result<(), StageError> {
        match self {
            Self::Vae(vae, _) => vae.check_format(format),
            Self::Tokenizer(tokenizer, _) => tokenizer.check_format(format),
        }
    }

    /// Refuses a clip `id` with fewer frames than one token.
    pub(crate) fn check_frames(&self, id: &str, frames: usize) -> Result<(), StageError> {
        match self {
            Self::Tokenizer(tokenizer, _) if frames < tokenizer.unit() => Err(StageError::Input(format!(
                "clip `{id}` has {frames} frames, but one token stands for {} frames; remove the clip from the split",
                tokenizer.unit()
            ))),
            _ => Ok(()),
        }
    }

    /// Mean and standard deviation of the training data.
    pub(crate) fn statistics(&self) -> (&[f32], &[f32]) {
        match self {
            Self::Vae(vae, _) => (&vae.meta().mean, &vae.meta().std),
            Self::Tokenizer(tokenizer, _) => (&tokenizer.meta().mean, &tokenizer.meta().std),
        }
    }

    pub(crate) fn normalise(&self, rows: &mut [f32]) {
        match self {
            Self::Vae(vae, _) => vae.normalise(rows),
            Self::Tokenizer(tokenizer, _) => tokenizer.normalise(rows),
        }
    }

    pub(crate) fn denormalise(&self, rows: &mut [f32]) {
        match self {
            Self::Vae(vae, _) => vae.denormalise(rows),
            Self::Tokenizer(tokenizer, _) => tokenizer.denormalise(rows),
        }
    }

    /// Reconstructs normalised rows `[frames, D]` as later stages receive them: a decoded sample of the posterior, or
    /// the decoded tokens.
    pub(crate) fn sample(&self, truth: &[f32], frames: usize, stream: &mut Stream) -> Vec<f32> {
        match self {
            Self::Vae(vae, decoder) => {
                let z = vae.encode(truth.to_vec(), frames).sample(stream);
                of_latent(vae, decoder.as_ref(), z, frames, stream)
            }
            Self::Tokenizer(tokenizer, decoder) => {
                let ids = tokenizer.encode(truth.to_vec());
                decoded(tokenizer, decoder.as_ref(), &ids, stream)
            }
        }
    }

    /// Like [`sample`](Self::sample), with the decoded mean of a VAE's posterior. Adds the used codes to `codes`.
    pub(crate) fn guesses(
        &self,
        truth: &[f32],
        frames: usize,
        stream: &mut Stream,
        codes: &mut [Vec<u64>],
    ) -> (Vec<f32>, Option<Vec<f32>>) {
        match self {
            Self::Vae(vae, decoder) => {
                let posterior = vae.encode(truth.to_vec(), frames);
                let z = posterior.sample(stream);
                let mut decoded = |z| of_latent(vae, decoder.as_ref(), z, frames, stream);
                (decoded(z), Some(decoded(posterior.mu)))
            }
            Self::Tokenizer(tokenizer, decoder) => {
                let ids = tokenizer.encode(truth.to_vec());
                for row in ids.chunks_exact(codes.len()) {
                    row.iter().zip(&mut *codes).for_each(|(id, counts)| counts[*id as usize] += 1);
                }
                (decoded(tokenizer, decoder.as_ref(), &ids, stream), None)
            }
        }
    }

    /// Zero counts for each code of each codebook.
    pub(crate) fn no_codes(&self) -> Vec<Vec<u64>> {
        match self {
            Self::Vae(..) => Vec::new(),
            Self::Tokenizer(tokenizer, _) => vec![vec![0; tokenizer.meta().codes]; tokenizer.meta().quantizers],
        }
    }
}

fn of_latent(
    vae: &Autoencoder,
    decoder: Option<&FlowDecoder>,
    z: Vec<f32>,
    frames: usize,
    stream: &mut Stream,
) -> Vec<f32> {
    match decoder {
        None => vae.decode(z, frames),
        Some(decoder) => decoder.decode_latent(vae, z, frames, stream),
    }
}

fn decoded(tokenizer: &TrainedTokenizer, decoder: Option<&FlowDecoder>, ids: &[i64], stream: &mut Stream) -> Vec<f32> {
    match decoder {
        None => tokenizer.decode(ids),
        Some(decoder) => decoder.decode(tokenizer, ids, stream),
    }
}
