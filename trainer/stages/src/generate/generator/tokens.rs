//! Token generators: a network draws ids for a caption, and a tokenizer decodes them to motion. Source: T2M-GPT,
//! MoMask, MMM.
//!
//! Parts: `generator`, `tokenizer`, `text`, and `decoder` if a flow decodes instead of the tokenizer. The generator
//! reads one vector of a caption; MMM's also reads one per word. An autoregressive generator decides the length and
//! ignores the requested one. If it ends at once, the motion is the single id 1, as in T2M-GPT's evaluation.
//!
//! Layers above the first are drawn at guidance 5, as published for both datasets; the sampler's guidance applies only
//! to the first.
//!
//! A masked generator also fills in a part of a motion: the tokens of the rest are kept in all layers and condition it.
//! The layers above the first are then drawn at guidance 2, as in MoMask's script for edits.
//!
//! Departs: MoMask then draws the layers above the first again for the whole clip. MMM's published code ends early for
//! a batch of one motion; here no motion depends on its batch.

use std::rc::Rc;

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use checkpoint::model::{Model, Parts};
use models::networks::{Gpt, GptConfig, Init, MaskedTransformer, Mmm, MmmConfig, MomaskConfig, ResidualTransformer};
use models::tokens::autoregressive::{self, Draw};
use models::tokens::masked::{self, Canvas, Sampling};
use models::tokens::{mmm, residual};
use motion::Stream;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, Family, Sampler, TokenNetwork};
use protocol::units::counted;
use protocol::{ArtifactKind, Manifest};
use serde::{Deserialize, Serialize};

use super::mmm_condition::{codebook, with_words};
use super::{Batch, Edit, Infilling, Lap, MotionGenerator, Seeds, Text};
use crate::artifacts;
use crate::context::StageError;
use crate::parts::flow_decoder::FlowDecoder;
use crate::parts::text::{self, TextEncoder};
use crate::parts::tokenizer::TrainedTokenizer;
use crate::parts::{self, weights};

/// Name of this generator in manifests.
pub(crate) const NAME: &str = "tokens";
/// Guidance of the layers above the first.
const RESIDUAL_GUIDANCE: f32 = 5.0;
/// Guidance of the layers above the first when a part of a motion is filled in.
const EDIT_GUIDANCE: f32 = 2.0;
/// Share of the classes that a masked generator excludes.
const THRESHOLD: f64 = 0.9;
/// Prefix of the first layer's network in the file of a masked generator.
pub(crate) const MASKED_PREFIX: &str = "mask.";
/// Prefix of the residual network in that file.
pub(crate) const RESIDUAL_PREFIX: &str = "res.";

/// Meta of an artifact of kind `token-generator`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct GeneratorMeta {
    /// Family of the generator, which decides its samplers.
    #[serde(flatten)]
    pub(crate) family: Family,
    /// Size of the transformer.
    pub(crate) network: TokenNetwork,
    /// Number of codes K of a codebook.
    pub(crate) codes: usize,
    /// Number of codebooks Q.
    pub(crate) quantizers: usize,
    /// Number of tokens of the longest motion.
    pub(crate) longest: usize,
    /// Width of a caption embedding.
    pub(crate) text_dim: usize,
    /// The parts of its training: the tokenizer whose ids it draws, and the text encoder.
    pub(crate) fits: Parts,
}

impl GeneratorMeta {
    /// Size of an autoregressive network, with one place for the caption and one for the end.
    pub(crate) fn gpt(&self) -> GptConfig {
        GptConfig { codes: self.codes, network: self.network.clone(), block: self.longest + 2, text_dim: self.text_dim }
    }

    /// Size of each of a masked generator's networks.
    pub(crate) fn momask(&self) -> MomaskConfig {
        MomaskConfig {
            codes: self.codes,
            quantizers: self.quantizers,
            network: self.network.clone(),
            text_dim: self.text_dim,
        }
    }

    /// Size of MMM's network, on codes of width `code_dim`.
    pub(crate) fn mmm(&self, code_dim: usize) -> MmmConfig {
        MmmConfig {
            codes: self.codes,
            dim: code_dim,
            network: self.network.clone(),
            block: self.longest + 2,
            text_dim: self.text_dim,
        }
    }

    /// Returns true if there are layers above the first.
    pub(crate) fn layered(&self) -> bool {
        self.quantizers > 1
    }
}

/// Networks that draw ids.
#[derive(Debug)]
enum Network {
    Autoregressive(Box<Gpt>),
    Masked(Box<MaskedTransformer>, Option<Box<ResidualTransformer>>),
    /// MMM's network with the tokenizer's codes [K, d].
    Mmm(Box<Mmm>, Box<Tensor<2>>),
}

/// Ids `[tokens, Q]` of a motion; those marked in `kept` stay.
#[derive(Debug, Clone, Copy)]
struct Known<'a> {
    ids: &'a [i64],
    kept: &'a [bool],
}

impl Known<'_> {
    /// The id of layer `layer` of `quantizers` at `place`, if it is kept.
    fn id(&self, quantizers: usize, layer: usize, place: usize) -> Option<usize> {
        self.kept[place].then(|| self.ids[place * quantizers + layer] as usize)
    }
}

#[derive(Debug)]
struct TokenModel {
    network: Network,
    meta: GeneratorMeta,
    tokenizer: TrainedTokenizer,
    decoder: Option<FlowDecoder>,
    text: Box<dyn TextEncoder>,
    device: Device,
}

/// Opens the parts and checks that they fit each other.
pub(super) fn open(model: &Model, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn MotionGenerator>, StageError> {
    let part = |role: &Role, kind| parts::part(blobs, model, role, kind);
    let manifest = part(&Role::GENERATOR, ArtifactKind::TokenGenerator)?;
    let meta: GeneratorMeta = artifacts::meta(&manifest, "the token generator")?;
    let tokenizer = TrainedTokenizer::read(blobs, &part(&Role::TOKENIZER, ArtifactKind::Tokenizer)?, device)?;
    let text = text::open(&part(&Role::TEXT, ArtifactKind::TextEncoder)?, blobs, device)?;
    for role in [Role::TOKENIZER, Role::TEXT] {
        if meta.fits.get(&role) != model.parts.get(&role) {
            return Err(StageError::Input(format!(
                "the token generator was not trained with the model's `{role}` part"
            )));
        }
    }
    let ours = (meta.codes, meta.quantizers);
    let theirs = (tokenizer.meta().codes, tokenizer.meta().quantizers);
    if ours != theirs {
        return Err(StageError::Input(format!(
            "the generator was trained with {} of {} codes, but the tokenizer has {} of {} codes; use the tokenizer that it \
             was trained with",
            counted(ours.1, "codebook"),
            ours.0,
            theirs.1,
            theirs.0
        )));
    }
    if meta.family == Family::Mmm {
        text::expect_one_width(&*text)?;
    }
    if meta.text_dim != text.dim() {
        let wanted = meta.text_dim;
        let found = text.dim();
        return Err(StageError::Input(format!(
            "the token generator expects {wanted} numbers per caption, but the text encoder returns {found}"
        )));
    }
    let decoder = match model.parts.contains_key(&Role::DECODER) {
        true => {
            let manifest = part(&Role::DECODER, ArtifactKind::FlowDecoder)?;
            let tokenizer = model.part(&Role::TOKENIZER).map_err(parts::model_error)?;
            Some(FlowDecoder::read(blobs, &manifest, (&Role::TOKENIZER, tokenizer), device)?)
        }
        false => None,
    };
    let device = device.clone().inner();
    let network = network(&meta, &tokenizer, blobs, &manifest, &device)?;
    Ok(Box::new(TokenModel { network, meta, tokenizer, decoder, text, device }))
}

fn network(
    meta: &GeneratorMeta,
    tokenizer: &TrainedTokenizer,
    blobs: &dyn Blobs,
    manifest: &Manifest,
    device: &Device,
) -> Result<Network, StageError> {
    let what = "the token generator's weights";
    let mut init = Init::blank(device);
    match meta.family {
        Family::Autoregressive => {
            let network = weights::load(Gpt::new(&meta.gpt(), &mut init), blobs, manifest, what)?;
            Ok(Network::Autoregressive(Box::new(network)))
        }
        Family::Masked => {
            let config = meta.momask();
            let fresh = MaskedTransformer::new(&config, &mut init);
            let first = weights::load_under(fresh, blobs, manifest, MASKED_PREFIX, what)?;
            let above = match meta.layered() {
                true => {
                    let fresh = ResidualTransformer::new(&config, true, &mut init);
                    Some(Box::new(weights::load_under(fresh, blobs, manifest, RESIDUAL_PREFIX, what)?))
                }
                false => None,
            };
            Ok(Network::Masked(Box::new(first), above))
        }
        Family::Mmm => {
            let fresh = Mmm::new(&meta.mmm(tokenizer.meta().code_dim), &mut init);
            let network = weights::load(fresh, blobs, manifest, what)?;
            Ok(Network::Mmm(Box::new(network), Box::new(codebook(tokenizer, device))))
        }
        _ => Err(StageError::Input(
            "the manifest of the token generator names a model family that generates no tokens".into(),
        )),
    }
}

impl TokenModel {
    /// Draws ids `[tokens, Q]` of each motion; `known` applies to a batch of one.
    fn ids(&self, batch: Batch<'_>, sampler: &Sampler, known: Option<Known<'_>>) -> Vec<Vec<i64>> {
        let text = || {
            let values = batch.texts.iter().flat_map(|text| text.values.iter().copied()).collect();
            let shape = [batch.texts.len(), self.meta.text_dim];
            Tensor::<2>::from_data(TensorData::new(values, shape), &self.device)
        };
        match &self.network {
            Network::Autoregressive(network) => {
                let mut fill = |step: usize, b: usize, out: &mut [f64]| {
                    let mut draw = (batch.seeds)(step, b);
                    out.iter_mut().for_each(|e| *e = -(1.0 - draw.uniform()).ln());
                };
                let ids = autoregressive::sample(network, &self.meta.gpt(), text(), Draw::Categorical(&mut fill));
                let or_one = |ids: Vec<usize>| if ids.is_empty() { vec![1] } else { ids };
                ids.into_iter().map(|ids| or_one(ids).into_iter().map(|id| id as i64).collect()).collect()
            }
            Network::Masked(first, above) => self.filled_in((first, above.as_deref()), batch, sampler, text(), known),
            Network::Mmm(network, codes) => self.with_words((network, codes), batch, sampler, known),
        }
    }

    /// Known ids of the first layer of each motion.
    fn given(&self, batch: Batch<'_>, known: Option<Known<'_>>) -> Vec<Vec<Option<usize>>> {
        let unit = self.tokenizer.unit();
        let quantizers = self.meta.quantizers;
        let id = |place: usize| known.and_then(|known| known.id(quantizers, 0, place));
        batch.lengths.iter().map(|frames| (0..frames.div_ceil(unit)).map(id).collect()).collect()
    }

    /// Draws ids with MMM's network.
    fn with_words(
        &self,
        (network, codes_kd): (&Mmm, &Tensor<2>),
        batch: Batch<'_>,
        sampler: &Sampler,
        known: Option<Known<'_>>,
    ) -> Vec<Vec<i64>> {
        let config = self.meta.mmm(codes_kd.dims()[1]);
        let given = self.given(batch, known);
        let rows: Vec<&[f32]> = batch.texts.iter().map(|text| &text.values[..]).collect();
        let condition = with_words(codes_kd, &rows, self.meta.text_dim, &self.device);
        let sampling =
            mmm::Sampling { steps: sampler.steps, greedy: false, counts: mmm::Counts::Open, stops_alone: false };
        let mut draws = |step: usize, b: usize, p: usize, out: &mut [f32]| {
            let mut draw = (batch.seeds)(step * self.meta.longest + p, b);
            out.iter_mut().for_each(|u| *u = draw.uniform() as f32);
        };
        let ids = mmm::sample(network, &config, &sampling, &condition, &given, &mut draws, |_| ());
        let own = ids.chunks_exact(config.positions()).zip(&given);
        own.map(|(ids, given)| ids[..given.len()].iter().map(|id| *id as i64).collect()).collect()
    }

    /// Decodes the ids of motion `b` to rows in the data's own scale.
    fn decoded(&self, ids: &[i64], sampler: &Sampler, seeds: &Seeds<'_>, b: usize) -> Vec<f32> {
        // A stream after all those that ids are drawn from.
        let noise = (sampler.steps + self.meta.quantizers) * self.meta.longest.max(2);
        self.decode(ids, &mut seeds(noise, b))
    }

    /// Decodes ids to rows in the data's own scale. A flow decoder draws from `noise`.
    fn decode(&self, ids: &[i64], noise: &mut Stream) -> Vec<f32> {
        let mut rows = match &self.decoder {
            None => self.tokenizer.decode(ids),
            Some(decoder) => decoder.decode(&self.tokenizer, ids, noise),
        };
        self.tokenizer.denormalise(&mut rows);
        rows
    }

    fn filled_in(
        &self,
        (first, above): (&MaskedTransformer, Option<&ResidualTransformer>),
        batch: Batch<'_>,
        sampler: &Sampler,
        text: Tensor<2>,
        known: Option<Known<'_>>,
    ) -> Vec<Vec<i64>> {
        let canvases: Vec<Canvas> = self.given(batch, known).into_iter().map(|tokens| Canvas { tokens }).collect();
        let lengths: Vec<usize> = canvases.iter().map(|canvas| canvas.tokens.len()).collect();
        let len = lengths.iter().copied().max().unwrap_or(0);
        let config = self.meta.momask();
        let of_first = Sampling {
            steps: sampler.steps,
            guidance: sampler.guidance as f32,
            temperature: 1.0,
            threshold: THRESHOLD,
        };
        // Streams are numbered by step, then by position; those of the layers above come after those of the first.
        let fill = |stream: usize, b: usize, out: &mut [f32], seeds: &Seeds<'_>| {
            let mut draw = seeds(stream, b);
            out.iter_mut().for_each(|u| *u = draw.uniform() as f32);
        };
        let places = self.meta.longest;
        let mut draws = |step: usize, b: usize, p: usize, out: &mut [f32]| fill(step * places + p, b, out, batch.seeds);
        let ids = masked::generate(first, &config, &of_first, text.clone(), &canvases, &mut draws, |_| ());
        let steps = sampler.steps;
        let (all, layers) = match above {
            None => (ids, 1),
            Some(network) => {
                let mut draws = |layer: usize, b: usize, p: usize, out: &mut [f32]| {
                    fill((steps + layer) * places + p, b, out, batch.seeds)
                };
                let guidance = if known.is_some() { EDIT_GUIDANCE } else { RESIDUAL_GUIDANCE };
                let sampling = Sampling { guidance, ..of_first };
                let quantizers = self.meta.quantizers;
                let known = |layer, at| known.and_then(|known| known.id(quantizers, layer, at));
                let first = residual::First { ids: &ids, lengths: &lengths, known: &known };
                let ids = residual::generate(network, &config, &sampling, text, first, &mut draws);
                (ids, quantizers)
            }
        };
        lengths.iter().enumerate().map(|(b, own)| all[b * len * layers..][..own * layers].to_vec()).collect()
    }
}

impl MotionGenerator for TokenModel {
    fn format(&self) -> DataFormat {
        self.tokenizer.meta().format
    }

    fn longest(&self) -> usize {
        self.meta.longest * self.tokenizer.unit()
    }

    fn family(&self) -> &Family {
        &self.meta.family
    }

    fn text(&self) -> &dyn TextEncoder {
        &*self.text
    }

    fn embed(&self, captions: &[&str]) -> Result<Vec<Text>, StageError> {
        let pooled = self.text.pooled(captions)?;
        let pooled = pooled.chunks_exact(self.text.dim());
        if self.meta.family != Family::Mmm {
            return Ok(pooled.map(|row| Text { values: row.to_vec() }).collect());
        }
        let words = self.text.tokens(captions)?;
        Ok(pooled.zip(words).map(|(row, words)| Text { values: [row, &words].concat() }).collect())
    }

    fn draw(&self, batch: Batch<'_>, sampler: &Sampler, lap: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError> {
        let ids = self.ids(batch, sampler, None);
        lap(Lap::Sampled);
        let width = self.tokenizer.meta().features;
        let decides = matches!(self.network, Network::Autoregressive(_));
        let motion = |(b, (ids, frames)): (usize, (Vec<i64>, &usize))| {
            let mut rows = self.decoded(&ids, sampler, batch.seeds, b);
            if !decides {
                rows.truncate(frames * width);
            }
            rows
        };
        let motions = ids.into_iter().zip(batch.lengths).enumerate().map(motion).collect();
        lap(Lap::Decoded);
        Ok(motions)
    }

    fn reconstruct(&self, rows: &[f32], noise: &mut Stream) -> Vec<f32> {
        let width = self.tokenizer.meta().features;
        let unit = self.tokenizer.unit();
        let frames = (rows.len() / width / unit * unit).min(self.longest());
        if frames == 0 {
            return rows.to_vec();
        }
        let mut rows = rows[..frames * width].to_vec();
        self.tokenizer.normalise(&mut rows);
        self.decode(&self.tokenizer.encode(rows), noise)
    }

    fn infilling(&self) -> Option<&dyn Infilling> {
        match self.network {
            Network::Autoregressive(_) => None,
            Network::Masked(..) | Network::Mmm(..) => Some(self),
        }
    }
}

impl Infilling for TokenModel {
    fn unit(&self) -> usize {
        self.tokenizer.unit()
    }

    fn fill_in(
        &self,
        edit: Edit<'_>,
        text: &Rc<Text>,
        seeds: &Seeds<'_>,
        sampler: &Sampler,
        lap: &mut dyn FnMut(Lap),
    ) -> Vec<f32> {
        let mut rows = edit.motion.to_vec();
        self.tokenizer.normalise(&mut rows);
        let ids = self.tokenizer.encode(rows);
        let lengths = [edit.kept.len() * self.tokenizer.unit()];
        let batch = Batch { texts: std::slice::from_ref(text), lengths: &lengths, seeds, control: None };
        let ids = self.ids(batch, sampler, Some(Known { ids: &ids, kept: edit.kept })).concat();
        lap(Lap::Sampled);
        let motion = self.decoded(&ids, sampler, seeds, 0);
        lap(Lap::Decoded);
        motion
    }
}
