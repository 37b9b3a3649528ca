//! `distill.lcm`: latent consistency distillation. Source: MotionLCM (arXiv:2404.19759).
//!
//! The student's `y = c_skip(t) z_t + c_out(t) z_0(z_t, t)` is compared with the target's at the end of the teacher's
//! solver step.

use models::diffusion::{affine, consistency, unzip};
use protocol::stage::{DistillLcm, StageSpec};

use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::train::consistency::Distiller;
use crate::train::network::slice_result;
use crate::train::{GroupPlan, Losses, Objective, SliceResult, TrainState, train};

struct Lcm(Distiller);

impl Objective for Lcm {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![self.0.group()]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL]
    }

    fn load(&mut self, state: &TrainState) {
        self.0.load(state);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let it = &mut self.0;
        let solved = it.solve(step, slice);
        let (a, e) = unzip(solved.to.iter().map(|t| consistency(&it.noise, *t)));
        let target = affine(solved.solved_bnd.clone(), it.target_out(&solved, step, slice), &a, &e);
        let (a, e) = unzip(solved.from.iter().map(|t| consistency(&it.noise, *t)));
        let student = affine(solved.noisy_bnd.clone(), it.student_out(&solved, step, slice), &a, &e);
        let mut losses = Losses::new(it.settings.training.batch.global);
        losses.add("consistency", it.distance(student, target), 1.0);
        slice_result(&self.0.student, &losses, &self.terms())
    }
}

impl Gang for DistillLcm {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let mut objective = Lcm(Distiller::read(cx, &self.distillation)?);
        train(&mut objective, &self.distillation.training, cx)?.publish(|state| {
            // The result is the online network, as upstream; its average was only the target.
            let family = self.family().expect("a distillation gives a student");
            objective.0.publish(cx, family, state.online(0))
        })
    }
}
