//! `trainer generate`: a sentence to a moving stick figure.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use burn::tensor::Device;
use checkpoint::{BlobError, Blobs};
use clap::Args;
use motion::{Skeleton, npy};
use protocol::stage::Sampler;
use protocol::{Digest, Manifest, Seed};
use registry::cli::{Command, Data};
use stages::generate::{Generated, Generator};

use super::remote::check_parent;
use crate::client::{Client, Target};
use crate::print::{self, Output};
use crate::problem::{Problem, Result, exit};

#[derive(Debug, Args)]
pub(crate) struct GenerateArgs {
    /// What the motion should be, in words; several sentences make one sheet, for `--out FILE.png`
    #[arg(required = true)]
    prompt: Vec<String>,
    /// MODEL@ALIAS, MODEL@best or MODEL:VERSION
    #[arg(short, long)]
    model: String,
    /// Sampling steps [default: the model's own]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Guidance: a teacher's scale g, a student's w = g - 1 [default: the model's own]
    #[arg(long, value_name = "W")]
    guidance: Option<f64>,
    /// Length in frames [default: 120]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Other seeds give other motions
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where to compute: flex, ndarray, wgpu or cuda [default: the first that this build and machine have]
    #[arg(long)]
    backend: Option<String>,
    /// Where to write: `.gif` for a moving figure, `.png` for a sheet of poses, `.npy` for features
    #[arg(short = 'o', long = "out", value_name = "FILE")]
    out: PathBuf,
    /// Also write joint positions [frames, joints, 3]
    #[arg(long, value_name = "FILE.npy")]
    joints: Option<PathBuf>,
    /// Also write features
    #[arg(long, value_name = "FILE.npy")]
    features: Option<PathBuf>,
    #[command(flatten)]
    target: Target,
    /// How the report is printed
    #[arg(long, value_enum, default_value_t)]
    pub(super) report: Output,
}

/// A model's blobs, fetched once and verified.
#[derive(Debug, Default)]
struct Fetched(Mutex<std::collections::BTreeMap<Digest, Arc<[u8]>>>);

impl Blobs for Fetched {
    fn get(&self, digest: Digest) -> std::result::Result<Arc<[u8]>, BlobError> {
        let blobs = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        blobs.get(&digest).cloned().ok_or(BlobError::NotFound(digest))
    }

    fn put(&self, _: Vec<u8>) -> std::result::Result<Digest, BlobError> {
        Err(BlobError::Refused("a model is only read here".into()))
    }
}

impl Fetched {
    fn keep(&self, name: Digest, bytes: Vec<u8>) -> Result<()> {
        let found = Digest::of(&bytes);
        if found != name {
            return Err(Problem::failed(BlobError::Corrupt { expected: name, found })
                .hint("`trainer registry fsck` checks the store"));
        }
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(name, bytes.into());
        Ok(())
    }
}

pub(crate) async fn generate(args: GenerateArgs) -> Result<u8> {
    let kind = |path: &Path| path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    let ending = kind(&args.out);
    if !matches!(ending.as_str(), "gif" | "png" | "npy") {
        let expected = "expected a name that ends in .gif, .png or .npy";
        return Err(Problem::usage(format!("cannot write `{}`: {expected}", args.out.display())));
    }
    if args.prompt.len() > 1 && (ending != "png" || args.joints.is_some() || args.features.is_some()) {
        return Err(Problem::usage("several sentences make one sheet: give `--out FILE.png` and no other file"));
    }
    for path in [Some(&args.out), args.joints.as_ref(), args.features.as_ref()].into_iter().flatten() {
        check_parent(path)?;
    }
    let start = Instant::now();
    let (manifest, blobs, label) = fetch(&args).await?;
    let device = device(args.backend.as_deref())?;
    let generator = Generator::load(&manifest, &blobs, &device).map_err(Problem::failed)?;
    let loaded = start.elapsed();

    let own = generator.sampler().clone();
    let steps = args.steps.unwrap_or(own.steps);
    let timesteps = if steps == own.steps { own.timesteps.clone() } else { Vec::new() };
    let sampler = Sampler { steps, guidance: args.guidance.unwrap_or(own.guidance), timesteps };
    let mut motions = Vec::new();
    for prompt in &args.prompt {
        let motion = generator.generate(prompt, args.frames, Some(&sampler), Seed(args.seed)).map_err(|error| {
            let exit = if matches!(error, stages::context::StageError::Input(_)) { exit::USAGE } else { exit::FAILED };
            Problem::new(exit, error)
        })?;
        motions.push((prompt.clone(), motion));
    }
    let written = write(&args, &motions)?;
    let (prompt, motion) = motions.last().expect("at least one sentence is required");

    let timing = motion.timing;
    let milliseconds = |time: std::time::Duration| time.as_secs_f64() * 1e3;
    match args.report {
        Output::Json => print::json(&serde_json::json!({
            "schema_version": 1,
            "model": label.to_string(),
            "prompt": prompt,
            "frames": motion.frames,
            "sampler": sampler,
            "seed": args.seed,
            "files": written,
            "sentence_ms": milliseconds(timing.total()),
            "text_ms": milliseconds(timing.text),
            "sampling_ms": milliseconds(timing.sampling),
            "decoding_ms": milliseconds(timing.decoding),
            "load_ms": milliseconds(loaded),
        })),
        Output::Table => print::out(&format!(
            "{} from {label}: {} frames, {} step(s), guidance {}\n{:.1} ms per sentence (text {:.1}, sampling {:.1}, decoding {:.1}); the model loaded in {:.0} ms",
            written.join(", "),
            motion.frames,
            sampler.steps,
            sampler.guidance,
            milliseconds(timing.total()),
            milliseconds(timing.text),
            milliseconds(timing.sampling),
            milliseconds(timing.decoding),
            milliseconds(loaded),
        )),
    }
    Ok(0)
}

/// The first device of a backend.
fn device(backend: Option<&str>) -> Result<Device> {
    let all = models::device::available();
    let found = match backend {
        None => all.iter().find(|device| device.index.is_some()),
        Some(name) => all.iter().find(|device| device.backend.name() == name),
    };
    let names: Vec<&str> = all.iter().map(|device| device.backend.name()).collect();
    let found = found.ok_or_else(|| {
        Problem::usage(format!("`--backend {}`: expected one of {}", backend.unwrap_or_default(), names.join(", ")))
    })?;
    models::device::open(found.backend, 0).map_err(|error| Problem::new(exit::USAGE, error))
}

/// Which version a name stood for.
struct Label(String, u64);

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (version {})", self.0, self.1)
    }
}

/// The model's manifest and blobs, from whoever holds the store.
async fn fetch(args: &GenerateArgs) -> Result<(Manifest, Fetched, Label)> {
    let client = Client::connect(&args.target).await?;
    let answer = client.registry(&Command::Show { reference: args.model.clone() }).await?;
    if let Some(error) = answer.error {
        let mut problem = Problem::new(answer.exit, anyhow::anyhow!("{}", error.message));
        problem.hint = error.hint;
        return Err(problem);
    }
    let (version, manifest) = match answer.data {
        Some(Data::Version { version, manifest }) => (version, manifest),
        Some(Data::Model { model, .. }) => {
            let aliases: Vec<String> = model.aliases.keys().map(|alias| format!("{}@{alias}", args.model)).collect();
            let problem =
                Problem::usage(format!("`{}` is a model; which of its {} versions?", args.model, model.versions));
            return Err(problem.hint(format!("name one, such as {}@best {}", args.model, aliases.join(" "))));
        }
        _ => {
            return Err(Problem::new(
                exit::FAULT,
                anyhow::anyhow!("the registry answered something else than a model"),
            ));
        }
    };
    let blobs = Fetched::default();
    for file in manifest.files.values() {
        blobs.keep(file.digest, client.blob(file.digest).await?)?;
    }
    client.close().await;
    Ok((manifest, blobs, Label(args.model.clone(), version.version)))
}

/// Poses of one motion on a sheet.
const POSES: usize = 10;

fn write(args: &GenerateArgs, motions: &[(String, Generated)]) -> Result<Vec<String>> {
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
            motion::draw::strip_png(&rows, POSES, skeleton, &args.out)
        } else {
            motion::draw::gif(&motion.joints, skeleton, prompt, &args.out)
        }
        .map_err(|error| failed(&args.out, &error))?;
        written.push(args.out.display().to_string());
    }
    for path in features {
        npy::write(path, &[rows, width], &motion.features).map_err(|error| failed(path, &error))?;
        written.push(path.display().to_string());
    }
    if let Some(path) = &args.joints {
        let joints = motion.joints.len() / 3 / rows.max(1);
        npy::write(path, &[rows, joints, 3], &motion.joints).map_err(|error| failed(path, &error))?;
        written.push(path.display().to_string());
    }
    Ok(written)
}
