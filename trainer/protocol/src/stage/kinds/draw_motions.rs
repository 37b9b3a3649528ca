//! `draw.motions`: motions of a model for given sentences, to be looked at.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Output, PHYSICS, Problems, Ref, Shape, StageSpec};
use crate::{ArtifactKind, Seed};

/// Largest number of motions of one stage.
const MOTIONS: usize = 64;
/// Largest length of a sentence in bytes.
const SENTENCE: usize = 1_000;
/// Largest number of positions of a path: one for each frame of a minute.
const POSITIONS: usize = 1_200;

/// `draw.motions`: motions for sentences, in the form of the viewer of a server's page, and as `.npy`, `.bvh`, `.glb` and
/// `.html`. A `.gif` shows the first 24 beside each other. Two models draw with the same noise if their seeds are the
/// same. The metrics are the physical measures of the motions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DrawMotions {
    /// Stage that gives the model.
    pub model: String,
    /// Descriptions of the motions to draw.
    pub sentences: Vec<String>,
    /// Motions of each sentence, with consecutive seeds. They have one length.
    #[schemars(range(min = 1, max = 64))]
    pub count: usize,
    /// Length of each motion. 0 leaves it to the model.
    #[schemars(range(min = 0.0, max = 60.0), extend("x-unit" = "seconds"))]
    pub seconds: f64,
    /// Positions that the pelvis passes, as seconds and x, y, z in metres. The motion starts at x = z = 0 and faces z.
    /// Only a model with a control part follows them.
    pub path: Vec<[f64; 4]>,
    /// Seed of the first motion's noise, in the place of the pipeline's seed.
    #[schemars(range(min = 0, max = 9_007_199_254_740_991_u64))]
    pub seed: Seed,
    /// Number of network evaluations. 0 takes the sampler of the model's own evaluation.
    #[schemars(range(min = 0, max = 1_000), extend("x-unit" = "steps"))]
    pub steps: usize,
    /// Guidance scale. -1 takes that of the model's own evaluation.
    #[schemars(range(min = -1.0, max = 1e3))]
    pub guidance: f64,
}

impl Default for DrawMotions {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            sentences: vec!["a person walks forward".into()],
            count: 1,
            seconds: 0.0,
            path: Vec::new(),
            seed: Seed(0),
            steps: 0,
            guidance: -1.0,
        }
    }
}

impl StageSpec for DrawMotions {
    const KIND: &'static str = "draw.motions";
    // Version 2 adds penetration and bones, version 3 a moving picture.
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![Ref::stage("model", &mut self.model, ArtifactKind::Model)]
    }

    fn check(&self, p: &mut Problems) {
        if self.sentences.is_empty() {
            p.add("sentences", "there are no sentences", "such as `sentences: [a person walks in a circle]`");
        }
        let motions = self.sentences.len().saturating_mul(self.count);
        if motions > MOTIONS {
            let message = format!("{motions} motions; expected at most {MOTIONS}");
            p.add("sentences", message, "use fewer sentences, a smaller `count`, or several stages");
        }
        if let Some(at) = self.sentences.iter().position(|sentence| sentence.len() > SENTENCE) {
            p.add("sentences", format!("sentence {} is longer than {SENTENCE} bytes", at + 1), "shorten it");
        }
        if self.path.len() > POSITIONS {
            p.add("path", format!("{} positions; expected at most {POSITIONS}", self.path.len()), "leave some out");
        }
        if self.guidance != -1.0 {
            p.not_negative("guidance", self.guidance);
        }
    }

    fn metrics(&self) -> Option<BTreeSet<String>> {
        Some(PHYSICS.map(str::to_owned).into())
    }
}
