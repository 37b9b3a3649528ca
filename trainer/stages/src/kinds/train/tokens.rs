//! `train.tokens`: a network that draws token ids for captions. Source: T2M-GPT (Zhang et al., CVPR 2023), MoMask (Guo
//! et al., CVPR 2024), MMM (Pinyoanuntapong et al., CVPR 2024), whose objective is in `mmm`.
//!
//! Autoregressive: cross-entropy over tokens and end, with a share of the inputs replaced by random codes. Masked:
//! cross-entropy over a share of the first layer's tokens, the cosine of a uniform draw. The layers above have
//! cross-entropy over all tokens of a drawn layer, given those below it. The two networks are two groups of one
//! training.
//!
//! Departs: both of MoMask's networks are trained on one batch, and the residual network is not from another stage.
//! Clips are shortened by a token, where MoMask shortens the motion before it is encoded. Padded positions extend to
//! `longest`, like MoMask's to 49.

mod mmm;

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor};
use checkpoint::model::Parts;
use models::flat::{self, Entry};
use models::kernels::Dropout;
use models::networks::{Gpt, GptConfig, Init, MaskedTransformer, MomaskConfig, ResidualTransformer};
use models::tokens::{autoregressive, cross_entropy, masked, residual};
use motion::dataset::Split;
use protocol::artifact::Role;
use protocol::stage::{Positions, StageSpec, TokenGenerator, TrainTokens};
use protocol::{ArtifactKind, Manifest};

use self::mmm::WithWords;
use crate::artifacts::{self, Draft, Embeddings, to_meta};
use crate::context::{GangContext, Outcome, StageError};
use crate::generate::generator::{GeneratorMeta, MASKED_PREFIX, RESIDUAL_PREFIX, TOKENS};
use crate::kinds::shape::Gang;
use crate::parts::tokenizer::Tokens;
use crate::parts::warm_start::WarmStart;
use crate::parts::{self, weights};
use crate::train::data::tokens::{TokenData, uniforms};
use crate::train::network::{dropout_seed, group, no_clips, slice_result};
use crate::train::{GroupPlan, Losses, Objective, Order, Pick, SliceResult, TrainState, train};

struct Autoregressive {
    settings: TrainTokens,
    config: GptConfig,
    data: TokenData,
    network: Gpt,
    dropout_seed: u64,
    device: Device,
}

impl Objective for Autoregressive {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![group("model", &self.network, &self.settings.training, 0.0)]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL]
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.network);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.settings.training.batch;
        let range = self.data.order.slice(slice, batch.slices);
        let picks = self.data.batch(step)[range].to_vec();
        let places = self.config.block - 1;
        let example = |pick: &Pick| {
            let mut draw = self.data.stream("corruption", *pick);
            let keep: Vec<bool> = (0..places).map(|_| !draw.chance(self.settings.corruption)).collect();
            let random: Vec<usize> = (0..places).map(|_| draw.below(self.config.codes)).collect();
            autoregressive::Example::new(&self.config, &self.data.layer(*pick, 0), &keep, &random)
        };
        let examples: Vec<autoregressive::Example> = picks.iter().map(example).collect();
        let input: Vec<usize> = examples.iter().flat_map(|e| e.input.iter().copied()).collect();
        let text = self.data.text(&picks, 0.0, "", &self.device);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let logits = self.network.forward(&input, text, &mut dropout);
        let mut losses = Losses::new(batch.global);
        losses.add("cross-entropy", autoregressive::loss(logits, &examples), 1.0);
        slice_result(&self.network, &losses, &self.terms())
    }
}

/// A training example of one clip for the residual network.
struct Asked {
    layer: usize,
    below: Vec<Vec<usize>>,
    target: Vec<usize>,
    len: usize,
}

struct Masked {
    settings: TrainTokens,
    config: MomaskConfig,
    data: TokenData,
    first: MaskedTransformer,
    above: Option<ResidualTransformer>,
    dropout_seed: u64,
    device: Device,
}

impl Masked {
    /// The clip at a place as the first layer's network reads it: padded tokens, their number, and the masked example.
    fn example(&self, pick: Pick) -> (Vec<usize>, usize, masked::Example) {
        let n = self.settings.longest;
        let mut tokens = self.data.layer(pick, 0);
        let len = tokens.len();
        tokens.resize(n, self.config.pad());
        let mut draw = self.data.stream("masks", pick);
        let share = draw.uniform() as f32;
        let order = uniforms(&mut draw, n);
        let replace = uniforms(&mut draw, n);
        let hide = uniforms(&mut draw, n);
        let random: Vec<usize> = (0..n).map(|_| draw.below(self.config.codes)).collect();
        let draws = masked::Corruption { share, order: &order, replace: &replace, hide: &hide, random: &random };
        let example = masked::Example::new(&self.config, &tokens, len, &draws);
        (tokens, len, example)
    }

    fn first_loss(&self, picks: &[Pick], all: &[Pick], drop: &mut Dropout) -> Tensor<1> {
        // The mean is over all masked tokens of the batch, which every slice counts itself.
        let asked = |pick: &Pick| self.example(*pick).2.asked.iter().filter(|asked| **asked).count();
        let count = all.iter().map(asked).sum::<usize>().max(1) as f32;
        let mut input = Vec::new();
        let mut targets = Vec::new();
        let mut weights = Vec::new();
        let mut lengths = Vec::new();
        for pick in picks {
            let (tokens, len, example) = self.example(*pick);
            weights.extend(example.asked.iter().map(|asked| if *asked { 1.0 / count } else { 0.0 }));
            input.extend(example.input);
            targets.extend(tokens);
            lengths.push(len);
        }
        let text = self.data.text(picks, self.settings.guidance_dropout, "unconditional", &self.device);
        cross_entropy(self.first.forward(&input, text, &lengths, drop), &targets, &weights)
    }

    fn asked(&self, pick: Pick) -> Asked {
        let n = self.settings.longest;
        let pad = self.config.residual_pad();
        let uniform = self.data.stream("layer", pick).uniform() as f32;
        let layer = residual::trained_layer(uniform, self.config.quantizers);
        let padded = |q: usize| {
            let mut tokens = self.data.layer(pick, q);
            tokens.resize(n, pad);
            tokens
        };
        let len = self.data.ids(pick).len() / self.config.quantizers;
        Asked { layer, below: (0..layer).map(padded).collect(), target: padded(layer), len }
    }

    fn above_loss(&self, network: &ResidualTransformer, picks: &[Pick], all: &[Pick], drop: &mut Dropout) -> Tensor<1> {
        let tokens = |pick: &Pick| self.data.ids(*pick).len() / self.config.quantizers;
        let count = all.iter().map(tokens).sum::<usize>().max(1) as f32;
        let asked: Vec<Asked> = picks.iter().map(|pick| self.asked(*pick)).collect();
        let sum = |asked: &Asked| {
            let layers = asked.below.iter().enumerate().map(|(q, ids)| network.embed(ids, q, 1));
            layers.reduce(|a, b| a + b).expect("a layer is at least 1")
        };
        let sums = Tensor::cat(asked.iter().map(sum).collect(), 0);
        let layers: Vec<usize> = asked.iter().map(|a| a.layer).collect();
        let lengths: Vec<usize> = asked.iter().map(|a| a.len).collect();
        let n = self.settings.longest;
        let weights: Vec<f32> =
            lengths.iter().flat_map(|len| (0..n).map(move |p| if p < *len { 1.0 / count } else { 0.0 })).collect();
        let targets: Vec<usize> = asked.into_iter().flat_map(|a| a.target).collect();
        let text = self.data.text(picks, 2.0 * self.settings.guidance_dropout, "unconditional above", &self.device);
        cross_entropy(network.forward(sums, &layers, text, &lengths, drop), &targets, &weights)
    }
}

impl Objective for Masked {
    fn groups(&mut self) -> Vec<GroupPlan> {
        let first = group("first", &self.first, &self.settings.training, 0.0);
        let above = self.above.as_ref().map(|network| group("above", network, &self.settings.training, 0.0));
        [first].into_iter().chain(above).collect()
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL, "first", "above"]
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.first);
        if let Some(network) = &mut self.above {
            state.groups[1].trained().assign(network);
        }
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.settings.training.batch;
        let range = self.data.order.slice(slice, batch.slices);
        let all = self.data.batch(step);
        let picks = &all[range];
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        // The weights divide by the number in the whole batch.
        let mut losses = Losses::new(1);
        let first = self.first_loss(picks, &all, &mut dropout);
        losses.add("first", first.clone(), 1.0);
        let mut gradients = vec![flat::gradient(&self.first, first)];
        if let Some(network) = &self.above {
            let above = self.above_loss(network, picks, &all, &mut dropout);
            losses.add("above", above.clone(), 1.0);
            gradients.push(flat::gradient(network, above));
        }
        Ok(SliceResult { gradients, terms: losses.values(&self.terms()), ..SliceResult::default() })
    }
}

/// The inputs of the stage.
struct Inputs {
    data: TokenData,
    meta: GeneratorMeta,
    parts: BTreeMap<Role, Manifest>,
}

impl Inputs {
    fn read(settings: &TrainTokens, cx: &dyn GangContext) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let (_, manifest) = artifacts::input(cx, "tokens", ArtifactKind::Tokens)?;
        let tokens = Tokens::read(&*blobs, &manifest)?;
        let (digest, tokenizer) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        if tokens.meta.tokenizer != digest {
            return Err(StageError::Input(
                "`tokens` were not encoded with `tokenizer`; use the tokenizer that encoded them".into(),
            ));
        }
        let (_, manifest) = artifacts::input(cx, "text", ArtifactKind::Embeddings)?;
        let embeddings = Embeddings::read(&*blobs, &manifest)?;
        let captions = tokens.meta.captions.iter().flatten().max().map_or(0, |most| most + 1);
        if captions > embeddings.meta.captions {
            return Err(StageError::Input(format!(
                "`tokens` refers to {captions} captions, but `text` embeds {}; use both of the same dataset",
                embeddings.meta.captions
            )));
        }
        let quantizers = tokens.meta.quantizers;
        if settings.generator == TokenGenerator::Masked && quantizers == 2 {
            return Err(StageError::Input(
                "a masked generator needs a tokenizer with 1 codebook, or at least 3; `tokenizer` has 2".into(),
            ));
        }
        if settings.generator != TokenGenerator::Masked && quantizers > 1 {
            return Err(StageError::Input(format!(
                "this generator needs a tokenizer with one codebook, but `tokenizer` has {quantizers}; train one with \
                 `quantizers: 1`, or write `generator: masked`"
            )));
        }
        let usable = |e: &usize| tokens.meta.splits[*e] == Split::Train && tokens.meta.lengths[*e] > 0;
        let train: Vec<usize> = (0..tokens.meta.splits.len()).filter(usable).collect();
        if train.is_empty() {
            return Err(no_clips());
        }
        let text = parts::manifest(&*blobs, embeddings.meta.text, "the text encoder")?;
        let meta = GeneratorMeta {
            family: settings.family().ok_or_else(|| StageError::Fault("the token generator has no family".into()))?,
            network: settings.network.clone(),
            codes: tokens.meta.codes,
            quantizers,
            longest: settings.longest,
            text_dim: embeddings.meta.dim,
            fits: Parts::from([(Role::TOKENIZER, digest), (Role::TEXT, text.digest())]),
        };
        let seed = cx.task().seed;
        let purpose = cx.task().name.to_string();
        let order = Order::new(seed, &purpose, train.len(), settings.training.batch.global, 1);
        let longest = settings.longest;
        let data = TokenData { tokens, embeddings, train, order, seed, purpose, longest };
        Ok(Self { data, meta, parts: BTreeMap::from([(Role::TOKENIZER, tokenizer), (Role::TEXT, text)]) })
    }
}

fn prefixed(prefix: &str, entries: &[Entry]) -> Vec<Entry> {
    entries.iter().map(|e| Entry { name: format!("{prefix}{}", e.name), shape: e.shape.clone() }).collect()
}

/// Uploads the trained networks, each under a prefix of its own.
fn add_weights(draft: &mut Draft, state: &TrainState) -> Result<(), StageError> {
    let prefixes: &[&str] = if state.groups[0].name == "model" { &[""] } else { &[MASKED_PREFIX, RESIDUAL_PREFIX] };
    let entries: Vec<Vec<Entry>> =
        state.groups.iter().zip(prefixes).map(|(group, prefix)| prefixed(prefix, &group.entries)).collect();
    let buffers: Vec<(&[Entry], &[f32])> =
        entries.iter().enumerate().map(|(i, entries)| (&entries[..], state.result(i))).collect();
    weights::add_all(draft, &buffers)
}

impl Gang for TrainTokens {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let Inputs { data, meta, mut parts } = Inputs::read(self, cx)?;
        let format = data.tokens.meta.format;
        let tracked = cx.device().autodiff();
        let device = cx.device();
        let dropout_seed = dropout_seed(cx);
        let mut init = Init::new(data.seed, &format!("{}/init", data.purpose), Positions::Uniform, &tracked);
        let mut start = WarmStart::find(cx, ArtifactKind::TokenGenerator)?;
        let mut objective: Box<dyn Objective> = match self.generator {
            TokenGenerator::Autoregressive => {
                let config = meta.gpt();
                let network = start.take(Gpt::new(&config, &mut init), "")?;
                Box::new(Autoregressive { settings: self.clone(), config, data, network, dropout_seed, device })
            }
            TokenGenerator::Masked => {
                let config = meta.momask();
                let first = start.take(MaskedTransformer::new(&config, &mut init), MASKED_PREFIX)?;
                let above = meta.layered().then(|| ResidualTransformer::new(&config, true, &mut init));
                let above = above.map(|above| start.take(above, RESIDUAL_PREFIX)).transpose()?;
                Box::new(Masked { settings: self.clone(), config, data, first, above, dropout_seed, device })
            }
            TokenGenerator::Mmm => Box::new(WithWords::new(self, data, &meta, cx, &mut init, &mut start)?),
        };
        start.finish(cx, &meta)?;
        train(&mut *objective, &self.training, cx)?.publish(|state| {
            let mut generator = Draft::new(cx, ArtifactKind::TokenGenerator, to_meta(&meta));
            add_weights(&mut generator, state)?;
            parts.insert(Role::GENERATOR, generator.into_manifest());
            parts::publish_model(cx, TOKENS, format, &parts)
        })
    }
}
