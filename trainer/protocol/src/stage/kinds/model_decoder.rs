//! `model.decoder`: a model of tokens or latents whose own decoder is replaced by a flow decoder. Source: DisCoRD (Cho
//! et al., arXiv:2411.19527).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Family, Neighbours, Output, Problems, Ref, Shape, StageSpec};

/// `model.decoder`: generates tokens or latents with another model, and decodes them along a flow.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ModelDecoder {
    /// Stage that gives the model, of tokens or latents.
    pub model: String,
    /// Stage that gives the decoder, trained on the model's tokenizer or VAE.
    pub decoder: String,
}

impl Default for ModelDecoder {
    fn default() -> Self {
        Self { model: "model".into(), decoder: "decoder".into() }
    }
}

impl StageSpec for ModelDecoder {
    const KIND: &'static str = "model.decoder";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("model", &mut self.model, ArtifactKind::Model),
            Ref::stage("decoder", &mut self.decoder, ArtifactKind::FlowDecoder),
        ]
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let model = &self.model;
        let decoder = &self.decoder;
        if matches!(stages.family(model), Some(Family::Features { .. })) {
            let message = format!("`{model}` generates motion features, so `{decoder}` has nothing to decode");
            p.add("model", message, "use a model that generates tokens or latents");
        }
        if let (Some(ours), Some(theirs)) = (stages.format(model), stages.format(decoder))
            && ours != theirs
        {
            let ours = ours.skeleton();
            let theirs = theirs.skeleton();
            let message = format!("`{decoder}` decodes motions of {theirs}, but `{model}` generates motions of {ours}");
            p.add("decoder", message, "train the decoder on the model's dataset");
        } else if let Some(encoder) = stages.tokenizer_of_model(model).or_else(|| stages.vae_of_model(model)) {
            stages.same_codes(p, ("decoder", decoder), encoder);
        }
    }
}
