//! Generated and edited motions, with their times.

use std::ops::Range;
use std::time::Duration;

use protocol::stage::DataFormat;

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
