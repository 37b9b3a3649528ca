//! `trainer import`: published weights as a version of a model. It writes and runs a pipeline of `import.model` and
//! `register`. `--print` shows the pipeline, to be kept and changed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use crate::local::pipeline_file;
use crate::local::run;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

/// Parts of a published model that become a version.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Part {
    /// The denoiser of MLD, or MotionLCM's teacher, with its VAE
    Mld,
    /// MotionLCM's student with its VAE
    Lcm,
    /// MotionLCM's student with its VAE and its control part
    Control,
    /// T2M-GPT's transformer with its tokenizer
    T2mgpt,
    /// MoMask's two transformers with their tokenizer
    Momask,
    /// MMM's transformer with its tokenizer
    Mmm,
    /// MDM
    Mdm,
}

#[derive(Debug, Args)]
pub(crate) struct ImportArgs {
    /// File with the weights: of torch (`.ckpt`, `.tar`, `.pth`, `.pt`), or `.safetensors` under the published names
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The model that gets the new version
    #[arg(long = "as", value_name = "MODEL")]
    model: String,
    /// Kind of the weights
    #[arg(long, value_enum)]
    part: Part,
    /// Folder with the mean and the deviation of its training features: `mean.npy` and `std.npy`
    #[arg(long, value_name = "DIR")]
    statistics: PathBuf,
    /// Format of its training data: `humanml3d` or `kit`
    #[arg(long, default_value = "humanml3d", value_name = "FORMAT")]
    format: String,
    /// Text encoder of its training: `clip=FOLDER`, `t5=FOLDER`, `sentence-t5=FOLDER` or `hashed`
    #[arg(long, default_value = "hashed", value_name = "ENCODER=FOLDER")]
    text: String,
    /// File with the VAE, if FILE does not hold it
    #[arg(long, value_name = "FILE")]
    vae: Option<PathBuf>,
    /// File with the tokenizer of a token model
    #[arg(long, value_name = "FILE", required_if_eq_any = [("part", "t2mgpt"), ("part", "momask"), ("part", "mmm")])]
    tokenizer: Option<PathBuf>,
    /// File with MoMask's residual transformer
    #[arg(long, value_name = "FILE")]
    residual: Option<PathBuf>,
    /// Folder with `Mean_raw.npy` and `Std_raw.npy`, which normalise a control part's hints
    #[arg(long, value_name = "DIR", required_if_eq("part", "control"))]
    hint_statistics: Option<PathBuf>,
    /// Overrides a key of the pipeline, such as `stages.weights.heads=8`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Prints the pipeline and runs nothing
    #[arg(long)]
    print: bool,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    /// Format of the result
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

pub(crate) async fn import(args: ImportArgs, command: String) -> Result<u8> {
    let source = args.pipeline()?;
    let file = pipeline_file::of_text("the pipeline of `trainer import`", source, &args.set)?;
    if args.print {
        print::out(&file.source);
        return Ok(0);
    }
    let file = pipeline_file::with_data(file).map_err(|problem| {
        problem.hint("name files and folders that exist; `--print` shows the pipeline that reads them")
    })?;
    let file = Box::new(file);
    let options =
        run::Options { store: args.store, blobs: None, workers: Some(1), output: args.output, ui: false, command };
    run::run(run::Request::Submit { file, until: None }, options).await
}

/// Quotes a path for YAML.
fn quoted(path: &Path) -> String {
    serde_json::Value::from(path.display().to_string()).to_string()
}

impl ImportArgs {
    /// Writes the pipeline. Its embedded captions do not matter, so they are a few synthetic ones.
    fn pipeline(&self) -> Result<String> {
        let text = match self.text.split_once('=') {
            Some((encoder, folder)) => format!("{{encoder: {encoder}, path: {}}}", quoted(Path::new(folder))),
            None if self.text == "hashed" => "{encoder: hashed}".to_owned(),
            None => {
                let problem = Problem::usage(format!("`--text {}` has no folder", self.text));
                return Err(problem.hint(
                    "write `--text sentence-t5=FOLDER`, `clip=FOLDER` or `t5=FOLDER`; `hashed` needs no folder",
                ));
            }
        };
        let (format, statistics) = (&self.format, quoted(&self.statistics));
        let trained = format!("format: {format}, statistics: {statistics}");
        let mut stages = String::new();
        let mut stage = |name: &str, part: &str, path: &Path, more: &str| {
            let path = quoted(path);
            let _ = writeln!(stages, "  {name}: {{kind: import.model, part: {part}, path: {path}{more}}}");
        };
        let weights = "weights";
        match self.part {
            Part::Mld | Part::Lcm | Part::Control => {
                stage("vae", "vae", self.vae.as_ref().unwrap_or(&self.file), &format!(", {trained}"));
                if let (Part::Control, Some(hints)) = (self.part, &self.hint_statistics) {
                    stage("lcm", "lcm", &self.file, "");
                    stage(weights, "control", &self.file, &format!(", hint_statistics: {}", quoted(hints)));
                } else {
                    stage(weights, if self.part == Part::Mld { "mld" } else { "lcm" }, &self.file, "");
                }
            }
            Part::T2mgpt | Part::Momask | Part::Mmm => {
                if let Some(tokenizer) = &self.tokenizer {
                    stage("tokenizer", "tokenizer", tokenizer, &format!(", {trained}"));
                }
                let name = match self.part {
                    Part::T2mgpt => "t2mgpt",
                    Part::Momask => "momask",
                    _ => "mmm",
                };
                let residual = self.residual.as_deref().map(|path| format!(", residual: {}", quoted(path)));
                stage(weights, name, &self.file, &residual.unwrap_or_default());
            }
            Part::Mdm => stage(weights, "mdm", &self.file, &format!(", {trained}")),
        }
        let model = serde_json::Value::from(self.model.as_str());
        Ok(format!(
            "name: import\ndataset: {{format: synthetic, clips: 8}}\ntext: {text}\nstages:\n{stages}  \
             release: {{kind: register, model: {model}, from: {weights}}}\n"
        ))
    }
}
