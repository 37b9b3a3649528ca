//! `import.model`: imports published weights from their files. Sources: MLD, MotionLCM, T2M-GPT, MoMask, MMM, MDM,
//! DisCoRD.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{
    ControlHints, DataFormat, Family, FlowSolver, Neighbours, Output, Problems, Ref, Shape, Solver, StageSpec,
};

/// Names of the statistics in published folders.
const STATISTICS: [&str; 2] = ["mean.npy|Mean.npy", "std.npy|Std.npy"];
const STATISTICS_ORIGIN: &str = "the mean and standard deviation of the features that the model was trained on: those \
    of the dataset (MotionLCM, MDM), or the folder `meta` beside the weights (MoMask, T2M-GPT)";
const HINT_STATISTICS: [&str; 2] = ["Mean_raw.npy", "Std_raw.npy"];
const HINT_ORIGIN: &str = "the mean and standard deviation that OmniControl and MotionLCM normalise hints with, their \
    folder `humanml_spatial_norm`";

/// Network to import from the file; it decides the output of the stage.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ImportedPart {
    /// The VAE of MLD or MotionLCM, also from a file with a denoiser; outputs a VAE.
    #[default]
    Vae,
    /// The denoiser of MLD, or MotionLCM's teacher; outputs a model. Reads `vae` and `text`.
    Mld,
    /// MotionLCM's student; outputs a model. Reads `vae` and `text`.
    Lcm,
    /// MotionLCM's ControlNet and trajectory encoder; outputs the model `model` with a control part.
    Control,
    /// The tokenizer of T2M-GPT, MMM or MoMask; outputs a tokenizer.
    Tokenizer,
    /// T2M-GPT's transformer; outputs a model. Reads `tokenizer` and `text`.
    T2mgpt,
    /// MoMask's masked transformer, and with `residual` that of the layers above the first; outputs a model. Reads
    /// `tokenizer` and `text`.
    Momask,
    /// MMM's transformer; outputs a model. Reads `tokenizer` and `text`.
    Mmm,
    /// MDM, with the moving average of its weights if there is one; outputs a model. Reads `text`.
    Mdm,
    /// DisCoRD's decoder; outputs a flow decoder, which `model.decoder` puts into a model. Reads `tokenizer`.
    Discord,
}

/// ReLU of a denoiser on the caption's embedding, which its weights do not show.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TextActivation {
    /// As in the published denoiser of its shape: latents of the transformer's width (v1, MLD) have one, others (v2)
    /// have none.
    #[default]
    Published,
    /// With a ReLU.
    Relu,
    /// Without a ReLU.
    None,
}

/// `import.model`: imports published weights. Sizes come from the shapes of the weights. Facts that the weights lack
/// are set here, with the published value as default. Unused tensors, such as an evaluator's or an optimizer's, are
/// listed in the log and left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ImportModel {
    /// File with the weights, of torch (`.ckpt`, `.tar`, `.pth`, `.pt`) or `.safetensors` under the same names. No code
    /// in it is executed. The stage's key has the digest of its content, not its path.
    pub path: String,
    /// Network to import from the file.
    pub part: ImportedPart,
    /// For `momask`: file with the residual transformer; a tokenizer of one codebook needs none.
    pub residual: String,
    /// For `vae`, `tokenizer`, `mdm`: format of the training data.
    pub format: DataFormat,
    /// For `vae`, `tokenizer`, `mdm`: folder with the mean and the deviation of its training, `mean.npy` and `std.npy`,
    /// or `Mean.npy` and `Std.npy`.
    pub statistics: String,
    /// Stage that gives a dataset with both, in place of `format` and `statistics`.
    pub dataset: String,
    /// For `mld`, `lcm`: stage that gives the VAE of its latents. A VAE in the file must be equal to it.
    pub vae: String,
    /// For `t2mgpt`, `momask`, `mmm`, `discord`: stage that gives the tokenizer.
    pub tokenizer: String,
    /// For models except `control`: stage that gives caption embeddings of its text encoder, of any captions.
    pub text: String,
    /// For `control`: stage that gives the model that it controls. A denoiser in the file must be equal to the model's.
    pub model: String,
    /// Number of attention heads; 0 uses the published number: 4 (MLD, MotionLCM, MDM, DisCoRD), 6 (MoMask), 16
    /// (T2M-GPT, MMM).
    #[schemars(range(min = 0, max = 1_024), extend("x-unit" = "heads"))]
    pub heads: usize,
    /// For `mld`, `lcm`: ReLU on the caption's embedding.
    pub text_activation: TextActivation,
    /// For `lcm`: range of the guidance scales w in its training.
    #[schemars(extend("minimum" = 0.0, "maximum" = 1e3))]
    pub guidance: (f64, f64),
    /// For `lcm`: length of a solver step in training, the paper's k: 100 (v2), 20 (v1). Samplers without `timesteps`
    /// use the same grid.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "timesteps"))]
    pub skip: usize,
    /// For `control`: targets in its training.
    pub hints: ControlHints,
    /// For `control`: folder with `Mean_raw.npy` and `Std_raw.npy`, the statistics of joints in metres that normalise
    /// hints.
    pub hint_statistics: String,
    /// For `momask`: tokens of the longest motion. The files of other models contain it.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "tokens"))]
    pub longest: usize,
    /// For `tokenizer`: factor between the dilations of neighbouring blocks.
    #[schemars(range(min = 1, max = 16))]
    pub growth: usize,
    /// For `mdm`: timesteps of its cosine schedule: 1000, or 50 in the authors' later model.
    #[schemars(range(min = 2, max = 1_000), extend("x-unit" = "timesteps"))]
    pub timesteps: usize,
    /// For `mdm`: masks padding in attention, as in the later model.
    pub mask_frames: bool,
    /// For `mdm`: frames of the longest motion.
    #[schemars(range(min = 4, max = 10_000), extend("x-unit" = "frames"))]
    pub max_frames: usize,
    /// For `discord`: solver of the flow.
    pub solver: FlowSolver,
    /// For `discord`: number of steps of the solver.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "steps"))]
    pub solver_steps: usize,
}

impl Default for ImportModel {
    fn default() -> Self {
        Self {
            path: String::new(),
            part: ImportedPart::Vae,
            residual: String::new(),
            format: DataFormat::Humanml3d,
            statistics: String::new(),
            dataset: String::new(),
            vae: "vae".into(),
            tokenizer: "tokenizer".into(),
            text: "text".into(),
            model: "lcm".into(),
            heads: 0,
            text_activation: TextActivation::Published,
            guidance: (5.0, 15.0),
            skip: 100,
            hints: ControlHints::default(),
            hint_statistics: String::new(),
            longest: 49,
            growth: 3,
            timesteps: 1000,
            mask_frames: false,
            max_frames: 196,
            solver: FlowSolver::Midpoint,
            solver_steps: 15,
        }
    }
}

impl ImportedPart {
    /// Name in YAML.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vae => "vae",
            Self::Mld => "mld",
            Self::Lcm => "lcm",
            Self::Control => "control",
            Self::Tokenizer => "tokenizer",
            Self::T2mgpt => "t2mgpt",
            Self::Momask => "momask",
            Self::Mmm => "mmm",
            Self::Mdm => "mdm",
            Self::Discord => "discord",
        }
    }

    /// Number of attention heads of the published network.
    pub fn heads(self) -> usize {
        match self {
            Self::Momask => 6,
            Self::T2mgpt | Self::Mmm => 16,
            _ => 4,
        }
    }

    /// Inputs of the stage for this part: the features' statistics, and stages.
    fn reads(self) -> Reads {
        let none = Reads::default();
        match self {
            Self::Vae | Self::Tokenizer => Reads { statistics: true, ..none },
            Self::Mld | Self::Lcm => Reads { vae: true, text: true, ..none },
            Self::Control => Reads { model: true, ..none },
            Self::T2mgpt | Self::Momask | Self::Mmm => Reads { tokenizer: true, text: true, ..none },
            Self::Mdm => Reads { statistics: true, text: true, ..none },
            Self::Discord => Reads { tokenizer: true, ..none },
        }
    }

    /// Source of its file.
    fn origin(self) -> &'static str {
        match self {
            Self::Vae | Self::Lcm | Self::Control => {
                "a checkpoint of MotionLCM, linked in github.com/Dai-Wenxun/MotionLCM"
            }
            Self::Mld => {
                "a checkpoint of MLD or MotionLCM, linked in github.com/ChenFengYe/motion-latent-diffusion and github.com/Dai-Wenxun/MotionLCM"
            }
            Self::Tokenizer => {
                "a tokenizer, linked in github.com/EricGuo5513/momask-codes, github.com/Mael-zys/T2M-GPT and github.com/exitudio/MMM"
            }
            Self::T2mgpt => "a checkpoint of T2M-GPT, linked in github.com/Mael-zys/T2M-GPT",
            Self::Momask => "a checkpoint of MoMask, linked in github.com/EricGuo5513/momask-codes",
            Self::Mmm => "a checkpoint of MMM, linked in github.com/exitudio/MMM",
            Self::Mdm => "a checkpoint of MDM, linked in github.com/GuyTevet/motion-diffusion-model",
            Self::Discord => "a checkpoint of DisCoRD, linked in github.com/whwjdqls/DisCoRD",
        }
    }
}

/// Inputs of a part's import besides its file.
#[derive(Debug, Clone, Copy, Default)]
#[expect(clippy::struct_excessive_bools, reason = "a table of five columns")]
struct Reads {
    statistics: bool,
    vae: bool,
    tokenizer: bool,
    text: bool,
    model: bool,
}

impl StageSpec for ImportModel {
    const KIND: &'static str = "import.model";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "vae", kind: ArtifactKind::Vae };

    fn output(&self) -> Output {
        match self.part {
            ImportedPart::Vae => Self::OUTPUT,
            ImportedPart::Tokenizer => Output { name: "tokenizer", kind: ArtifactKind::Tokenizer },
            ImportedPart::Discord => Output { name: "decoder", kind: ArtifactKind::FlowDecoder },
            _ => Output { name: "model", kind: ArtifactKind::Model },
        }
    }

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let reads = self.part.reads();
        let control = self.part == ImportedPart::Control;
        vec![
            Ref::file("path", &mut self.path).holding(&[], self.part.origin()),
            Ref::file("residual", &mut self.residual)
                .holding(&[], self.part.origin())
                .only_if(self.part == ImportedPart::Momask),
            Ref::folder("statistics", &mut self.statistics)
                .holding(&STATISTICS, STATISTICS_ORIGIN)
                .only_if(reads.statistics),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset).optional().only_if(reads.statistics),
            Ref::folder("hint_statistics", &mut self.hint_statistics)
                .holding(&HINT_STATISTICS, HINT_ORIGIN)
                .only_if(control),
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae).only_if(reads.vae),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer).only_if(reads.tokenizer),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings).only_if(reads.text),
            Ref::stage("model", &mut self.model, ArtifactKind::Model).only_if(reads.model),
        ]
    }

    fn check(&self, p: &mut Problems) {
        let part = self.part;
        let missing = |path: &str| path.trim().is_empty();
        if missing(&self.path) {
            p.add(
                "path",
                "`path` is missing; set it to the file with the weights",
                &format!("download {}", part.origin()),
            );
        }
        if part.reads().statistics && !missing(&self.statistics) && !missing(&self.dataset) {
            let message = "`statistics` and `dataset` are both set, and both define how features are normalised";
            p.add("statistics", message, "remove one of them");
        }
        if part.reads().statistics && missing(&self.statistics) && missing(&self.dataset) {
            let help = format!("set it to {STATISTICS_ORIGIN}; or write `dataset: dataset`");
            p.add("statistics", "`statistics` is missing; expected the folder with `mean.npy` and `std.npy`", &help);
        }
        if part == ImportedPart::Control {
            if missing(&self.hint_statistics) {
                let message = "`hint_statistics` is missing; expected the folder with `Mean_raw.npy` and `Std_raw.npy`";
                p.add("hint_statistics", message, &format!("set it to {HINT_ORIGIN}"));
            }
            self.hints.check(p);
        }
        if part != ImportedPart::Momask && !missing(&self.residual) {
            let message = format!("`residual` is set, but `{}` has only one file", part.name());
            p.add("residual", message, "remove it");
        }
        p.ascending("guidance", self.guidance);
        p.divides_timesteps("skip", self.skip, "published: 100 (v2) and 20 (v1)");
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let model = &self.model;
        if self.part == ImportedPart::Control && stages.family(model).is_some_and(|family| !family.draws_latents()) {
            let message = format!("`{model}` is not a latent diffusion model; a ControlNet needs one");
            p.add("model", message, "set it to the stage that imports or trains the controlled model");
        }
    }

    fn format(&self) -> Option<DataFormat> {
        (self.part.reads().statistics && self.dataset.is_empty()).then_some(self.format)
    }

    fn family(&self) -> Option<Family> {
        match self.part {
            ImportedPart::Mld => Some(Family::Mld),
            ImportedPart::Lcm => Some(Family::Lcm { skip: self.skip, guidance: self.guidance }),
            ImportedPart::T2mgpt => Some(Family::Autoregressive),
            ImportedPart::Momask => Some(Family::Masked),
            ImportedPart::Mmm => Some(Family::Mmm),
            ImportedPart::Mdm => Some(Family::Features { timesteps: self.timesteps, solver: Solver::Ddpm }),
            ImportedPart::Vae | ImportedPart::Control | ImportedPart::Tokenizer | ImportedPart::Discord => None,
        }
    }
}
