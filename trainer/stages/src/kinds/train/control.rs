//! `train.control`: a trajectory encoder and a ControlNet beside a frozen latent denoiser. Source: MotionLCM (Dai et
//! al., ECCV 2024; v2 of late 2024).
//!
//! The ControlNet starts as a copy of the denoiser whose residuals are zero. `z_t = alpha_t z_0 + sigma_t eps`. The
//! controlled denoiser's clean latent is compared with `z_0` (a teacher's output with its usual target). The joints of
//! its motion, through the frozen decoder, are compared with the target positions. Only trajectory encoder and
//! ControlNet are trained, with dropout; everything else is frozen and runs without.
//!
//! A phased student (MotionPCM) is trained the same way, which is unpublished. From a given `z_t` its jump to any edge
//! differs from the true one by a constant times the error of the clean latent, so one loss serves both students.
//!
//! Ours: `loss.tokens` compares the trajectory encoder's tokens directly with `z_0`. `feedback` trains a third network,
//! which corrects the prediction in rounds. Each round's latent and motion have the same terms as the prediction,
//! averaged over rounds. No gradient flows from a round to earlier ones.
//!
//! Departs: a sample without targets adds nothing to the motion term, where two of the three published means divide by
//! zero. Hints of KIT-ML are in metres too, so that one weight suits both datasets.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor};
use checkpoint::Blobs;
use checkpoint::model::{self, Model, Parts};
use models::diffusion::{Grid, Schedule, TIMESTEPS, affine, unzip};
use models::flat::{self, Entry};
use models::kernels::Dropout;
use models::losses::{self, Body, ControlTarget, Pointwise};
use models::networks::{Control, Denoiser, Feedback, Init, TrajectoryEncoder, copied_from, guidance_embedding};
use motion::Skeleton;
use motion::dataset::Dataset;
use protocol::artifact::Role;
use protocol::stage::{ControlDistance, ControlFeedback, ControlMean, ControlSetting, Family, TrainControl, Training};
use protocol::{ArtifactKind, Digest, Manifest};

use crate::artifacts::{self, DenoiserMeta, Draft, VaeMeta, to_meta};
use crate::context::{AttemptContext, GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::control::{CONTROLNET_PREFIX, ControlMeta, FEEDBACK_PREFIX, TRAJECTORY_PREFIX};
use crate::parts::feedback::Seen;
use crate::parts::hint::{Hint, NormalisedHints, joint_statistics, metres, told_count, told_frames};
use crate::parts::latent_networks::Autoencoder;
use crate::parts::warm_start::WarmStart;
use crate::parts::{self, model_error, weights};
use crate::train::data::latents::{LatentData, LatentSlice};
use crate::train::frequency::clean;
use crate::train::network::{dropout_seed, group};
use crate::train::{Clip, GroupPlan, Losses, Objective, Pick, SliceResult, TrainState, train};

/// Batches that are sorted by length together; a step's cost is mostly reading and decoding whole clips.
const POOL: usize = 8;
/// Name of the term on latents.
const LATENT: &str = "latent";
/// Name of the term on the trajectory encoder's tokens.
const TOKENS: &str = "tokens";
/// Name of the term on joints.
const CONTROL: &str = "control";
/// Name of the term on latents after rounds of feedback, averaged over rounds.
const FEEDBACK_LATENT: &str = "feedback_latent";
/// Name of the term on joints after rounds of feedback, averaged over rounds.
const FEEDBACK_CONTROL: &str = "feedback_control";

/// The frozen decoder of the motion term.
struct Decoder {
    vae: Autoencoder,
    body: Body,
    /// Metres in one unit of the data.
    metres: f32,
}

impl Decoder {
    /// Reads the VAE of `model`.
    fn read(blobs: &dyn Blobs, model: &Model, device: &Device) -> Result<Self, StageError> {
        let part = parts::part(blobs, model, &Role::VAE, ArtifactKind::Vae)?;
        let vae: VaeMeta = artifacts::meta(&part, "the VAE")?;
        let skeleton = Skeleton::of(vae.format);
        #[expect(clippy::cast_possible_truncation, reason = "a unit")]
        let metres = skeleton.metres_per_unit as f32;
        let body = Body::new(skeleton, &vae.mean, &vae.std, device);
        Ok(Self { vae: Autoencoder::read(blobs, &part, device)?, body, metres })
    }
}

/// The term that compares motions with their targets.
struct MotionTerm<'a> {
    decoder: &'a Decoder,
    /// Number of frames of each motion.
    lengths: &'a [usize],
    target: ControlTarget,
    distance: Pointwise,
    /// Weight of each motion.
    weights: Vec<f32>,
}

impl MotionTerm<'_> {
    /// Decodes latents to features [B, T, D].
    fn decode(&self, latent_bnd: Tensor<3>) -> Tensor<3> {
        self.decoder.vae.decode_tensor(latent_bnd, self.lengths)
    }

    /// The distance of the joints from their targets. It is summed over the slice so that dividing by the global batch
    /// gives the configured mean.
    fn of(&self, features: Tensor<3>) -> Tensor<1> {
        let joints = self.decoder.body.joints(features);
        let metres = self.decoder.metres;
        let joints = if metres == 1.0 { joints } else { joints * metres };
        self.target.loss(joints, self.distance, &self.weights)
    }
}

struct Controlled {
    settings: TrainControl,
    data: LatentData,
    dataset: Dataset,
    /// Indices of the joints that may get targets.
    joints: Vec<usize>,
    base: Denoiser,
    base_meta: DenoiserMeta,
    meta: ControlMeta,
    control: Denoiser,
    trajectory: TrajectoryEncoder,
    feedback: Option<Feedback>,
    decoder: Option<Decoder>,
    noise: Schedule,
    seed: u64,
    device: Device,
}

/// Joints and frames of one example's targets.
struct Told {
    joints: Vec<usize>,
    frames: Vec<usize>,
}

impl Objective for Controlled {
    fn groups(&mut self) -> Vec<GroupPlan> {
        let training = &self.settings.training;
        let lr = if self.settings.trajectory_lr > 0.0 { self.settings.trajectory_lr } else { training.lr };
        let clip = (training.max_grad_norm > 0.0).then_some(Clip { norm: training.max_grad_norm, together: "control" });
        let own = Training { lr, ..training.clone() };
        let mut groups = vec![
            GroupPlan { clip, ..group("controlnet", &self.control, training, 0.0) },
            GroupPlan { clip, ..group("trajectory", &self.trajectory, &own, 0.0) },
        ];
        if let Some(network) = &self.feedback {
            let ControlFeedback { lr, .. } = self.settings.feedback;
            let own = Training { lr: if lr > 0.0 { lr } else { training.lr }, ..training.clone() };
            let clip = clip.map(|clip| Clip { together: "feedback", ..clip });
            groups.push(GroupPlan { clip, ..group("feedback", network, &own, 0.0) });
        }
        groups
    }

    fn terms(&self) -> Vec<&'static str> {
        let mut terms = vec![Losses::TOTAL, LATENT, TOKENS, CONTROL];
        if self.feedback.is_some() {
            terms.extend([FEEDBACK_LATENT, FEEDBACK_CONTROL]);
        }
        terms
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.control);
        state.groups[1].trained().assign(&mut self.trajectory);
        if let Some(network) = &mut self.feedback {
            state.groups[2].trained().assign(network);
        }
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let whole = self.data.picks(step);
        let batch = self.data.slice(step, slice, 0.0);
        let told = self.hints(&batch);
        let hints = NormalisedHints::of(&told, &self.meta.mean, &self.meta.std);
        let timesteps: Vec<usize> = batch.picks.iter().map(|pick| self.timestep(*pick)).collect();
        let noise = self.data.noise("noise", &batch.picks);
        let (a, e) = unzip(timesteps.iter().map(|t| self.noise.add_noise(*t)));
        let noisy = affine(batch.clean_bnd.clone(), noise.clone(), &a, &e);
        let mut drop = self.dropout(self.settings.network.dropout, 1, (step, slice as u64));
        let tokens = self.trajectory.forward(&hints.on(&self.device), &mut drop);
        let out = self.predict(&batch, &noisy, &timesteps, tokens.clone(), (step, slice as u64));

        let loss = &self.settings.loss;
        let mut all = Losses::new(self.settings.training.batch.global);
        if loss.tokens > 0.0 {
            all.add(TOKENS, losses::mse(tokens, batch.clean_bnd.clone()), loss.tokens);
        }
        let found = clean(&self.noise, noisy, out.clone(), &timesteps);
        if loss.latent > 0.0 {
            let sum = match self.base_meta.family {
                Family::Mld => losses::mse(out, self.noise.target(batch.clean_bnd.clone(), noise, &timesteps)),
                _ => losses::mse(found.clone(), batch.clean_bnd.clone()),
            };
            all.add(LATENT, sum, loss.latent);
        }
        if let Some(decoder) = &self.decoder {
            let motion = self.motion_term(decoder, &batch, &hints, &whole);
            let mut features = None;
            if loss.control > 0.0 {
                let decoded = motion.decode(found.clone());
                all.add(CONTROL, motion.of(decoded.clone()), loss.control);
                features = Some(decoded.inner());
            }
            if let Some(network) = &self.feedback {
                let drop = |round| self.dropout(self.settings.network.dropout, 3 + round, (step, slice as u64));
                self.rounds(&mut all, network, &motion, (found.inner(), features), (&batch, &told), &drop);
            }
        }
        let total = all.total().ok_or_else(|| StageError::Fault("every weight of the loss is 0".into()))?;
        let mut gradients = total.backward();
        let mut of = vec![
            flat::take_gradients(&self.control, &mut gradients),
            flat::take_gradients(&self.trajectory, &mut gradients),
        ];
        of.extend(self.feedback.as_ref().map(|network| flat::take_gradients(network, &mut gradients)));
        let terms = all.values(&self.terms());
        Ok(SliceResult { gradients: of, terms, ..SliceResult::default() })
    }
}

impl Controlled {
    fn timestep(&self, pick: Pick) -> usize {
        let mut draw = self.data.stream("timestep", pick);
        match self.base_meta.family {
            Family::Mld => draw.below(TIMESTEPS),
            _ => {
                let grid = Grid::new(self.settings.skip);
                grid.tau(draw.below(grid.steps))
            }
        }
    }

    /// Draws the targets of an example of `length` frames.
    fn told(&self, pick: Pick, length: usize) -> Told {
        let mut draw = self.data.stream("hint", pick);
        let setting = self.settings.hints.setting;
        let joints = match setting {
            ControlSetting::Temporal => self.joints.clone(),
            ControlSetting::Spatial => vec![self.joints[draw.below(self.joints.len())]],
        };
        let count = told_count(&self.settings.hints, length, &mut draw);
        Told { joints, frames: told_frames(setting, count, length, &mut draw) }
    }

    /// The hints of a slice: joints of the same crops from which its latents were encoded.
    fn hints(&self, batch: &LatentSlice) -> Vec<Hint> {
        let meta = self.data.meta();
        let skeleton = self.dataset.skeleton();
        let one = |((pick, row), length): ((&Pick, &usize), &usize)| {
            let told = self.told(*pick, *length);
            Hint::of(&metres(&meta.rows(&self.dataset, *row), skeleton), skeleton.joints, &told.joints, &told.frames)
        };
        batch.picks.iter().zip(&batch.rows).zip(&batch.lengths).map(one).collect()
    }

    fn dropout(&self, probability: f64, network: u64, (step, slice): (u64, u64)) -> Dropout {
        Dropout::new(probability, self.seed ^ network, step, slice)
    }

    /// The controlled denoiser's output, on the tape of the trained networks.
    fn predict(
        &self,
        batch: &LatentSlice,
        noisy_bnd: &Tensor<3>,
        timesteps: &[usize],
        tokens_bnd: Tensor<3>,
        at: (u64, u64),
    ) -> Tensor<3> {
        let (low, high) = self.settings.guidance;
        #[expect(clippy::cast_possible_truncation, reason = "a scale")]
        let w = |pick: &Pick| self.data.stream("guidance", *pick).range(low, high) as f32;
        let guidance = (self.base_meta.guidance_dim > 0).then(|| {
            let scales: Vec<f32> = batch.picks.iter().map(w).collect();
            guidance_embedding(&scales, self.base_meta.guidance_dim, &self.device)
        });
        let mut drop = self.dropout(self.base_meta.network.dropout, 2, at);
        let text = &batch.text_blc;
        let residuals =
            self.control.residuals(noisy_bnd.clone(), timesteps, text.clone(), guidance.clone(), tokens_bnd, &mut drop);
        let control = Control { residuals: &residuals, scale: 1.0 };
        let off = &mut Dropout::off();
        self.base.forward_controlled(noisy_bnd.clone(), timesteps, text.clone(), guidance, control, off)
    }

    /// The motion term of a slice.
    fn motion_term<'a>(
        &self,
        decoder: &'a Decoder,
        slice: &'a LatentSlice,
        hints: &NormalisedHints,
        batch: &[Pick],
    ) -> MotionTerm<'a> {
        let loss = &self.settings.loss;
        let distance = match loss.distance {
            ControlDistance::L2 => Pointwise::L2,
            ControlDistance::L1 => Pointwise::L1,
            ControlDistance::SmoothL1 => Pointwise::SmoothL1,
        };
        let statistics = (&self.meta.mean[..], &self.meta.std[..]);
        let target =
            ControlTarget::new(&hints.values, &hints.given, hints.shape, statistics, loss.metres, &self.device);
        let global = self.settings.training.batch.global as f32;
        let all = || -> usize {
            let lengths = &self.data.meta().lengths;
            let count = |pick: &Pick| {
                let told = self.told(*pick, lengths[self.data.row(*pick)]);
                told.joints.len() * told.frames.len()
            };
            batch.iter().map(count).sum()
        };
        let entries = target.entries();
        let weights: Vec<f32> = match loss.mean {
            ControlMean::Batch => vec![global / all().max(1) as f32; entries.len()],
            ControlMean::Sample => entries.iter().map(|own| 1.0 / (*own).max(1) as f32).collect(),
            ControlMean::Coordinate => entries.iter().map(|own| 1.0 / (3 * own).max(1) as f32).collect(),
        };
        MotionTerm { decoder, lengths: &slice.lengths, target, distance, weights }
    }

    /// Adds the terms of the rounds of feedback on latents [B, N, d] and their motions' features [B, T, D], if those
    /// are decoded already. Each round starts from the previous result and trains on its own result alone. So the
    /// network learns to correct the inputs that it will receive.
    fn rounds(
        &self,
        all: &mut Losses,
        network: &Feedback,
        motion: &MotionTerm<'_>,
        (mut latent_bnd, mut features): (Tensor<3>, Option<Tensor<3>>),
        (batch, told): (&LatentSlice, &[Hint]),
        drop: &dyn Fn(u64) -> Dropout,
    ) {
        let loss = &self.settings.loss;
        let rounds = self.settings.feedback.rounds;
        let mut latents = Vec::new();
        let mut motions = Vec::new();
        for round in 0..rounds {
            let now = features.take().unwrap_or_else(|| motion.decode(latent_bnd.clone()));
            let seen = Seen::of(&motion.decoder.vae, now, &batch.lengths, told);
            let changed = latent_bnd.clone() + seen.change(network, latent_bnd, &mut drop(round as u64));
            latents.push(losses::mse(changed.clone(), batch.clean_bnd.clone()));
            latent_bnd = changed.clone().inner();
            if loss.control > 0.0 {
                let decoded = motion.decode(changed);
                motions.push(motion.of(decoded.clone()));
                features = Some(decoded.inner());
            }
        }
        let mean = |terms: Vec<Tensor<1>>| Tensor::cat(terms, 0).sum() / rounds as f32;
        if loss.latent > 0.0 {
            all.add(FEEDBACK_LATENT, mean(latents), loss.latent);
        }
        if loss.control > 0.0 {
            all.add(FEEDBACK_CONTROL, mean(motions), loss.control);
        }
    }

    /// Uploads the base model with the control part added.
    fn publish(&self, cx: &mut dyn AttemptContext, base: &Manifest, state: &TrainState) -> Result<Digest, StageError> {
        let named = |prefix: &str, entries: &[Entry]| -> Vec<Entry> {
            entries.iter().map(|e| Entry { name: format!("{prefix}{}", e.name), shape: e.shape.clone() }).collect()
        };
        let prefixes = [CONTROLNET_PREFIX, TRAJECTORY_PREFIX, FEEDBACK_PREFIX];
        let names: Vec<Vec<Entry>> =
            state.groups.iter().zip(prefixes).map(|(group, prefix)| named(prefix, &group.entries)).collect();
        let networks: Vec<(&[Entry], &[f32])> =
            names.iter().enumerate().map(|(i, names)| (&names[..], state.result(i))).collect();
        let mut part = Draft::new(cx, ArtifactKind::Control, to_meta(&self.meta));
        weights::add_all(&mut part, &networks)?;
        let part = part.into_manifest();
        cx.put_manifest(&part)?;
        let model = model::extend(base, None, &BTreeMap::from([(Role::CONTROL, part)])).map_err(model_error)?;
        Ok(cx.put_manifest(&model)?)
    }
}

/// Checks that the model has a denoiser of these latents, and returns its meta.
fn base_meta(denoiser: &Manifest, model: &Model, data: &LatentData) -> Result<DenoiserMeta, StageError> {
    let refuse = |text: &str| Err(StageError::Input(text.to_owned()));
    if model.parts.contains_key(&Role::CONTROL) {
        return refuse("`model` already has a control part; use the model without it");
    }
    if model.generator != crate::generate::generator::LATENT_DIFFUSION {
        return refuse("`model` is not a latent diffusion model; a ControlNet needs one");
    }
    let meta: DenoiserMeta = artifacts::meta(denoiser, "the denoiser of `model`")?;
    if meta.fits.get(&Role::VAE) != Some(&data.vae()) {
        return refuse("`latents` were encoded with another VAE than that of `model`; use the model's latents");
    }
    if meta.fits.get(&Role::TEXT) != Some(&data.text_meta().text) {
        return refuse("`text` was embedded with another encoder than that of `model`; use the model's `text`");
    }
    Ok(meta)
}

/// The clips that the latents were encoded from.
fn clips(cx: &dyn AttemptContext, data: &LatentData) -> Result<Dataset, StageError> {
    let dataset = artifacts::input_dataset(cx)?;
    let meta = data.meta();
    let rows = meta.splits.len() * meta.crops;
    let fits = |row: usize| {
        let entry = dataset.entries.get(row / meta.crops);
        entry.is_some_and(|entry| meta.starts[row] + meta.lengths[row] <= entry.len)
    };
    if dataset.entries.len() != meta.splits.len() || !(0..rows).all(fits) {
        return Err(StageError::Input(
            "`latents` were not encoded from the clips of `dataset`; use the dataset that they were encoded from"
                .into(),
        ));
    }
    Ok(dataset)
}

impl Gang for TrainControl {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let data = LatentData::read(cx, &self.training, POOL)?;
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let model = Model::read(&manifest).map_err(model_error)?;
        let denoiser = parts::part(&*blobs, &model, &Role::DENOISER, ArtifactKind::Denoiser)?;
        let base_meta = base_meta(&denoiser, &model, &data)?;
        let dataset = clips(cx, &data)?;
        let joints = dataset.format.joints_of_all(&self.hints.joints).map_err(StageError::Input)?;
        let (mean, std) = joint_statistics(&dataset);
        let meta = ControlMeta {
            format: dataset.format,
            hints: self.hints.clone(),
            embedding: self.embedding,
            network: self.network.clone(),
            mean,
            std,
            fits: Parts::from([(Role::DENOISER, denoiser.digest())]),
            projection: None,
            feedback: self.feedback.rounds,
        };
        let device = cx.device();
        let tracked = device.clone().autodiff();
        let blank = Denoiser::new(&base_meta.config(), &mut Init::blank(&device));
        let base = weights::load(blank, &*blobs, &denoiser, "the denoiser of `model`")?;
        let purpose = format!("{}/init", cx.task().name);
        let mut init = Init::new(cx.task().seed, &purpose, self.network.positions, &tracked);
        let control = copied_from(&base, meta.controlnet(&base_meta, &mut init));
        let trajectory = meta.trajectory(&base_meta, &mut init);
        let mut start = WarmStart::find(cx, ArtifactKind::Control)?;
        let control = start.take(control, CONTROLNET_PREFIX)?;
        let trajectory = start.take(trajectory, TRAJECTORY_PREFIX)?;
        let feedback = meta.feedback(&base_meta, &mut init);
        let feedback = feedback.map(|network| start.take(network, FEEDBACK_PREFIX)).transpose()?;
        start.finish(cx, &meta)?;
        let decodes = self.loss.control > 0.0 || feedback.is_some();
        let decoder = decodes.then(|| Decoder::read(&*blobs, &model, &device)).transpose()?;
        let mut objective = Controlled {
            settings: self.clone(),
            data,
            dataset,
            joints,
            base,
            noise: Schedule::new(&base_meta.diffusion, TIMESTEPS),
            base_meta,
            meta,
            control,
            trajectory,
            feedback,
            decoder,
            seed: dropout_seed(cx),
            device,
        };
        train(&mut objective, &self.training, cx)?.publish(|state| objective.publish(cx, &manifest, state))
    }
}
