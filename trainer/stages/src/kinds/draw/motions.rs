//! `draw.motions`: motions of a model for given sentences.
//!
//! Files: `motions.json`, the motions in the viewer's form (`mocap::html`), and their captions in the order of the sentences.

use std::collections::BTreeMap;

use mocap::Body;
use mocap::html::{Panel, packed};
use motion::Skeleton;
use protocol::ArtifactKind;
use protocol::stage::{DrawMotions, Sampler};
use serde_json::json;

use crate::artifacts;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::entry_draws::skates;
use crate::generate::Generator;
use crate::kinds::shape::Plain;

/// File of the motions.
const MOTIONS_FILE: &str = "motions.json";

impl Plain for DrawMotions {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let generator = Generator::load(&manifest, &*cx.blobs(), &cx.device())?;
        let sampler = sampler(self, generator.sampler());
        generator.check_sampler(&sampler)?;
        let skeleton = Skeleton::of(generator.format());
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked to be 0 to 60 seconds")]
        let frames = (self.seconds * skeleton.fps).round() as usize;
        if frames > generator.longest() {
            let longest = generator.longest() as f64 / skeleton.fps;
            let message = format!("`seconds` is {}; the model draws at most {longest:.1}", self.seconds);
            return Err(StageError::Input(message));
        }
        let mut drawn = Vec::with_capacity(self.sentences.len());
        for sentence in &self.sentences {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let frames = (frames > 0).then_some(frames);
            drawn.push(generator.generate(sentence, frames, Some(&sampler), self.seed)?);
            cx.progress(drawn.len() as u64, self.sentences.len() as u64, "motions", &[]);
        }
        let body = Body::of(skeleton);
        let panels: Vec<Panel<'_>> = drawn
            .iter()
            .map(|motion| Panel {
                caption: String::new(),
                note: String::new(),
                body: &body,
                joints: &motion.joints,
                waypoints: &[],
            })
            .collect();
        let mut motions = packed(&panels).map_err(|error| StageError::Input(error.to_string()))?;
        motions["captions"] = json!(self.sentences);
        let mean = drawn.iter().map(|motion| f64::from(skates(&motion.features, skeleton))).sum::<f64>();
        let metrics = BTreeMap::from([("skating".to_owned(), mean / drawn.len() as f64)]);
        let meta = json!({"kind": cx.task().settings.kind(), "metrics": metrics, "sampler": sampler});
        let mut draft = artifacts::Draft::new(cx, ArtifactKind::Report, meta);
        draft.add(MOTIONS_FILE, protocol::canonical::to_bytes(&motions))?;
        Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
    }
}

/// The model's own sampler with the changes of the settings.
fn sampler(settings: &DrawMotions, own: Sampler) -> Sampler {
    let steps = if settings.steps == 0 { own.steps } else { settings.steps };
    let guidance = if settings.guidance < 0.0 { own.guidance } else { settings.guidance };
    // Another number of steps needs other timesteps.
    let timesteps = if steps == own.steps { own.timesteps } else { Vec::new() };
    Sampler { steps, guidance, timesteps, ..own }
}
