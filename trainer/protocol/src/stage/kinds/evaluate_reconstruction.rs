//! `evaluate.reconstruction`: errors of a VAE or a tokenizer. Source: MLD's MPJPE, DisCoRD's sJPE, FID of the
//! tokenizers' papers, and our feature error.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, Problems, Ref, Shape, Split, StageSpec};

/// `evaluate.reconstruction`: MPJPE in mm, sJPE and feature error of a VAE or a tokenizer. With an evaluator also FID;
/// for a tokenizer also the share of codes in use. A unit of KIT-ML is 1.5625 mm, reported as `millimetres_per_unit`;
/// papers that assume a millimetre print values smaller by that factor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateReconstruction {
    /// Stage that gives the VAE; not read if there is a tokenizer.
    pub vae: String,
    /// Stage that gives the tokenizer to be measured instead of a VAE; empty for a VAE.
    pub tokenizer: String,
    /// Stage that gives the flow decoder for the tokenizer's tokens, or the VAE's latents; empty uses the tokenizer's,
    /// or the VAE's, own decoder.
    pub decoder: String,
    /// Number of steps of the flow decoder's solver, or of a student's jumps; 0 uses its own number. A step of solver
    /// `midpoint` is two evaluations of the network, a step of `euler` one.
    #[schemars(range(min = 0, max = 1_000), extend("x-unit" = "steps"))]
    pub decoder_steps: usize,
    /// Stage that gives the evaluator for FID, of reconstructions against the clips themselves; empty leaves FID out.
    pub evaluator: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Split of the clips.
    pub split: Split,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
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
    // Version 2 adds PA-MPJPE, accelerations, sJPE, skating. Version 3 adds the length of a unit.
    // Version 5 adds the share of still frames. Version 6 adds jerk, penetration and bones.
    const VERSION: u32 = 7;
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
            let message = format!("`decoder_steps` is {}, but `decoder` is missing", self.decoder_steps);
            p.add("decoder_steps", message, "set `decoder` to the stage of a flow decoder");
        }
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
