//! `train.discord`: a rectified flow from noise to motion under the codes of frozen tokens. Source: DisCoRD (Cho et al., arXiv:2411.19527).
//!
//! `t ~ U(0, 1)`, `x_t = t x + (1 - t) noise`, loss `mean (v(x_t, t, z) - (x - noise))^2`, on windows; z is encoded from the window alone, as
//! published. Time runs from noise at 0 to data at 1.
//!
//! Departs: z is computed in each step instead of being kept in memory; the moving average, which the released script computes and never
//! uses, is the result.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::model::Parts;
use models::flow::between;
use models::kernels::Dropout;
use models::losses;
use models::networks::Init;
use motion::Stream;

use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::{Positions, TrainDiscord};

use super::token_windows::TokenWindows;
use super::{Gang, dropout_seed, group, slice_result};
use crate::artifacts::{self, to_meta};
use crate::context::{GangContext, Outcome, StageError};
use crate::flow_decoder::{Field, FlowMeta};
use crate::tokenizer::TrainedTokenizer;
use crate::train::{GroupPlan, Losses, Objective, Order, SliceResult, TrainState, Trained, train};
use crate::weights;

struct Flow {
    settings: TrainDiscord,
    windows: TokenWindows,
    tokenizer: TrainedTokenizer,
    order: Order,
    field: Field,
    dropout_seed: u64,
    device: Device,
}

impl Objective for Flow {
    fn groups(&mut self) -> Vec<GroupPlan> {
        let (training, ema) = (&self.settings.training, self.settings.ema);
        vec![match &self.field {
            Field::Unet(network) => group("model", network, training, ema),
            Field::Dit(network) => group("model", network, training, ema),
        }]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL]
    }

    fn load(&mut self, state: &TrainState) {
        let params = state.groups[0].trained();
        match &mut self.field {
            Field::Unet(network) => params.assign(network),
            Field::Dit(network) => params.assign(network),
        }
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.settings.training.batch;
        let range = self.order.slice(slice, batch.slices);
        let picks = self.order.batch(step, |_| 0)[range].to_vec();
        let (frames, width) = (self.settings.window, self.windows.dataset.mean.len());
        let mut rows = self.windows.rows(&picks);
        self.tokenizer.normalise(&mut rows);
        let codes: Vec<f32> = rows
            .chunks_exact(frames * width)
            .flat_map(|window| self.tokenizer.codes(&self.tokenizer.encode(window.to_vec())))
            .collect();
        let (mut noise, mut times) = (vec![0.0; rows.len()], Vec::with_capacity(picks.len()));
        for (pick, noise) in picks.iter().zip(noise.chunks_exact_mut(frames * width)) {
            let mut draw = Stream::new(self.windows.seed, &format!("{}/flow", self.windows.purpose), pick.place, 0);
            times.push(draw.uniform() as f32);
            draw.fill_normal(noise);
        }
        let tensor =
            |values: Vec<f32>, shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values, shape), &self.device);
        let shape = [picks.len(), frames, width];
        let (data, noise) = (tensor(rows, shape), tensor(noise, shape));
        let dim = self.tokenizer.meta().code_dim;
        let codes = tensor(codes, [picks.len(), frames / self.tokenizer.unit(), dim]);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let found = self.field.velocity(between(data.clone(), noise.clone(), &times), &times, codes, &mut dropout);
        let mut losses = Losses::new(batch.global);
        losses.add("flow", losses::mse(found, data - noise), 1.0);
        match &self.field {
            Field::Unet(network) => slice_result(network, &losses, &self.terms()),
            Field::Dit(network) => slice_result(network, &losses, &self.terms()),
        }
    }
}

impl Gang for TrainDiscord {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let windows = TokenWindows::read(cx, self.window, self.windows_of)?;
        let (digest, manifest) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        let tokenizer = TrainedTokenizer::read(&*cx.blobs(), &manifest, &cx.device())?;
        tokenizer.check_format(windows.dataset.format)?;
        let meta = FlowMeta {
            format: windows.dataset.format,
            features: tokenizer.meta().features,
            code_dim: tokenizer.meta().code_dim,
            backbone: self.backbone,
            network: self.network.clone(),
            solver: self.solver,
            steps: self.solver_steps,
            fits: Parts::from([(Role::TOKENIZER, digest)]),
        };
        let tracked = cx.device().autodiff();
        let (seed, purpose) = (windows.seed, windows.purpose.clone());
        let mut init = Init::new(seed, &format!("{purpose}/init"), Positions::Uniform, &tracked);
        let mut objective = Flow {
            settings: self.clone(),
            field: meta.field(&mut init),
            order: Order::new(seed, &purpose, windows.examples(), self.training.batch.global, 1),
            windows,
            tokenizer,
            dropout_seed: dropout_seed(cx),
            device: cx.device(),
        };
        match train(&mut objective, &self.training, cx)? {
            Trained::Yielded { at } => Ok(Outcome::Yielded { at }),
            Trained::Finished { state, metrics } => {
                let trained = (&state.groups[0].entries[..], state.result(0));
                let output = weights::publish(cx, ArtifactKind::FlowDecoder, to_meta(&meta), trained)?;
                Ok(Outcome::Finished { output, metrics })
            }
        }
    }
}
