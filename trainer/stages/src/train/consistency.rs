//! Common part of both distillations: the student and its target, the frozen teacher, and one guided solver step
//! between neighbouring grid points. Source: MotionLCM (arXiv:2404.19759), after Luo et al., arXiv:2310.04378.
//!
//! The student starts as the teacher plus a zero guidance projection. The target is the moving average of the student.
//! Frozen networks run without dropout unless `upstream_dropout` reproduces the original script's mistake.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor};
use checkpoint::model::Model;
use models::diffusion::{Grid, Schedule, TIMESTEPS, affine, guided_by, unzip};
use models::flat::{self, Entry};
use models::kernels::Dropout;
use models::losses;
use models::networks::{Denoiser, Init, guidance_embedding};
use protocol::artifact::Role;
use protocol::stage::{Distance, Distillation, Family};
use protocol::{ArtifactKind, Digest, Manifest};
use serde_json::json;

use super::data::latents::{self, LatentData, LatentSlice};
use super::network::{dropout_seed, group};
use super::{Average, GroupPlan, TrainState};
use crate::artifacts::{self, DenoiserMeta};
use crate::context::{AttemptContext, GangContext, StageError};
use crate::parts::warm_start::WarmStart;
use crate::parts::{self, model_error, weights};

/// Networks and data of a distillation.
pub(crate) struct Distiller {
    pub(crate) settings: Distillation,
    pub(crate) data: LatentData,
    pub(crate) teacher: Denoiser,
    pub(crate) teacher_meta: DenoiserMeta,
    /// The teacher's model, whose other parts the student keeps.
    base: Model,
    pub(crate) student: Denoiser,
    target: Denoiser,
    pub(crate) noise: Schedule,
    pub(crate) grid: Grid,
    pub(crate) device: Device,
    seed: u64,
}

/// The teacher's step of one slice, and its inputs.
pub(crate) struct SolverStep {
    pub(crate) batch: LatentSlice,
    /// Grid index of each sample.
    pub(crate) index: Vec<usize>,
    /// The student's starting timesteps.
    pub(crate) from: Vec<usize>,
    /// Timesteps at the end of the teacher's step.
    pub(crate) to: Vec<usize>,
    /// Noised latents [B, N, d].
    pub(crate) noisy_bnd: Tensor<3>,
    /// Result of the teacher's guided step [B, N, d].
    pub(crate) solved_bnd: Tensor<3>,
    /// Guidance embeddings [B, g].
    pub(crate) guidance_bg: Tensor<2>,
}

impl Distiller {
    /// Reads the inputs and builds the networks.
    pub(crate) fn read(cx: &mut dyn GangContext, settings: &Distillation) -> Result<Self, StageError> {
        let data = LatentData::read(cx, &settings.training, 1)?;
        let blobs = cx.blobs();
        let (_, manifest) = artifacts::input(cx, "teacher", ArtifactKind::Model)?;
        let base = Model::read(&manifest).map_err(model_error)?;
        let manifest = parts::part(&*blobs, &base, &Role::DENOISER, ArtifactKind::Denoiser)?;
        let teacher_meta: DenoiserMeta = artifacts::meta(&manifest, "the teacher")?;
        if teacher_meta.family != Family::Mld {
            return Err(StageError::Input("`teacher` is a student; expected a `train.mld` stage".into()));
        }
        if teacher_meta.fits.get(&Role::VAE) != Some(&data.vae()) {
            return Err(StageError::Input(
                "`latents` were encoded with another VAE than the teacher's; use the teacher's latents".into(),
            ));
        }
        if teacher_meta.fits.get(&Role::TEXT) != Some(&data.text_meta().text) {
            return Err(StageError::Input(
                "`text` was embedded with another encoder than the teacher's; use the teacher's `text`".into(),
            ));
        }
        let device = cx.device();
        let blank = |guidance: Option<usize>, device: &Device| {
            let config = models::networks::DenoiserConfig { guidance_dim: guidance, ..teacher_meta.config() };
            Denoiser::new(&config, &mut Init::blank(device))
        };
        let teacher = weights::load(blank(None, &device), &*blobs, &manifest, "the teacher")?;
        let tracked = device.clone().autodiff();
        let student = start_from(blank(Some(settings.guidance_dim), &tracked), &teacher);
        let target = start_from(blank(Some(settings.guidance_dim), &device), &teacher);
        let mut start = WarmStart::find(cx, ArtifactKind::Denoiser)?;
        let student = start.take(student, "")?;
        let DenoiserMeta { network, diffusion, text_relu, text_dim, fits, .. } = &teacher_meta;
        let ours = json!({"network": network, "diffusion": diffusion, "text_relu": text_relu, "text_dim": text_dim, "fits": fits});
        start.finish(cx, &ours)?;
        Ok(Self {
            settings: settings.clone(),
            data,
            teacher,
            noise: Schedule::new(&teacher_meta.diffusion, TIMESTEPS),
            teacher_meta,
            base,
            student,
            target,
            grid: Grid::new(settings.skip),
            device,
            seed: dropout_seed(cx),
        })
    }

    /// The student as a group of parameters.
    pub(crate) fn group(&self) -> GroupPlan {
        // The target network is the average, for any decay.
        GroupPlan {
            average: Some(Average::of(self.settings.ema)),
            ..group("model", &self.student, &self.settings.training, 0.0)
        }
    }

    /// Loads student and target from the state.
    pub(crate) fn load(&mut self, state: &TrainState) {
        let group = &state.groups[0];
        group.trained().assign(&mut self.student);
        // The group was created with an average.
        group.averaged().assign(&mut self.target);
    }

    /// Dropout of the student in one slice.
    pub(crate) fn dropout(&self, step: u64, slice: usize) -> Dropout {
        Dropout::new(self.teacher_meta.network.dropout, self.seed, step, slice as u64)
    }

    /// Dropout of a frozen network in one slice; `which` separates the networks.
    fn frozen(&self, step: u64, slice: usize, which: u64) -> Dropout {
        if self.settings.upstream_dropout {
            Dropout::new(self.teacher_meta.network.dropout, self.seed ^ which, step, slice as u64)
        } else {
            Dropout::off()
        }
    }

    /// Draws one slice and moves it one solver step with the teacher: points 2, 3 and 5 of MotionLCM's iteration.
    pub(crate) fn solve(&mut self, step: u64, slice: usize) -> SolverStep {
        let batch = self.data.slice(step, slice, 0.0);
        let (low, high) = self.settings.guidance;
        let mut index = Vec::new();
        let mut w = Vec::new();
        for pick in &batch.picks {
            let mut draw = self.data.stream("distillation", *pick);
            index.push(draw.below(self.grid.steps));
            #[expect(clippy::cast_possible_truncation, reason = "a scale")]
            w.push(draw.range(low, high) as f32);
        }
        let from: Vec<usize> = index.iter().map(|i| self.grid.tau(*i)).collect();
        let to: Vec<usize> = index.iter().map(|i| self.grid.prev(*i)).collect();
        let noise = self.data.noise("noise", &batch.picks);
        let (a, e) = unzip(from.iter().map(|t| self.noise.add_noise(*t)));
        let noisy = affine(batch.clean_bnd.clone(), noise, &a, &e);

        let twice = |x: &Tensor<3>, y: &Tensor<3>| Tensor::cat(vec![x.clone(), y.clone()], 0);
        let both: Vec<usize> = from.iter().chain(&from).copied().collect();
        let texts = twice(&batch.text_blc, &batch.null_blc);
        let mut dropout = self.frozen(step, slice, 1);
        let out = self.teacher.forward(twice(&noisy, &noisy), &both, texts, None, &mut dropout);
        let [count, tokens, dim] = noisy.dims();
        let conditional = out.clone().slice([0..count, 0..tokens, 0..dim]);
        let unconditional = out.slice([count..2 * count, 0..tokens, 0..dim]);
        let out = guided_by(conditional, unconditional, &w);
        let (a, e) = unzip(from.iter().zip(&to).map(|(t, s)| self.noise.jump(*t, *s)));
        let solved = affine(noisy.clone(), out, &a, &e);
        let guidance = guidance_embedding(&w, self.settings.guidance_dim, &self.device);
        SolverStep { batch, index, from, to, noisy_bnd: noisy, solved_bnd: solved, guidance_bg: guidance }
    }

    /// The student's output at the start of the step, on the tape.
    pub(crate) fn student_out(&self, solved: &SolverStep, step: u64, slice: usize) -> Tensor<3> {
        let mut dropout = self.dropout(step, slice);
        self.student.forward(
            solved.noisy_bnd.clone(),
            &solved.from,
            solved.batch.text_blc.clone(),
            Some(solved.guidance_bg.clone()),
            &mut dropout,
        )
    }

    /// The target's output at the end of the step.
    pub(crate) fn target_out(&self, solved: &SolverStep, step: u64, slice: usize) -> Tensor<3> {
        let mut dropout = self.frozen(step, slice, 2);
        self.target.forward(
            solved.solved_bnd.clone(),
            &solved.to,
            solved.batch.text_blc.clone(),
            Some(solved.guidance_bg.clone()),
            &mut dropout,
        )
    }

    /// Sum over samples of the mean distance of `student` and `target`.
    pub(crate) fn distance(&self, student: Tensor<3>, target: Tensor<3>) -> Tensor<1> {
        match self.settings.distance {
            Distance::Huber => losses::pseudo_huber(student, target, self.settings.huber_c),
            Distance::L2 => losses::mse(student, target),
        }
    }

    /// Uploads the student: the teacher's model with another denoiser.
    pub(crate) fn publish(
        &self,
        cx: &mut dyn AttemptContext,
        family: Family,
        trained: (&[Entry], &[f32]),
    ) -> Result<Digest, StageError> {
        let meta = DenoiserMeta { family, guidance_dim: self.settings.guidance_dim, ..self.teacher_meta.clone() };
        let blobs = cx.blobs();
        let others = self.base.parts.iter().filter(|(role, _)| **role != Role::DENOISER);
        let part = |(role, digest): (&Role, &Digest)| {
            Ok((role.clone(), parts::manifest(&*blobs, *digest, &format!("the part `{role}`"))?))
        };
        let parts: BTreeMap<Role, Manifest> = others.map(part).collect::<Result<_, StageError>>()?;
        latents::publish(cx, self.base.format, &meta, trained, parts)
    }
}

/// Copies the parameters that both have from the teacher; the guidance projection stays zero.
fn start_from(student: Denoiser, teacher: &Denoiser) -> Denoiser {
    let from: std::collections::HashMap<String, (usize, Entry)> = {
        let mut at = 0;
        let mut all = std::collections::HashMap::new();
        for entry in flat::layout(teacher) {
            let len = entry.len();
            all.insert(entry.name.clone(), (at, entry));
            at += len;
        }
        all
    };
    let values = flat::read(teacher);
    let mut params = Vec::new();
    for entry in flat::layout(&student) {
        match from.get(&entry.name) {
            Some((at, theirs)) => params.extend_from_slice(&values[*at..at + theirs.len()]),
            None => params.extend(std::iter::repeat_n(0.0, entry.len())),
        }
    }
    flat::write(student, &params)
}
