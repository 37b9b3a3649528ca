//! `model.decoder`: a model of tokens with a flow decoder in place of its tokenizer's own. Source: DisCoRD (Cho et al., arXiv:2411.19527).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, Problems, Ref, Shape, StageSpec};

/// `model.decoder`: draws tokens as another model does, and decodes them along a flow.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ModelDecoder {
    /// Stage that gives the model, of tokens.
    pub model: String,
    /// Stage that gives the decoder, trained on the tokenizer that the model has.
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
        let (model, decoder) = (&self.model, &self.decoder);
        if stages.family(model).is_some_and(|family| !family.draws_tokens()) {
            let message = format!("`{model}` draws no tokens, and `{decoder}` decodes nothing else");
            p.add("model", message, "name a `train.tokens` stage");
        }
        if let (Some(ours), Some(theirs)) = (stages.format(model), stages.format(decoder))
            && ours != theirs
        {
            let (ours, theirs) = (ours.skeleton(), theirs.skeleton());
            let message = format!("`{decoder}` decodes motions of {theirs}, but `{model}` draws those of {ours}");
            p.add("decoder", message, "train the decoder on the data set of the model");
        } else if let Some(tokenizer) = stages.tokenizer_of_model(model) {
            stages.same_codes(p, ("decoder", decoder), tokenizer);
        }
    }
}
