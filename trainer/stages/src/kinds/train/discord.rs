//! `train.discord`: a rectified flow from noise to motion, conditioned on the codes of frozen tokens or of a frozen
//! VAE's latents. Source: DisCoRD (Cho et al., arXiv:2411.19527).
//!
//! `t ~ U(0, 1)`, `x_t = t x + (1 - t) noise`, loss `mean (v(x_t, t, z) - (x - noise))^2`, on windows; z is encoded
//! from the window alone, as published. Time is 0 at noise and 1 at data.
//!
//! Departs: z is computed in each step instead of being kept in memory. The result is the moving average, which the
//! released script computes and never uses. With `prediction: data` the network predicts the data x'. The loss is then
//! `mean (x' - x)^2`, without the weight of the velocity, and the velocity is `(x' - x_t) / (1 - t)`.

use checkpoint::model::Parts;
use models::kernels::Dropout;
use models::losses;
use models::networks::Init;
use protocol::ArtifactKind;
use protocol::stage::{Positions, TrainDiscord};

use crate::artifacts::to_meta;
use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::flow_decoder::{Field, FlowMeta};
use crate::parts::warm_start::WarmStart;
use crate::parts::weights;
use crate::train::data::flow::{Encoder, FlowData, FlowSlice, field_group, field_result};
use crate::train::network::dropout_seed;
use crate::train::{GroupPlan, Losses, Objective, SliceResult, TrainState, train};

struct Flow {
    settings: TrainDiscord,
    data: FlowData,
    field: Field,
    dropout_seed: u64,
}

impl Objective for Flow {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![field_group(&self.field, &self.settings.training, self.settings.ema)]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL]
    }

    fn load(&mut self, state: &TrainState) {
        self.field.take(state.groups[0].trained());
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let FlowSlice { data_btf: data, noise_btf: noise, codes_bnd: codes, uniforms: times } =
            self.data.slice(step, slice);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let (found, target) = self.field.compared((data, noise), &times, codes, &mut dropout);
        let mut losses = Losses::new(self.settings.training.batch.global);
        losses.add("flow", losses::mse(found, target), 1.0);
        field_result(&self.field, &losses, &self.terms())
    }
}

impl Gang for TrainDiscord {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let (encoder, role, digest) = Encoder::read(cx, !self.vae.is_empty())?;
        let data = FlowData::read(cx, encoder, (self.window, self.windows_of), &self.training)?;
        let (features, code_dim) = data.encoder().widths();
        let meta = FlowMeta {
            format: data.format(),
            features,
            code_dim,
            backbone: self.backbone,
            prediction: self.prediction,
            network: self.network.clone(),
            solver: self.solver.into(),
            steps: self.solver_steps,
            fits: Parts::from([(role, digest)]),
        };
        let tracked = cx.device().autodiff();
        let (seed, purpose) = data.purpose();
        let field = meta.field(&mut Init::new(seed, &format!("{purpose}/init"), Positions::Uniform, &tracked));
        let mut start = WarmStart::find(cx, ArtifactKind::FlowDecoder)?;
        let field = field.begun_with(&mut start)?;
        start.finish(cx, &meta)?;
        let mut objective = Flow { settings: self.clone(), data, field, dropout_seed: dropout_seed(cx) };
        train(&mut objective, &self.training, cx)?
            .publish(|state| weights::publish(cx, ArtifactKind::FlowDecoder, to_meta(&meta), state.trained(0)))
    }
}
