//! `distill.pcm`: phased consistency distillation with a discriminator. Source: MotionPCM (arXiv:2501.19083), Algorithm
//! 1, and the image repository that it follows.
//!
//! Student and target jump to the edge `s_m` of their phase, `F(z, t, s) = A z + E eps`. At grid points next to an edge
//! the target is the teacher's step itself. The discriminator reads block features of the frozen teacher at a level `s`
//! within the phase. Fake is the student's jump, noised from `s_m`; real is the data latent noised to `s`, with
//! independent noise.
//!
//! Readings and departures: the student's input is the noised latent (the paper's line 10 is an error). Hinge signs are
//! those of Algorithm 1, not of Eq. 13. Levels end at the true next edge. Unless `alternate` is set, both networks are
//! updated in every step from gradients of the same step, so that one exchange carries both. The discriminator
//! therefore sees the student before its update.

use burn::tensor::Tensor;
use models::diffusion::{Phases, affine, unzip};
use models::flat;
use models::kernels::Dropout;
use models::losses;
use models::networks::{Discriminator, Init};
use protocol::stage::{DistillPcm, StageSpec, Training};

use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::train::consistency::{Distiller, SolverStep};
use crate::train::network::{group, slice_result};
use crate::train::{GroupPlan, Losses, Objective, SliceResult, TrainState, Turns, train};
use burn::module::Module;

struct Pcm {
    distiller: Distiller,
    settings: DistillPcm,
    phases: Phases,
    heads: Option<Discriminator>,
}

impl Objective for Pcm {
    fn groups(&mut self) -> Vec<GroupPlan> {
        let Some(heads) = &self.heads else { return vec![self.distiller.group()] };
        let training = &self.settings.distillation.training;
        let lr = if self.settings.discriminator_lr > 0.0 { self.settings.discriminator_lr } else { training.lr };
        let heads = GroupPlan {
            optimizer: (&self.settings.discriminator_optimizer).into(),
            ..group("heads", heads, &Training { lr, ..training.clone() }, 0.0)
        };
        let [student, critic] = self.turns();
        vec![self.distiller.group().taking(student, training.steps.0), heads.taking(critic, training.steps.0)]
    }

    fn terms(&self) -> Vec<&'static str> {
        let all = [Losses::TOTAL, "consistency", "adversarial", "discriminator"];
        all[..if self.heads.is_some() { 4 } else { 1 }].to_vec()
    }

    fn load(&mut self, state: &TrainState) {
        self.distiller.load(state);
        if let Some(heads) = &mut self.heads {
            state.groups[1].trained().assign(heads);
        }
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let solved = self.distiller.solve(step, slice);
        let phases: Vec<usize> = solved.index.iter().map(|i| self.phases.phase_of(*i)).collect();
        let edges: Vec<usize> = phases.iter().map(|m| self.phases.edge_time(*m)).collect();

        // The jump from a point to itself is the identity; that is the target next to an edge (t' = s_m).
        let (a, e) = unzip(solved.to.iter().zip(&edges).map(|(t, s)| self.distiller.noise.jump(*t, *s)));
        let target = affine(solved.solved_bnd.clone(), self.distiller.target_out(&solved, step, slice), &a, &e);
        let (a, e) = unzip(solved.from.iter().zip(&edges).map(|(t, s)| self.distiller.noise.jump(*t, *s)));
        let student = affine(solved.noisy_bnd.clone(), self.distiller.student_out(&solved, step, slice), &a, &e);

        let global = self.settings.distillation.training.batch.global;
        let mut all = Losses::new(global);
        all.add("consistency", self.distiller.distance(student.clone(), target), 1.0);
        let Some(heads) = &self.heads else { return slice_result(&self.distiller.student, &all, &self.terms()) };

        let levels: Vec<usize> = solved
            .batch
            .picks
            .iter()
            .zip(&phases)
            .zip(&edges)
            .map(|((pick, m), edge)| {
                edge + self.distiller.data.stream("level", *pick).below(self.phases.next_edge_time(*m) - edge)
            })
            .collect();
        let (fake, real) = self.levels(&solved, student, &edges, &levels);
        let text = &solved.batch.text_blc;
        let features = |z: Tensor<3>| self.distiller.teacher.features(z, &levels, text.clone(), &mut Dropout::off());

        let fake_features = features(fake);
        let detached: Vec<Tensor<3>> = fake_features.iter().map(|f| f.clone().inner()).collect();
        let adversarial = losses::hinge_generator(heads.valid().forward(fake_features));
        all.add("adversarial", adversarial, self.settings.adversarial);
        let critic =
            losses::hinge_discriminator(heads.forward(features(real)), heads.forward(detached)) / global as f32;
        all.note("discriminator", critic.clone().inner().into_scalar::<f32>());
        let total = all.total().expect("the consistency is part of it");
        let [student_turns, critic_turns] = self.turns().map(|turns| turns.turn(step).is_some());
        let gradients = vec![
            if student_turns { flat::gradient(&self.distiller.student, total) } else { Vec::new() },
            if critic_turns { flat::gradient(heads, critic) } else { Vec::new() },
        ];
        Ok(SliceResult { gradients, terms: all.values(&self.terms()), ..SliceResult::default() })
    }
}

impl Pcm {
    /// The steps that train the student, and the steps that train the discriminator.
    fn turns(&self) -> [Turns; 2] {
        if self.settings.alternate {
            [Turns::ALWAYS.one_in(2, 0), Turns::ALWAYS.one_in(2, 1)]
        } else {
            [Turns::ALWAYS, Turns::ALWAYS]
        }
    }

    /// The student's jump, noised from `s_m` to the level (on the tape), and the data latent noised to the level.
    fn levels(
        &self,
        solved: &SolverStep,
        student: Tensor<3>,
        edges: &[usize],
        levels: &[usize],
    ) -> (Tensor<3>, Tensor<3>) {
        let picks = &solved.batch.picks;
        let (a, e) = unzip(edges.iter().zip(levels).map(|(m, s)| self.distiller.noise.transition(*m, *s)));
        let fake = affine(student, self.distiller.data.noise("fake", picks), &a, &e);
        let (a, e) = unzip(levels.iter().map(|s| self.distiller.noise.add_noise(*s)));
        let real = affine(solved.batch.clean_bnd.clone(), self.distiller.data.noise("real", picks), &a, &e);
        (fake, real)
    }
}

impl Gang for DistillPcm {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let distiller = Distiller::read(cx, &self.distillation)?;
        let phases = Phases::new(&distiller.grid, self.phases);
        let heads = (self.adversarial > 0.0).then(|| {
            let device = cx.device().autodiff();
            let purpose = format!("{}/heads", cx.task().name);
            let network = &distiller.teacher_meta.network;
            let mut init = Init::new(cx.task().seed, &purpose, network.positions, &device);
            Discriminator::new(network.layers, network.width, self.discriminator_slope, &mut init)
        });
        let mut objective = Pcm { distiller, settings: self.clone(), phases, heads };
        train(&mut objective, &self.distillation.training, cx)?.publish(|state| {
            let family = self.family().expect("a distillation gives a student");
            objective.distiller.publish(cx, family, state.online(0))
        })
    }
}
