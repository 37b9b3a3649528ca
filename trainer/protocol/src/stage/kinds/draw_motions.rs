//! `draw.motions`: motions of a model for given sentences, to be looked at.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Output, Problems, Ref, Shape, StageSpec};
use crate::{ArtifactKind, Seed};

/// Largest number of sentences of one stage, and largest length of a sentence in bytes.
const MOST: (usize, usize) = (64, 1_000);

/// `draw.motions`: one motion for each sentence, in the form that the viewer of a server's page reads. Two models draw with the same
/// noise for one sentence if their seeds are the same. The metric `skating` is the share of steps in which a foot slides.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DrawMotions {
    /// Stage that gives the model.
    pub model: String,
    /// Sentences to draw.
    pub sentences: Vec<String>,
    /// Length of each motion. 0 leaves it to the model.
    #[schemars(range(min = 0.0, max = 60.0), extend("x-unit" = "seconds"))]
    pub seconds: f64,
    /// Seed of the noise. It takes the place of the pipeline's.
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
            seconds: 0.0,
            seed: Seed(0),
            steps: 0,
            guidance: -1.0,
        }
    }
}

impl StageSpec for DrawMotions {
    const KIND: &'static str = "draw.motions";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![Ref::stage("model", &mut self.model, ArtifactKind::Model)]
    }

    fn check(&self, p: &mut Problems) {
        let (most, bytes) = MOST;
        if self.sentences.is_empty() || self.sentences.len() > most {
            let message = format!("{} sentences; expected 1 to {most}", self.sentences.len());
            p.add("sentences", message, "such as `sentences: [a person walks in a circle]`");
        }
        if let Some(at) = self.sentences.iter().position(|sentence| sentence.len() > bytes) {
            p.add("sentences", format!("sentence {} is longer than {bytes} bytes", at + 1), "shorten it");
        }
        p.not_negative("seconds", self.seconds);
        if self.guidance != -1.0 {
            p.not_negative("guidance", self.guidance);
        }
    }
}
