//! `distill.discord`: a flow decoder with one or two jumps, distilled from one that follows its flow. Source:
//! consistency distillation (Song et al., arXiv:2303.01469) as in `distill.lcm`, applied to DisCoRD's flow. This is
//! unpublished, so sizes and settings are ours.
//!
//! The student's function `f(x, t) = x + (1 - t) v(x, t)` maps any time to the data; at time 1 it is the identity for
//! any network. The loss compares it at a point `k / K` of a grid with the target at the next point, which one step of
//! the teacher's solver reaches. The target is the student's moving average. The student starts as the teacher. Frozen
//! networks run without dropout. The result is the online network.

use models::flat::Values;
use models::flow::{Solver, between, to_data};
use models::kernels::Dropout;
use models::losses;
use models::networks::Init;
use protocol::ArtifactKind;
use protocol::stage::{Distance, DistillDiscord};

use crate::artifacts::{self, to_meta};
use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::flow_decoder::{Field, FlowDecoder, FlowMeta, FlowPath};
use crate::parts::warm_start::WarmStart;
use crate::parts::weights;
use crate::train::data::flow::{Encoder, FlowData, field_group, field_result};
use crate::train::network::dropout_seed;
use crate::train::{Average, GroupPlan, Losses, Objective, SliceResult, TrainState, train};

struct Student {
    settings: DistillDiscord,
    data: FlowData,
    teacher: Field,
    solver: Solver,
    student: Field,
    target: Field,
    dropout: f64,
    dropout_seed: u64,
}

impl Objective for Student {
    fn groups(&mut self) -> Vec<GroupPlan> {
        // The target network is the average, for any decay.
        let group = field_group(&self.student, &self.settings.training, 0.0);
        vec![GroupPlan { average: Some(Average::of(self.settings.ema)), ..group }]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL]
    }

    fn load(&mut self, state: &TrainState) {
        let group = &state.groups[0];
        self.student.take(group.trained());
        // The group was created with an average.
        self.target.take(group.averaged());
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.data.slice(step, slice);
        let intervals = self.settings.intervals;
        let index: Vec<usize> =
            batch.uniforms.iter().map(|u| ((u * intervals as f32) as usize).min(intervals - 1)).collect();
        let at = |ahead: usize| -> Vec<f32> { index.iter().map(|k| (k + ahead) as f32 / intervals as f32).collect() };
        let from = at(0);
        let to = at(1);
        let noisy = between(batch.data_btf, batch.noise_btf, &from);
        let codes = batch.codes_bnd;
        let frozen = |field: &Field, x, t: &[f32]| field.velocity(x, t, codes.clone(), &mut Dropout::off());
        let solved = self.solver.step(noisy.clone(), &from, &to, |x, t| frozen(&self.teacher, x, t));
        let target = to_data(solved.clone(), frozen(&self.target, solved, &to), &to);
        let mut dropout = Dropout::new(self.dropout, self.dropout_seed, step, slice as u64);
        let found = self.student.velocity(noisy.clone(), &from, codes.clone(), &mut dropout);
        let found = to_data(noisy, found, &from);
        let distance = match self.settings.distance {
            Distance::Huber => losses::pseudo_huber(found, target, self.settings.huber_c),
            Distance::L2 => losses::mse(found, target),
        };
        let mut losses = Losses::new(self.settings.training.batch.global);
        losses.add("consistency", distance, 1.0);
        field_result(&self.student, &losses, &self.terms())
    }
}

impl Gang for DistillDiscord {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let (encoder, role, digest) = Encoder::read(cx, !self.vae.is_empty())?;
        let (_, manifest) = artifacts::input(cx, "teacher", ArtifactKind::FlowDecoder)?;
        let blobs = cx.blobs();
        let teacher = FlowDecoder::read(&*blobs, &manifest, (&role, digest), &cx.device())?;
        let Some(solver) = teacher.meta().solver.followed() else {
            return Err(StageError::Input("`teacher` is a student; expected a `train.discord` stage".into()));
        };
        let data = FlowData::read(cx, encoder, (self.window, self.windows_of), &self.training)?;
        let meta = FlowMeta { solver: FlowPath::Jumps, steps: self.solver_steps, ..teacher.meta().clone() };
        let tracked = cx.device().autodiff();
        let mut student = meta.field(&mut Init::blank(&tracked));
        let field = teacher.into_field();
        student.take(Values::Host(&field.params()));
        let mut start = WarmStart::find(cx, ArtifactKind::FlowDecoder)?;
        let student = student.begun_with(&mut start)?;
        start.finish(cx, &meta)?;
        let mut objective = Student {
            settings: self.clone(),
            data,
            solver,
            student,
            target: field.clone(),
            teacher: field,
            dropout: meta.network.dropout,
            dropout_seed: dropout_seed(cx),
        };
        train(&mut objective, &self.training, cx)?
            .publish(|state| weights::publish(cx, ArtifactKind::FlowDecoder, to_meta(&meta), state.online(0)))
    }
}
