//! Motions of a loaded model: whole, along a path, or in part.

use std::ops::Range;
use std::rc::Rc;
use std::time::Instant;

use motion::features::recover_joints;
use motion::{Skeleton, Stream};
use protocol::Seed;
use protocol::stage::Sampler;

use super::generated::{Edited, Generated, Timing};
use super::generator::{self, Batch, ControlRequest, Edit, Lap, Seeds, Text};
use super::loaded::Generator;
use crate::context::StageError;
use crate::parts::control::ControlOptions;
use crate::parts::hint::Hint;

impl Generator {
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

    pub(super) fn draw(
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
