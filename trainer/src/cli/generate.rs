//! `trainer generate`: a sentence to a moving stick figure, or to a part of a motion whose rest stays.

use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use motion::{Skeleton, npy};
use protocol::Seed;
use stages::generate::{Generated, Generator};

use super::control::{ControlArgs, Told};
use super::keep::Span;
use super::model::{self, Found};
use super::remote::check_parent;
use super::sampler::SamplerArgs;
use crate::client::Target;
use crate::print::{self, Output};
use crate::problem::{Problem, Result};
use crate::reader::Reader;

#[derive(Debug, Args)]
pub(crate) struct GenerateArgs {
    /// What the motion should be, in words; several sentences make one sheet, for `--out FILE.png`
    #[arg(required = true)]
    prompt: Vec<String>,
    /// MODEL@ALIAS, MODEL@best or MODEL:VERSION
    #[arg(short, long, required_unless_present = "stage", conflicts_with = "stage")]
    model: Option<String>,
    /// What a stage of a run gave, such as the teacher
    #[arg(long, value_name = "STAGE")]
    stage: Option<String>,
    /// The run of --stage: its name, a unique beginning of it, or `@last`
    #[arg(long, default_value = "@last", requires = "stage")]
    run: String,
    /// Sampling steps [default: as the model was measured]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    #[command(flatten)]
    sampler: SamplerArgs,
    /// Length in frames [default: what the model's length estimator says, 120 without one]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// A motion, features [frames, features] as `--out FILE.npy` writes them, of which a part is drawn anew: masked token models only
    #[arg(long, value_name = "FILE.npy", requires = "keep", conflicts_with = "frames")]
    edit: Option<PathBuf>,
    /// What stays of it, FROM:TO in frames or seconds, from the end if negative: `0:1s,-1s:` keeps the first and the last second
    #[arg(long, value_name = "SPANS", value_delimiter = ',', requires = "edit", allow_hyphen_values = true)]
    keep: Vec<Span>,
    /// Other seeds give other motions
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where to compute: flex, ndarray, wgpu or cuda [default: the first that this build and machine have]
    #[arg(long)]
    backend: Option<String>,
    /// Where to write: `.gif` for a moving figure, `.png` for a sheet of poses, `.npy` for features
    #[arg(short = 'o', long = "out", value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    control: ControlArgs,
    /// Also write joint positions [frames, joints, 3]
    #[arg(long, value_name = "FILE.npy")]
    positions: Option<PathBuf>,
    /// Also write features
    #[arg(long, value_name = "FILE.npy")]
    features: Option<PathBuf>,
    #[command(flatten)]
    target: Target,
    /// How the report is printed
    #[arg(long, value_enum, default_value_t)]
    pub(super) report: Output,
}

pub(crate) async fn generate(args: GenerateArgs) -> Result<u8> {
    let kind = |path: &Path| path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    let ending = kind(&args.out);
    if !matches!(ending.as_str(), "gif" | "png" | "npy") {
        let expected = "expected a name that ends in .gif, .png or .npy";
        return Err(Problem::usage(format!("cannot write `{}`: {expected}", args.out.display())));
    }
    if args.prompt.len() > 1 && args.control.given() {
        return Err(Problem::usage("a path is of one motion: give one sentence with `--control`"));
    }
    if args.prompt.len() > 1 && (ending != "png" || args.positions.is_some() || args.features.is_some()) {
        return Err(Problem::usage("several sentences make one sheet: give `--out FILE.png` and no other file"));
    }
    for path in [Some(&args.out), args.positions.as_ref(), args.features.as_ref()].into_iter().flatten() {
        check_parent(path)?;
    }
    let start = Instant::now();
    let reader = Reader::open(&args.target).await?;
    let found = match (&args.stage, &args.model) {
        (Some(stage), _) => model::stage(&reader, &reader.find(&args.run).await?, stage).await?,
        (None, model) => model::version(&reader, model.as_deref().unwrap_or_default()).await?,
    };
    let found = args.control.completed(&reader, found).await?;
    let Found { manifest, blobs, label, measured } = found;
    reader.close().await;
    let (device, _) = model::device(args.backend.as_deref())?;
    let generator = Generator::load(&manifest, &blobs, &device).map_err(Problem::failed)?;
    let loaded = start.elapsed();

    let sampler = args.sampler.sampler(args.steps, generator.sampler(), &measured);
    let sampler = sampler.map_err(|why| Problem::usage(format!("{label}: {why}")))?;
    let edit = args.edit.as_deref().map(|path| Edit::read(path, &args.keep, &generator)).transpose()?;
    let told = args.control.told(&generator, &label.to_string(), args.frames)?;
    let mut motions = Vec::new();
    let mut kept = Vec::new();
    for prompt in &args.prompt {
        let seed = Seed(args.seed);
        let motion = match (&edit, &told) {
            (None, None) => generator.generate(prompt, args.frames, Some(&sampler), seed).map_err(model::refused)?,
            (None, Some(told)) => {
                generator.generate_controlled(prompt, Some(&sampler), seed, told.request()).map_err(model::refused)?
            }
            (Some(edit), _) => {
                let edited = generator.edit(prompt, &edit.motion, &edit.keep, Some(&sampler), seed);
                let edited = edited.map_err(model::refused)?;
                kept = edited.kept;
                edited.motion
            }
        };
        motions.push((prompt.clone(), motion));
    }
    let written = write(&args, &motions, told.as_ref())?;
    let (prompt, motion) = motions.last().expect("at least one sentence is required");

    let missed = told.as_ref().and_then(|told| told.missed(motion));
    let timing = motion.timing;
    let milliseconds = |time: std::time::Duration| time.as_secs_f64() * 1e3;
    match args.report {
        Output::Json => print::json(&serde_json::json!({
            "schema_version": 1,
            "model": label.to_string(),
            "prompt": prompt,
            "frames": motion.frames,
            "kept": kept.iter().map(|span| [span.start, span.end]).collect::<Vec<_>>(),
            "sampler": sampler,
            "seed": args.seed,
            "files": written,
            "sentence_ms": milliseconds(timing.total()),
            "text_ms": milliseconds(timing.text),
            "sampling_ms": milliseconds(timing.sampling),
            "decoding_ms": milliseconds(timing.decoding),
            "load_ms": milliseconds(loaded),
            "control": missed.map(|missed| serde_json::json!({
                "told": missed.told,
                "average_error_m": missed.average,
                "worst_error_m": missed.worst,
                "missed_by_50cm": missed.location,
            })),
        })),
        Output::Table => print::out(&format!(
            "{} from {label}: {} frames{}, {}\n{:.1} ms per sentence (text {:.1}, sampling {:.1}, decoding {:.1}); the model loaded in {:.0} ms",
            written.join(", "),
            motion.frames,
            edit.map(|edit| edit.describe(motion.frames, &kept)).unwrap_or_default(),
            sampler,
            milliseconds(timing.total()),
            milliseconds(timing.text),
            milliseconds(timing.sampling),
            milliseconds(timing.decoding),
            milliseconds(loaded),
        )),
    }
    if let (Some(missed), Output::Table) = (missed, args.report) {
        print::out(&format!(
            "{} positions told: {:.1} cm off in the mean, {:.1} cm at worst, {:.0} % missed by more than 50 cm",
            missed.told,
            100.0 * missed.average,
            100.0 * missed.worst,
            100.0 * missed.location,
        ));
    }
    Ok(0)
}

/// A motion to edit.
struct Edit {
    /// Rows `[frames, features]`.
    motion: Vec<f32>,
    frames: usize,
    keep: Vec<Range<usize>>,
}

impl Edit {
    fn read(path: &Path, keep: &[Span], generator: &Generator) -> Result<Self> {
        let array = npy::read(path).map_err(|error| Problem::usage(error.to_string()))?;
        let skeleton = Skeleton::of(generator.format());
        let refuse = |what: String| Problem::usage(format!("{}: {what}", path.display()));
        let [frames, width] = array.shape[..] else {
            return Err(refuse(format!("has shape {:?}, expected [frames, {}]", array.shape, skeleton.features)));
        };
        if width != skeleton.features {
            let name = generator.format().name();
            return Err(refuse(format!(
                "has {width} features a frame, the model's skeleton (`{name}`) has {}",
                skeleton.features
            )));
        }
        if let Some(at) = array.data.iter().position(|value| !value.is_finite()) {
            return Err(refuse(format!("frame {} holds a number that is not finite", at / width)));
        }
        let keep = keep.iter().map(|span| span.of(frames, skeleton.fps)).collect::<std::result::Result<_, String>>();
        Ok(Self { motion: array.data, frames, keep: keep.map_err(refuse)? })
    }

    /// What stayed, and what was left out because it fills no token.
    fn describe(&self, frames: usize, kept: &[Range<usize>]) -> String {
        let spans: Vec<String> = kept.iter().map(|span| format!("{}-{}", span.start, span.end - 1)).collect();
        let rest = match self.frames - frames {
            0 => String::new(),
            rest => format!("; the last {rest} of {} fill no token and were left out", self.frames),
        };
        format!(" ({} stay{rest})", spans.join(", "))
    }
}

/// Poses of one motion on a sheet.
const POSES: usize = 10;

fn write(args: &GenerateArgs, motions: &[(String, Generated)], told: Option<&Told>) -> Result<Vec<String>> {
    let waypoints = told.map_or(&[][..], |told| &told.waypoints);
    let (prompt, motion) = &motions[0];
    let failed =
        |path: &Path, error: &dyn fmt::Display| Problem::failed(format!("cannot write `{}`: {error}", path.display()));
    let skeleton = Skeleton::of(motion.format);
    let (rows, width) = (motion.frames, motion.features.len() / motion.frames.max(1));
    let mut written = Vec::new();
    let mut features = args.features.iter().collect::<Vec<_>>();
    let ends_in = |ending: &str| args.out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(ending));
    if ends_in("npy") {
        features.push(&args.out);
    } else {
        if ends_in("png") {
            let rows: Vec<_> = motions.iter().map(|(prompt, motion)| (prompt.clone(), motion.joints.clone())).collect();
            motion::draw::strip_png_along(&rows, POSES, skeleton, waypoints, &args.out)
        } else {
            motion::draw::gif_along(&motion.joints, skeleton, prompt, waypoints, &args.out)
        }
        .map_err(|error| failed(&args.out, &error))?;
        written.push(args.out.display().to_string());
    }
    for path in features {
        npy::write(path, &[rows, width], &motion.features).map_err(|error| failed(path, &error))?;
        written.push(path.display().to_string());
    }
    if let Some(path) = &args.positions {
        let joints = motion.joints.len() / 3 / rows.max(1);
        npy::write(path, &[rows, joints, 3], &motion.joints).map_err(|error| failed(path, &error))?;
        written.push(path.display().to_string());
    }
    Ok(written)
}
