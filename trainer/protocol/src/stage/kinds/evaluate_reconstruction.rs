//! `evaluate.reconstruction`: what a VAE or a tokenizer loses. Source: MLD's MPJPE, DisCoRD's sJPE, FID of the tokenizers' papers, and our
//! feature error.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, Problems, Ref, Shape, Split, StageSpec};

/// `evaluate.reconstruction`: MPJPE in mm, sJPE and feature error of a VAE or a tokenizer; with an evaluator also FID, of a tokenizer also how
/// many codes are in use. A unit of KIT-ML is 1.5625 mm, which `millimetres_per_unit` says; papers that take one for a millimetre print values
/// smaller by that.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateReconstruction {
    /// Stage that gives the VAE; not read if there is a tokenizer.
    pub vae: String,
    /// Stage that gives the tokenizer that is measured instead of a VAE; none if empty.
    pub tokenizer: String,
    /// Stage that gives the flow decoder that decodes the tokenizer's tokens, or the VAE's latents; the tokenizer's own, or the VAE's, if empty.
    pub decoder: String,
    /// Steps of the flow decoder's solver, or jumps of a student, instead of those that it was trained with; 0 takes its own. A step of its
    /// solver `midpoint` is two evaluations of the network, one of `euler` is one.
    pub decoder_steps: usize,
    /// Stage that gives the evaluator in whose space FID is taken, of reconstructions against the clips themselves; no FID if empty.
    pub evaluator: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Clips.
    pub split: Split,
    /// Shards.
    pub shards: usize,
}

impl Default for EvaluateReconstruction {
    fn default() -> Self {
        Self {
            vae: "vae".into(),
            tokenizer: String::new(),
            decoder: String::new(),
            decoder_steps: 0,
            evaluator: String::new(),
            dataset: "dataset".into(),
            split: Split::Test,
            shards: 4,
        }
    }
}

impl StageSpec for EvaluateReconstruction {
    const KIND: &'static str = "evaluate.reconstruction";
    // 2: PA-MPJPE, accelerations, sJPE, skating. 3: what a unit is.
    const VERSION: u32 = 3;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let of_vae = self.tokenizer.is_empty();
        vec![
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae).only_if(of_vae),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer).optional(),
            Ref::stage("decoder", &mut self.decoder, ArtifactKind::FlowDecoder).optional(),
            Ref::stage("evaluator", &mut self.evaluator, ArtifactKind::Evaluator).optional(),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
        ]
    }

    fn check(&self, p: &mut Problems) {
        if self.decoder_steps > 0 && self.decoder.is_empty() {
            let message =
                format!("`decoder_steps` is {}, but there is no `decoder` that makes them", self.decoder_steps);
            p.add("decoder_steps", message, "name the stage of a flow decoder");
        }
        p.shards(self.shards);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let (field, measured) = match self.tokenizer.is_empty() {
            true => ("vae", &self.vae),
            false => ("tokenizer", &self.tokenizer),
        };
        stages.same_skeleton(p, (field, measured), &self.dataset);
        if !self.evaluator.is_empty() {
            stages.same_skeleton(p, ("evaluator", &self.evaluator), &self.dataset);
        }
        if !self.decoder.is_empty() {
            stages.same_codes(p, ("decoder", &self.decoder), measured);
        }
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
