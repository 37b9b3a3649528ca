//! `distill.discord`: a flow decoder of one or two jumps, learned from one that follows its flow. Source: DisCoRD's decoder with the consistency
//! distillation of `distill.lcm`, ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{
    Distance, FlowPrediction, Neighbours, Output, Problems, Ref, Shape, StageSpec, TrainDiscord, Training, WindowsOf,
};
use crate::{ArtifactKind, Steps};

/// Frames that one token stands for.
const UNIT: usize = 4;

/// `distill.discord`: a flow decoder that is as many times faster as it makes fewer evaluations of its network. All settings are our choice.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DistillDiscord {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the tokenizer of the teacher; not read if there is a VAE.
    pub tokenizer: String,
    /// Stage that gives the VAE of the teacher, if it decodes latents; none if empty.
    pub vae: String,
    /// Stage that gives the flow decoder to learn from.
    pub teacher: String,
    /// Frames of an example; a multiple of 4. Shorter clips are left out.
    pub window: usize,
    /// Which windows make an epoch.
    pub windows_of: WindowsOf,
    /// Intervals of the grid between noise and data, over each of which the teacher makes a step.
    pub intervals: usize,
    /// Jumps of the student when motion is decoded.
    pub solver_steps: usize,
    /// Distance.
    pub distance: Distance,
    /// Pseudo-Huber constant c.
    pub huber_c: f64,
    /// Decay of the target network.
    pub ema: f64,
    /// Stage that gives the flow decoder whose weights the student begins with where their shapes fit, or a version such as `discord@prod`; empty
    /// begins with the teacher's.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// The rest.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for DistillDiscord {
    fn default() -> Self {
        let TrainDiscord { dataset, tokenizer, vae, window, windows_of, training, .. } = TrainDiscord::default();
        Self {
            dataset,
            tokenizer,
            vae,
            teacher: "discord".into(),
            window,
            windows_of,
            intervals: 16,
            solver_steps: 2,
            distance: Distance::Huber,
            huber_c: 0.5,
            ema: 0.95,
            init: String::new(),
            training: Training { steps: Steps(48_000), lr: 2e-4, warmup: Steps(1_000), ..training },
        }
    }
}

impl StageSpec for DistillDiscord {
    const KIND: &'static str = "distill.discord";
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "decoder", kind: ArtifactKind::FlowDecoder };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let of_tokens = self.vae.is_empty();
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer).only_if(of_tokens),
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae).optional(),
            Ref::stage("teacher", &mut self.teacher, ArtifactKind::FlowDecoder),
            Ref::init(&mut self.init, ArtifactKind::FlowDecoder, ArtifactKind::FlowDecoder),
        ]
    }

    fn check(&self, p: &mut Problems) {
        p.positive("intervals", self.intervals);
        p.positive("solver_steps", self.solver_steps);
        if self.window < UNIT || !self.window.is_multiple_of(UNIT) {
            let message = format!("`window` is {}; expected a multiple of {UNIT}", self.window);
            p.add("window", message, "a token stands for 4 frames");
        }
        if self.distance == Distance::Huber {
            p.above_zero("huber_c", self.huber_c);
        }
        p.fraction("ema", self.ema, true);
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let (field, encoder) = match self.vae.is_empty() {
            true => ("tokenizer", &self.tokenizer[..]),
            false => ("vae", &self.vae[..]),
        };
        stages.same_skeleton(p, (field, encoder), &self.dataset);
        stages.same_codes(p, ("teacher", &self.teacher), encoder);
        if stages.stage(&self.teacher).is_some_and(|teacher| teacher.get::<Self>().is_some()) {
            let message = format!("`{}` is a student itself", self.teacher);
            p.add("teacher", message, "name a `train.discord` stage");
        }
        FlowPrediction::check_init(stages, p, &self.init, FlowPrediction::of_stage(stages, &self.teacher));
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        &["loss"]
    }
}
