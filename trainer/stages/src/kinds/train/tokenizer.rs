//! `train.tokenizer`: a VQ-VAE (T2M-GPT, MMM) or a residual one (MoMask) on windows of motion.
//!
//! `L = SL1(x', x) + 0.5 SL1(positions) + 0.02 commitment` by default; the gradient passes once for every active
//! codebook. Codebooks are buffers. Each slice returns counts, sums and candidate rows that may replace codes. They are
//! added on the gradients' tree, and the hook after a step moves codes by them. So codebooks have the same bits for any
//! number of members.
//!
//! The first step starts with codes from its own batch, as published. They depend only on the initial parameters and
//! the batch, so every member computes them itself: [`VqObjective::first_books`].
//!
//! Departs: the recorded perplexity is a mean over slices. Entries shorter than a window are left out, and the last
//! window of the others is included. Drawn codes, tiling noise and dropout are keyed. Initial codes come from a pass
//! without dropout, for all layers, including those that the first step leaves out.

use std::borrow::Cow;
use std::rc::Rc;

use burn::tensor::{Device, Tensor, TensorData};
use models::device::host;
use models::kernels::Dropout;
use models::losses::{FrameWeights, Pointwise};
use models::networks::{Init, Tokenizer};
use models::quantizer::{Book, Pass, candidates, perplexity};
use motion::Stream;
use motion::random::permutation;
use protocol::ArtifactKind;
use protocol::stage::{Positions, Resets, TrainTokenizer};

use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::tokenizer::TokenizerMeta;
use crate::parts::warm_start::WarmStart;
use crate::train::data::windows::TokenWindows;
use crate::train::network::{dropout_seed, group, slice_result};
use crate::train::{
    AfterStep, BufferPlan, GroupPlan, Losses, Objective, Order, Pick, SliceResult, SumPlan, TrainState, train,
};

/// Frames per token.
const UNIT: usize = 4;

struct VqObjective {
    settings: TrainTokenizer,
    windows: TokenWindows,
    order: Order,
    network: Tokenizer,
    books: Vec<Vec<f32>>,
    /// Initial codebooks from `init`, by layer.
    given: Vec<Option<Vec<f32>>>,
    /// Codebooks of the first step.
    first: Option<Rc<Vec<Vec<f32>>>>,
    dropout_seed: u64,
    device: Device,
}

/// Name of the buffer or sum `what` of layer `q`.
fn of(what: &str, q: usize) -> String {
    format!("{what}.{q}")
}

impl VqObjective {
    fn tokens(&self) -> usize {
        self.settings.window / UNIT
    }

    /// Number of rows of a whole batch.
    fn rows(&self) -> usize {
        self.settings.training.batch.global * self.tokens()
    }

    /// Number of a batch's candidate rows that may replace codes.
    fn spare(&self) -> usize {
        self.settings.codes.min(self.rows())
    }

    /// Number of layers that step `step` trains, equal for every slice.
    fn active(&self, step: u64) -> usize {
        let quantizers = self.settings.quantizers;
        let mut draw = self.stream("layers", 0, step);
        if quantizers > 1 && draw.chance(self.settings.quantize_dropout) {
            1 + draw.below(quantizers)
        } else {
            quantizers
        }
    }

    /// The generator for one kind of draw.
    fn stream(&self, what: &str, step: u64, index: u64) -> Stream {
        Stream::new(self.windows.seed, &format!("{}/{what}", self.windows.purpose), step, index)
    }

    /// Normalised windows [B, window, F].
    fn features(&self, picks: &[Pick]) -> Tensor<3> {
        let mut rows = self.windows.rows(picks);
        self.windows.dataset.normalise(&mut rows);
        let shape = [picks.len(), self.settings.window, self.windows.dataset.mean.len()];
        Tensor::from_data(TensorData::new(rows, shape), &self.device)
    }

    /// Quantises the rows of `picks`; `books` returns a layer's codes.
    fn pass<'a>(
        &self,
        rows: Vec<f32>,
        picks: &[Pick],
        active: usize,
        books: impl FnMut(usize, &[f32]) -> Cow<'a, [f32]>,
    ) -> Pass {
        let tokens = self.tokens();
        let mut uniforms = |layer: usize, row: usize, out: &mut [f32]| {
            let index = (layer * tokens + row % tokens) as u64;
            let mut draw = self.stream("codes", picks[row / tokens].place, index);
            out.iter_mut().for_each(|u| *u = draw.uniform() as f32);
        };
        let plain = self.device.clone();
        let dim = self.settings.code_dim;
        Pass::through(rows, dim, active, &plain, books, if self.settings.drawn { Some(&mut uniforms) } else { None })
    }

    /// The codebooks of the first step: the given ones, otherwise rows of its batch. Each layer's rows are the
    /// residuals of the layers before it.
    fn first_books(&mut self) -> Rc<Vec<Vec<f32>>> {
        if let Some(first) = &self.first {
            return Rc::clone(first);
        }
        let codes = self.settings.codes;
        let dim = self.settings.code_dim;
        let quantizers = self.settings.quantizers;
        let count = self.spare().div_ceil(self.tokens());
        let picks = self.order.batch(0, |_| 0)[..count].to_vec();
        let encoded = self.network.encode(self.features(&picks), &mut Dropout::off());
        let rows = host(encoded);
        let mut books = vec![Vec::new(); quantizers];
        let begin = |q: usize, rows: &[f32]| {
            let mut draw = self.stream("first codes", 0, q as u64);
            books[q] = match &self.given[q] {
                Some(book) => book.clone(),
                None => candidates(rows, codes, dim, |len| noise(len, &mut draw)),
            };
            Cow::<[f32]>::Owned(books[q].clone())
        };
        self.pass(rows, &picks, quantizers, begin);
        let books = Rc::new(books);
        self.first = Some(Rc::clone(&books));
        books
    }

    /// The batch's row for each candidate that may replace a code.
    fn spare_rows(&self, step: u64) -> Vec<usize> {
        let spare = self.spare();
        match self.settings.resets {
            Resets::Always => (0..spare).collect(),
            Resets::Remembering => {
                let all = permutation(
                    self.windows.seed,
                    &format!("{}/replacements", self.windows.purpose),
                    step,
                    self.rows(),
                );
                all.into_iter().take(spare).map(|row| row as usize).collect()
            }
        }
    }

    /// A slice's statistics for the codebooks, in the order of [`Objective::sums`].
    fn statistics(&self, pass: &Pass, step: u64, first_row: usize) -> Vec<Vec<f32>> {
        let codes = self.settings.codes;
        let dim = self.settings.code_dim;
        let places = self.spare_rows(step);
        let mut sums: Vec<Vec<f32>> = self.sums().iter().map(|plan| vec![0.0; plan.len]).collect();
        for (q, layer) in pass.layers.iter().enumerate() {
            let (counts, totals) = layer.statistics(codes, dim);
            for (place, row) in places.iter().enumerate() {
                // Each slice writes its own candidates; all others add zeros there.
                if let Some(at) = row.checked_sub(first_row).filter(|at| *at < layer.codes.len()) {
                    sums[3 * q][place * dim..(place + 1) * dim].copy_from_slice(&layer.rows[at * dim..(at + 1) * dim]);
                }
            }
            (sums[3 * q + 1], sums[3 * q + 2]) = (totals, counts);
        }
        sums
    }
}

fn noise(len: usize, draw: &mut Stream) -> Vec<f32> {
    let mut values = vec![0.0; len];
    draw.fill_normal(&mut values);
    values
}

impl Objective for VqObjective {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![group("model", &self.network, &self.settings.training, 0.0)]
    }

    fn buffers(&mut self) -> Vec<BufferPlan> {
        let codes = self.settings.codes;
        let dim = self.settings.code_dim;
        let remembers = self.settings.resets == Resets::Remembering;
        let mut plans = Vec::new();
        for q in 0..self.settings.quantizers {
            let mut plan = |what, len| plans.push(BufferPlan { name: of(what, q), values: vec![0.0; len] });
            plan("codebook", codes * dim);
            plan("sums", codes * dim);
            plan("counts", codes);
            if remembers {
                plan("used", codes);
                plan("since", 1);
            }
        }
        plans
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL, "feature", "position", "commitment", "perplexity"]
    }

    fn sums(&self) -> Vec<SumPlan> {
        let codes = self.settings.codes;
        let dim = self.settings.code_dim;
        let spare = self.spare();
        let plans = (0..self.settings.quantizers).flat_map(|q| {
            [("rows", spare * dim), ("sums", codes * dim), ("counts", codes)]
                .map(|(what, len)| SumPlan { name: of(what, q), len })
        });
        plans.collect()
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.network);
        let book = |q| state.buffers.get(&of("codebook", q)).to_vec();
        self.books = (0..self.settings.quantizers).map(book).collect();
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.settings.training.batch;
        let books = if step == 0 { self.first_books() } else { Rc::new(self.books.clone()) };
        let range = self.order.slice(slice, batch.slices);
        let picks = self.order.batch(step, |_| 0)[range.clone()].to_vec();
        let tokens = self.tokens();
        let dim = self.settings.code_dim;
        let features = self.features(&picks);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let encoded = self.network.encode(features.clone(), &mut dropout);
        let active = self.active(step);
        let book = |q: usize, _: &[f32]| Cow::<[f32]>::Borrowed(books[q].as_slice());
        let pass = self.pass(host(encoded.clone()), &picks, active, book);
        let (quantised, commitment) = pass.straight_through(encoded.reshape([picks.len() * tokens, dim]));
        let decoded = self.network.decode(quantised.reshape([picks.len(), tokens, dim]), &mut dropout);

        let frames = self.settings.window;
        let weights = FrameWeights::plain(&vec![frames; picks.len()], frames, &self.device);
        let positions = self.windows.dataset.skeleton().layout().positions;
        let part = |x: &Tensor<3>| x.clone().slice([0..picks.len(), 0..frames, positions.clone()]);
        let found = part(&decoded);
        let wanted = part(&features);
        let loss = &self.settings.loss;
        let mut losses = Losses::new(batch.global);
        losses.add("feature", weights.compare(Pointwise::SmoothL1, decoded, features), loss.feature);
        losses.add("position", weights.compare(Pointwise::SmoothL1, found, wanted), loss.position);
        losses.add("commitment", commitment / (tokens * dim * active) as f32, loss.commitment);
        let used = |layer: &models::quantizer::LayerPass| perplexity(&layer.statistics(self.settings.codes, dim).0);
        let used = pass.layers.iter().map(used).sum::<f64>() / (active * batch.slices) as f64;
        losses.note("perplexity", used as f32);
        let sums = self.statistics(&pass, step, range.start * tokens);
        Ok(SliceResult { sums, ..slice_result(&self.network, &losses, &self.terms())? })
    }

    fn after(&mut self, after: &mut AfterStep<'_>) -> Result<(), StageError> {
        // The network is still the one of this step.
        let first = (after.step == 0).then(|| self.first_books());
        let codes = self.settings.codes;
        let dim = self.settings.code_dim;
        let active = self.active(after.step);
        for q in 0..self.settings.quantizers {
            let take = |after: &AfterStep<'_>, what: &str| after.buffers.get(&of(what, q)).to_vec();
            let (mut book, mut sums, mut counts) =
                (take(&*after, "codebook"), take(&*after, "sums"), take(&*after, "counts"));
            let decay = self.settings.codebook_decay;
            let mut state = Book { codes: &mut book, sums: &mut sums, counts: &mut counts, decay };
            if let Some(first) = &first {
                state.start(&first[q]);
            }
            if q < active {
                let new_sums = after.sum(&of("sums", q));
                let new_counts = after.sum(&of("counts", q));
                let spare = after.sum(&of("rows", q));
                let rows = candidates(spare, codes, dim, |len| noise(len, &mut after.stream("replacements", q as u64)));
                if self.settings.resets == Resets::Remembering {
                    let mut used = take(&*after, "used");
                    let mut since = after.buffers.get(&of("since", q))[0];
                    state.update_remembering(new_sums, new_counts, &rows, &mut used, &mut since);
                    after.buffers.get_mut(&of("used", q)).copy_from_slice(&used);
                    after.buffers.get_mut(&of("since", q))[0] = since;
                } else {
                    state.update(new_sums, new_counts, &rows);
                }
            }
            after.buffers.get_mut(&of("codebook", q)).copy_from_slice(&book);
            after.buffers.get_mut(&of("sums", q)).copy_from_slice(&sums);
            after.buffers.get_mut(&of("counts", q)).copy_from_slice(&counts);
        }
        self.first = None;
        Ok(())
    }
}

impl Gang for TrainTokenizer {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let mut windows = TokenWindows::read(cx, self.window, self.windows_of)?;
        windows.dataset.std = windows.dataset.biased_std(self.feature_bias);
        let dataset = &windows.dataset;
        let meta = TokenizerMeta {
            format: dataset.format,
            features: dataset.mean.len(),
            codes: self.codes,
            code_dim: self.code_dim,
            quantizers: self.quantizers,
            network: self.network.clone(),
            mean: dataset.mean.clone(),
            std: dataset.std.clone(),
        };
        let tracked = cx.device().autodiff();
        let seed = windows.seed;
        let purpose = windows.purpose.clone();
        let mut init = Init::new(seed, &format!("{purpose}/init"), Positions::Uniform, &tracked);
        let mut start = WarmStart::find(cx, ArtifactKind::Tokenizer)?;
        let network = start.take(Tokenizer::new(&meta.config(), &mut init), "")?;
        let given = start.values(&meta.books(), "")?.unwrap_or_else(|| vec![None; self.quantizers]);
        start.finish(cx, &meta)?;
        let mut objective = VqObjective {
            settings: self.clone(),
            network,
            order: Order::new(seed, &purpose, windows.examples(), self.training.batch.global, 1),
            windows,
            books: Vec::new(),
            given,
            first: None,
            dropout_seed: dropout_seed(cx),
            device: cx.device(),
        };
        train(&mut objective, &self.training, cx)?.publish(|state| {
            let names: Vec<String> = (0..self.quantizers).map(|q| of("codebook", q)).collect();
            let books: Vec<&[f32]> = names.iter().map(|name| state.buffers.get(name)).collect();
            meta.publish(cx, state.trained(0), &books)
        })
    }
}
