//! `evaluate.spectrum`: the order in which a motion's frequencies settle during denoising. Source: Free-T2M (Chen et
//! al., 2025, figure 4).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, Problems, Ref, Sampler, Shape, Split, StageSpec};

/// `evaluate.spectrum`: energy by frequency band of the predicted motion in each denoising step. `energy/BAND/STEP` is
/// the share of real motion's energy in that band. `settled/BAND/STEP` is 1 minus the energy of the prediction's
/// difference from the final motion, as a share of the final motion's. Bands and steps count from 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateSpectrum {
    /// Stage that gives the model, which must generate by denoising.
    pub model: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Ends of the bands in hertz, ascending; an additional band ends at half the frame rate.
    #[schemars(inner(range(min = 1e-3, max = 1e3)), extend("x-unit" = "hertz"))]
    pub bands: Vec<f64>,
    /// Sampler for the model.
    pub sampler: Sampler,
    /// Number of motions, one per entry; all entries if there are fewer.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "motions"))]
    pub motions: usize,
    /// Split of the clips.
    pub split: Split,
}

impl Default for EvaluateSpectrum {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            dataset: "dataset".into(),
            bands: vec![0.5, 1.0, 2.0, 4.0],
            sampler: Sampler::default(),
            motions: 64,
            split: Split::Val,
        }
    }
}

impl StageSpec for EvaluateSpectrum {
    const KIND: &'static str = "evaluate.spectrum";
    const VERSION: u32 = 3;
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("model", &mut self.model, ArtifactKind::Model).measured_if(true),
        ]
    }

    fn check(&self, p: &mut Problems) {
        if self.bands.is_empty() || !self.bands.windows(2).all(|pair| pair[0] < pair[1]) {
            let message = format!("`bands` is {:?}; expected frequencies in hertz in ascending order", self.bands);
            p.add("bands", message, "for example [0.5, 1, 2, 4]");
        }
        self.sampler.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let model = &self.model;
        if stages.family(model).is_some_and(|family| family.draws_tokens()) {
            p.add("model", format!("`{model}` generates tokens and has no denoising steps"), "");
        }
        if let (Some(ours), Some(theirs)) = (stages.format(&self.dataset), stages.format(model))
            && ours != theirs
        {
            let theirs = theirs.skeleton();
            let ours = ours.skeleton();
            let message =
                format!("`{model}` generates motions of {theirs}, but the clips of `{}` have {ours}", self.dataset);
            p.add("model", message, "use a dataset in the model's format");
        }
        stages.check_sampler(p, model, &self.sampler);
    }

    fn sampler(&self) -> Option<&Sampler> {
        Some(&self.sampler)
    }
}
