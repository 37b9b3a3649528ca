//! `distill.discord`: a flow decoder with one or two jumps, distilled from one that follows its flow. Source: DisCoRD's
//! decoder with the consistency distillation of `distill.lcm`, ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{
    Distance, FlowPrediction, Neighbours, Output, Problems, Ref, Shape, StageSpec, TrainDiscord, Training, WindowsOf,
};
use crate::{ArtifactKind, Steps};

/// `distill.discord`: a flow decoder with fewer evaluations of its network, which is faster by the same factor. All
/// settings are our choice.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DistillDiscord {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the tokenizer of the teacher; not read if there is a VAE.
    pub tokenizer: String,
    /// Stage that gives the VAE of the teacher, if it decodes latents; empty for a decoder of tokens.
    pub vae: String,
    /// Stage that gives the flow decoder to be distilled.
    pub teacher: String,
    /// Frames of an example; a multiple of 4. Shorter clips are left out.
    #[schemars(range(min = 4, max = 10_000), extend("x-unit" = "frames"))]
    pub window: usize,
    /// Windows that make an epoch.
    pub windows_of: WindowsOf,
    /// Number of intervals of the grid between noise and data. The teacher makes one step over each.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "intervals"))]
    pub intervals: usize,
    /// Number of the student's jumps for decoding motion.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "steps"))]
    pub solver_steps: usize,
    /// Distance of the consistency loss.
    pub distance: Distance,
    /// Pseudo-Huber constant c.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub huber_c: f64,
    /// Decay of the target network.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Stage or version, such as `discord@prod`, whose flow decoder supplies initial weights where shapes fit; empty
    /// starts from the teacher's weights.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer.
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
    const VERSION: u32 = 4;
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
        p.whole_tokens("window", self.window);
        if self.distance == Distance::Huber {
            p.above_zero("huber_c", self.huber_c);
        }
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
            let message = format!("`{}` is a student", self.teacher);
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
