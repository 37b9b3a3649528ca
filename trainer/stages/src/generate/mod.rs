//! Generation of a motion from a sentence, with a model of any kind.
//!
//! Not a stage: it keeps nothing, and it reads the clock, because the time per sentence is the purpose of few-step
//! models. The motion is a function of (model, sentence, frames, sampler, seed).

pub mod generator;
mod refine;
pub mod stream;
pub mod timing;

use std::ops::Range;
use std::rc::Rc;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use motion::features::recover_joints;
use motion::{Skeleton, Stream};
use protocol::artifact::Role;
use protocol::stage::{DataFormat, Family, Sampler};
use protocol::{ArtifactKind, Manifest, Seed};

use self::generator::{Batch, ControlRequest, Edit, Lap, MotionGenerator, Seeds, Text};
use crate::context::StageError;
use crate::parts::control::{ControlMeta, ControlOptions};
use crate::parts::hint::Hint;
use crate::parts::length::Lengths;
use crate::parts::{self, model_error};

/// Default length of a motion if neither the user nor the model sets one: 6 seconds of HumanML3D, 9.6 of KIT-ML, near
/// the mean length of their clips.
pub const DEFAULT_FRAMES: usize = 120;

/// A loaded model with its own defaults: a sampler, a length.
#[derive(Debug)]
pub struct Generator {
    model: Box<dyn MotionGenerator>,
    lengths: Option<Lengths>,
    sampler: Option<Sampler>,
}

/// Time of each phase of one sentence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// Embedding the sentence.
    pub text: Duration,
    /// Drawing the latent.
    pub sampling: Duration,
    /// Decoding it, to features in the data's own scale.
    pub decoding: Duration,
}

impl Timing {
    /// Sum of the three phases.
    pub fn total(&self) -> Duration {
        self.text + self.sampling + self.decoding
    }
}

/// A generated motion in features and joints.
#[derive(Debug, Clone, PartialEq)]
pub struct Generated {
    /// Feature rows `[frames, features]` in the data's own scale.
    pub features: Vec<f32>,
    /// Global joints `[frames, joints, 3]` in the data's unit.
    pub joints: Vec<f32>,
    /// Number of frames.
    pub frames: usize,
    /// The skeleton and feature layout.
    pub format: DataFormat,
    /// Time of each phase.
    pub timing: Timing,
}

/// A motion that was regenerated in part.
#[derive(Debug, Clone, PartialEq)]
pub struct Edited {
    /// The whole motion.
    pub motion: Generated,
    /// Ranges of frames whose tokens were kept.
    pub kept: Vec<Range<usize>>,
}

impl Generator {
    /// Loads an artifact of kind `model`.
    pub fn load(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Self, StageError> {
        let parts = Model::read(manifest).map_err(model_error)?;
        let model = generator::open(manifest, blobs, device)?;
        let lengths = match parts.parts.contains_key(&Role::LENGTH) {
            true => {
                let part = parts::part(blobs, &parts, &Role::LENGTH, ArtifactKind::Length)?;
                Some(Lengths::read(blobs, &part, device)?)
            }
            false => None,
        };
        if let Some(lengths) = &lengths
            && (lengths.meta().format, lengths.meta().text_dim) != (model.format(), model.text().dim())
        {
            return Err(StageError::Input(
                "the model's length estimator was trained on another format or another text encoder".into(),
            ));
        }
        Ok(Self { model, lengths, sampler: parts.sampler })
    }

    /// Wraps a model that was not loaded from a file.
    #[cfg(test)]
    pub(crate) fn of(model: Box<dyn MotionGenerator>) -> Self {
        Self { model, lengths: None, sampler: None }
    }

    /// The default sampler: that of the model's evaluation, or that of the papers for its kind if it has none.
    pub fn sampler(&self) -> Sampler {
        self.sampler.clone().unwrap_or_else(|| self.model.family().published())
    }

    /// Returns the family of the model, which says what it was trained to do.
    pub fn family(&self) -> &Family {
        self.model.family()
    }

    /// Refuses a sampler that the model does not have.
    pub fn check_sampler(&self, sampler: &Sampler) -> Result<(), StageError> {
        generator::check_sampler(&*self.model, sampler)
    }

    /// The skeleton of its motions.
    pub fn format(&self) -> DataFormat {
        self.model.format()
    }

    /// The default length for `prompt`: a draw of the model's length estimator, or [`DEFAULT_FRAMES`] without one.
    pub fn frames(&self, prompt: &str, seed: Seed) -> Result<usize, StageError> {
        let Some(lengths) = &self.lengths else { return Ok(DEFAULT_FRAMES) };
        let pooled = self.model.text().pooled(&[prompt])?;
        let drawn = lengths.draw(&pooled, &mut Stream::new(seed, "generate/length", 0, 0));
        Ok(drawn.min(self.model.longest()))
    }

    /// Regenerates a motion for `prompt` outside of the frames to `keep`. `motion` are rows `[frames, features]` in the
    /// data's own scale. Frames after the last whole token are cut off, and a token is kept only if all its frames are.
    /// The default sampler is the model's own.
    ///
    /// # Errors
    /// If the model cannot edit, the motion has another width, or everything or nothing is kept.
    pub fn edit(
        &self,
        prompt: &str,
        motion: &[f32],
        keep: &[Range<usize>],
        sampler: Option<&Sampler>,
        seed: Seed,
    ) -> Result<Edited, StageError> {
        let unit = generator::infilling(&*self.model)?.unit();
        let width = Skeleton::of(self.format()).features;
        let pieces = motion.len() / width / unit;
        let stays = |piece: usize| {
            let frames = piece * unit..(piece + 1) * unit;
            keep.iter().any(|span| span.start <= frames.start && frames.end <= span.end)
        };
        let kept: Vec<bool> = (0..pieces).map(stays).collect();
        let drawn = kept.iter().filter(|kept| !**kept).count();
        if drawn == 0 || drawn == pieces {
            let what = if pieces == 0 || drawn == 0 { "nothing is left to generate" } else { "nothing stays" };
            return Err(StageError::Input(format!(
                "{what}: the motion has {pieces} units of {unit} frames, and the kept spans cover {} of them",
                pieces - drawn
            )));
        }
        let sampler = sampler.cloned().unwrap_or_else(|| self.sampler());
        let edit = Edit { motion: &motion[..pieces * unit * width], kept: &kept };
        let motion = self.timed(prompt, seed, |texts, seeds, lap| {
            generator::edited(&*self.model, edit, &texts[0], seeds, &sampler, lap)
        })?;
        let spans = kept.chunk_by(|a, b| a == b).scan(0, |at, run| {
            let span = *at * unit..(*at + run.len()) * unit;
            *at += run.len();
            Some((run[0], span))
        });
        Ok(Edited { motion, kept: spans.filter(|(kept, _)| *kept).map(|(_, span)| span).collect() })
    }

    /// Frames of a unit that [`edit`](Self::edit) keeps or regenerates; `None` if the model generates only whole
    /// motions.
    pub fn infilling_unit(&self) -> Option<usize> {
        self.model.infilling().map(|infilling| infilling.unit())
    }

    /// Returns true if the text encoder recognises a word of `prompt`. Otherwise the result is the same as for an empty
    /// prompt: the built-in encoder has only words of Latin letters and digits.
    pub fn knows(&self, prompt: &str) -> Result<bool, StageError> {
        let texts = self.model.embed(&[prompt, ""])?;
        Ok(texts[0] != texts[1])
    }

    /// The meta of the control part, if the model has one.
    pub fn control(&self) -> Option<&ControlMeta> {
        self.model.control()
    }

    /// Frames of the longest motion that the model generates.
    pub fn longest(&self) -> usize {
        self.model.longest()
    }

    /// Generates a motion for `prompt`. The default length is [`frames`](Self::frames), the default sampler the model's
    /// own.
    pub fn generate(
        &self,
        prompt: &str,
        frames: Option<usize>,
        sampler: Option<&Sampler>,
        seed: Seed,
    ) -> Result<Generated, StageError> {
        self.draw(prompt, frames, sampler, seed, None)
    }

    /// Generates a motion of `hint`'s length through its positions, with a control part; otherwise as
    /// [`generate`](Self::generate).
    pub fn generate_controlled(
        &self,
        prompt: &str,
        sampler: Option<&Sampler>,
        seed: Seed,
        (hint, options): (&Hint, ControlOptions),
    ) -> Result<Generated, StageError> {
        let control = ControlRequest { hints: std::slice::from_ref(hint), options };
        self.draw(prompt, Some(hint.frames()), sampler, seed, Some(control))
    }

    fn draw(
        &self,
        prompt: &str,
        frames: Option<usize>,
        sampler: Option<&Sampler>,
        seed: Seed,
        control: Option<ControlRequest<'_>>,
    ) -> Result<Generated, StageError> {
        let sampler = sampler.cloned().unwrap_or_else(|| self.sampler());
        self.timed(prompt, seed, |texts, seeds, lap| {
            let frames = frames.map_or_else(|| self.frames(prompt, seed), Ok)?;
            let batch = Batch { texts, lengths: &[frames], seeds, control };
            Ok(generator::motions(&*self.model, batch, &sampler, lap)?.concat())
        })
    }

    /// Runs `draw` for `prompt`, and measures the time of each phase.
    fn timed(
        &self,
        prompt: &str,
        seed: Seed,
        draw: impl FnOnce(&[Rc<Text>], &Seeds<'_>, &mut dyn FnMut(Lap)) -> Result<Vec<f32>, StageError>,
    ) -> Result<Generated, StageError> {
        let start = Instant::now();
        let texts: Vec<_> = self.model.embed(&[prompt])?.into_iter().map(Rc::new).collect();
        let embedded = Instant::now();
        let seeds = |k: usize, _| Stream::new(seed, "generate/noise", 0, k as u64);
        let mut sampled = embedded;
        let mut decoded = embedded;
        let mut lap = |lap| match lap {
            Lap::Sampled => (sampled, decoded) = (Instant::now(), Instant::now()),
            Lap::Decoded => decoded = Instant::now(),
        };
        let features = draw(&texts, &seeds, &mut lap)?;
        let skeleton = Skeleton::of(self.format());
        let joints = recover_joints(&features, skeleton);
        // An autoregressive model decides the length itself.
        let frames = features.len() / skeleton.features;
        let timing = Timing { text: embedded - start, sampling: sampled - embedded, decoding: decoded - sampled };
        Ok(Generated { features, joints, frames, format: self.format(), timing })
    }
}
