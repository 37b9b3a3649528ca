//! MMM's objective in `train.tokens`. Source: MMM (Pinyoanuntapong et al., CVPR 2024), `train_t2m_trans.py`.
//!
//! Half of a clip's tokens are replaced by random codes, then a share between a half and all of them is masked. The
//! loss is the cross-entropy over all tokens, masked or not, except the end: a mean per clip, then over clips. Captions
//! are never dropped, so there is no guidance. A token is the frozen code of the tokenizer; a caption is its vector and
//! one vector per word.
//!
//! Departs with the built-in encoder: attention covers only a caption's own words; CLIP always has 77.

use burn::tensor::{Device, Tensor};
use models::kernels::Dropout;
use models::networks::{Init, Mmm, MmmConfig};
use models::tokens::mmm;
use motion::dataset::Caption;
use protocol::ArtifactKind;
use protocol::stage::TrainTokens;

use crate::context::{GangContext, StageError};
use crate::generate::generator::{GeneratorMeta, codebook, with_words};
use crate::parts::text::{self, TextEncoder};
use crate::parts::tokenizer::TrainedTokenizer;
use crate::parts::warm_start::WarmStart;
use crate::train::data::tokens::{TokenData, uniforms};
use crate::train::network::{dropout_seed, group, slice_result};
use crate::train::{GroupPlan, Losses, Objective, Pick, SliceResult, TrainState};
use crate::{artifacts, parts};

/// Objective that trains MMM's network.
pub(super) struct WithWords {
    settings: TrainTokens,
    config: MmmConfig,
    data: TokenData,
    captions: Vec<Caption>,
    encoder: Box<dyn TextEncoder>,
    codes_kd: Tensor<2>,
    network: Mmm,
    dropout_seed: u64,
    device: Device,
}

impl WithWords {
    /// Reads the inputs `dataset` and `tokenizer`; `data` holds the others.
    pub(super) fn new(
        settings: &TrainTokens,
        data: TokenData,
        meta: &GeneratorMeta,
        cx: &dyn GangContext,
        init: &mut Init<'_>,
        start: &mut WarmStart,
    ) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let captions = artifacts::captions(&*blobs, &manifest)?;
        if captions.len() != data.embeddings.meta.captions {
            return Err(StageError::Input(format!(
                "`text` embeds {} captions, but `dataset` has {}; use embeddings of the same dataset",
                data.embeddings.meta.captions,
                captions.len()
            )));
        }
        let (_, manifest) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        let tokenizer = TrainedTokenizer::read(&*blobs, &manifest, &cx.device())?;
        let part = parts::manifest(&*blobs, data.embeddings.meta.text, "the text encoder")?;
        let encoder = text::open(&part, &*blobs, &cx.device())?;
        text::expect_one_width(&*encoder)?;
        let config = meta.mmm(tokenizer.meta().code_dim);
        Ok(Self {
            settings: settings.clone(),
            network: start.take(Mmm::new(&config, init), "")?,
            config,
            data,
            captions,
            encoder,
            codes_kd: codebook(&tokenizer, &cx.device().autodiff()),
            dropout_seed: dropout_seed(cx),
            device: cx.device(),
        })
    }

    fn example(&self, pick: Pick) -> mmm::Example {
        let tokens = self.data.layer(pick, 0);
        let mut draw = self.data.stream("corruption", pick);
        let share = draw.uniform() as f32;
        let keep: Vec<bool> = tokens.iter().map(|_| !draw.chance(self.settings.corruption)).collect();
        let random: Vec<usize> = tokens.iter().map(|_| draw.below(self.config.codes)).collect();
        let order = uniforms(&mut draw, self.config.positions());
        mmm::Example::new(
            &self.config,
            &tokens,
            &mmm::Corruption { share, keep: &keep, random: &random, order: &order },
        )
    }
}

impl Objective for WithWords {
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
        let examples: Vec<mmm::Example> = picks.iter().map(|pick| self.example(*pick)).collect();
        let input: Vec<usize> = examples.iter().flat_map(|e| e.input.iter().copied()).collect();
        let visible: Vec<usize> = examples.iter().map(|e| e.len + 1).collect();
        let captions: Vec<usize> = picks.iter().map(|pick| self.data.caption(*pick)).collect();
        let texts: Vec<&str> = captions.iter().map(|caption| self.captions[*caption].text.as_str()).collect();
        let words = self.encoder.tokens(&texts)?;
        let pooled = captions.iter().map(|caption| self.data.embeddings.captions.row(*caption));
        let rows: Vec<Vec<f32>> = pooled.zip(&words).map(|(pooled, words)| [pooled, words].concat()).collect();
        let rows: Vec<&[f32]> = rows.iter().map(Vec::as_slice).collect();
        let condition = with_words(&self.codes_kd, &rows, self.config.text_dim, &self.device);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let logits = mmm::logits(&self.network, &condition, &input, Some(&visible), &mut dropout);
        let mut losses = Losses::new(batch.global);
        losses.add("cross-entropy", mmm::loss(logits, &examples), 1.0);
        slice_result(&self.network, &losses, &self.terms())
    }
}
