//! `trainer generate`: generates motions from sentences, or replaces part of a motion.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use mocap::export::{Motion, Outs, numbered};
use mocap::requests::Request;
use motion::vocabulary::Vocabulary;
use motion::{DataPath, Skeleton, npy};
use protocol::Seed;
use protocol::stage::Sampler;
use serde_json::{Value, json};
use stages::generate::{Generated, Generator, Timing};

use super::args::count;
use super::control::{ControlArgs, Missed, Targets};
use super::keep::Span;
use super::model::{self, Found};
use super::out::{self, OutArgs};
use super::remote::check_parent;
use super::sampler::SamplerArgs;
use super::sentences::SentenceArgs;
use super::stream::{self, Opening, StreamArgs};
use super::unknown_words::{self, Compared};
use crate::client::Target;
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

#[derive(Debug, Args)]
#[command(mut_arg("out", |out| out.required(false).required_unless_present("stream")))]
pub(crate) struct GenerateArgs {
    /// Description of the motion in words; several sentences make several motions
    #[arg(required_unless_present_any = ["captions", "stream"])]
    prompt: Vec<String>,
    /// MODEL@ALIAS, MODEL@best or MODEL:VERSION
    #[arg(short, long, required_unless_present = "stage", conflicts_with = "stage")]
    model: Option<String>,
    /// The model of a run's stage, such as the teacher
    #[arg(long, value_name = "STAGE")]
    stage: Option<String>,
    /// The run of --stage: its name, a unique beginning of it, or `@last`
    #[arg(long, default_value = "@last", requires = "stage", conflicts_with = "model")]
    run: String,
    /// Sampling steps [default: as in the model's evaluation]
    #[arg(long, value_name = "N", value_parser = count, allow_negative_numbers = true, help_heading = "Sampling")]
    steps: Option<usize>,
    #[command(flatten)]
    sampler: SamplerArgs,
    #[command(flatten, next_help_heading = "Lengths and seeds")]
    sentences: SentenceArgs,
    /// A motion to change in part, features [frames, features] as `--out FILE.npy` writes them; for masked token models
    /// only
    #[arg(long, value_name = "FILE.npy", requires = "keep", conflicts_with_all = ["frames", "seconds"], help_heading = "Editing")]
    edit: Option<PathBuf>,
    /// Spans of it to keep, FROM:TO in frames or seconds, from the end if negative: `0:1s,-1s:` keeps the first and the
    /// last second
    #[arg(
        long,
        value_name = "SPANS",
        value_delimiter = ',',
        requires = "edit",
        allow_hyphen_values = true,
        help_heading = "Editing"
    )]
    keep: Vec<Span>,
    /// Computing backend: flex, ndarray, wgpu or cuda [default: the first that this build and machine have]
    #[arg(long, help_heading = "Sampling")]
    backend: Option<String>,
    #[command(flatten, next_help_heading = "Output")]
    out: OutArgs,
    #[command(flatten, next_help_heading = "Control")]
    control: ControlArgs,
    /// Also write joint positions [frames, joints, 3]
    #[arg(long, value_name = "FILE.npy", help_heading = "Output")]
    positions: Option<PathBuf>,
    /// Also write features
    #[arg(long, value_name = "FILE.npy", help_heading = "Output")]
    features: Option<PathBuf>,
    #[command(flatten, next_help_heading = "Store and server")]
    target: Target,
    #[command(flatten, next_help_heading = "Streaming")]
    stream: StreamArgs,
}

/// A motion of the report.
struct Row {
    prompt: String,
    seed: u64,
    frames: usize,
    seconds: f64,
    /// True if the model recognises a word of the sentence.
    known: bool,
    /// The sentence compared with the training captions, if the store has them.
    words: Option<Compared>,
    kept: Vec<Range<usize>>,
    timing: Timing,
    missed: Option<Missed>,
    files: Vec<String>,
    /// Largest distance of a file's skeleton from the motion in metres.
    off: Option<f64>,
}

/// Values that all motions of the report share.
struct Shared {
    label: String,
    sampler: Sampler,
    loaded: Duration,
}

impl GenerateArgs {
    /// Format of the report.
    pub(super) fn report(&self) -> Output {
        self.out.report()
    }

    /// Writes the other files of motion `number`, besides those of `--out`.
    fn write_arrays(&self, motion: &Generated, number: usize, count: usize) -> Result<Vec<String>> {
        let rows = motion.frames;
        let width = |values: &[f32]| values.len() / rows.max(1);
        let positions = [rows, width(&motion.joints) / 3, 3];
        let features = [rows, width(&motion.features)];
        let mut written = Vec::new();
        for (path, shape, values) in
            [(&self.features, &features[..], &motion.features), (&self.positions, &positions[..], &motion.joints)]
        {
            let Some(path) = path else { continue };
            let path = numbered(path, number, count);
            npy::write(&path, shape, values).map_err(Problem::failed)?;
            written.push(path.display().to_string());
        }
        Ok(written)
    }

    fn check(&self, requests: &[Request]) -> Result<()> {
        if requests.len() > 1 && self.control.given() {
            return Err(Problem::usage("`--control` applies to one motion; give one sentence"));
        }
        if self.edit.is_some() && SentenceArgs::have_length(requests) {
            return Err(Problem::usage("an edited motion keeps its length; give sentences without a length"));
        }
        [&self.positions, &self.features].into_iter().flatten().try_for_each(|path| check_parent(path))
    }
}

/// Finds the model, with the requested control part.
async fn found(args: &GenerateArgs) -> Result<(Found, Option<Vocabulary>)> {
    let reader = Reader::open(&args.target).await?;
    let found = match (&args.stage, &args.model) {
        (Some(stage), _) => model::stage(&reader, &reader.find(&args.run).await?, stage).await?,
        (None, model) => model::version(&reader, model.as_deref().unwrap_or_default()).await?,
    };
    let vocabulary = unknown_words::vocabulary(&reader, &found).await?;
    let found = args.control.completed(&reader, found).await?;
    reader.close().await;
    Ok((found, vocabulary))
}

async fn stream(args: GenerateArgs) -> Result<u8> {
    // The names of files are checked before the model is loaded.
    args.out.files(1)?;
    let (found, _) = found(&args).await?;
    let (device, _) = model::device(args.backend.as_deref())?;
    let GenerateArgs { stream, steps, sampler, sentences, control, out, target, .. } = args;
    let (seed, options, joints) = (sentences.seed(), control.options(), control.joints().to_vec());
    let opening = Opening { found, device, steps, sampler, seed, control: options, joints };
    let insecure = target.server.connection.insecure;
    stream::stream(stream, opening, out, insecure, |fps| sentences.bound(fps)).await
}

pub(crate) async fn generate(args: GenerateArgs) -> Result<u8> {
    args.control.check(args.stream.is_wanted())?;
    if args.stream.is_wanted() {
        return stream(args).await;
    }
    let requests = args.sentences.requests(&args.prompt, &[])?;
    let seeds = args.sentences.seeds();
    let count = requests.len() * seeds.len();
    args.check(&requests)?;
    let outs = args.out.files(count)?;
    let start = Instant::now();
    let (Found { manifest, blobs, label, measured, .. }, vocabulary) = found(&args).await?;
    let label = label.to_string();
    let (device, _) = model::device(args.backend.as_deref())?;
    let generator = Generator::load(&manifest, &blobs, &device).map_err(Problem::failed)?;
    let loaded = start.elapsed();

    let sampler = args.sampler.sampler(args.steps, generator.sampler(), &measured);
    let sampler = sampler.map_err(|why| Problem::usage(format!("{label}: {why}")))?;
    note_guidance(&generator, &label, &sampler);
    let edit = args.edit.as_deref().map(|path| Edit::read(path, &args.keep, &generator)).transpose()?;
    let fps = Skeleton::of(generator.format()).fps;
    let first = requests.first().and_then(|request| request.length);
    let targets = args.control.targets(&generator, &label, first.map(|length| length.frames(fps)))?;
    if vocabulary.is_none() {
        print::note(&format!(
            "note: this store has no training captions of {label}, so words that it never saw cannot be named"
        ));
    }
    let shared = Shared { label, sampler, loaded };
    let mut session =
        Session { args: &args, generator, vocabulary, edit, targets, outs, count, shared, rows: Vec::new() };
    let mut motions = Vec::new();
    for request in &requests {
        motions.push(session.draw_all(request, &seeds)?);
    }
    let Session { edit, outs, shared, rows, .. } = session;
    let together = write_together(&outs, &shared.label, &requests, &motions)?;
    match args.report() {
        Output::Json if outs.wants_all() => {
            rows.iter().for_each(|row| print::out(&row.json(&shared, &together).to_string()));
        }
        Output::Json => {}
        Output::Table => print::out(&table(&rows, &shared, &together, edit.as_ref())),
    }
    Ok(0)
}

fn note_guidance(generator: &Generator, label: &str, sampler: &Sampler) {
    if let Some((low, high)) = generator.family().exceeded_range(sampler.guidance) {
        let guidance = sampler.guidance;
        print::note(&format!(
            "note: {label} was trained for guidance {low} to {high}; at {guidance} the motion may be arbitrary"
        ));
    }
}

/// One call of the command: the loaded model, and the motions that it has drawn.
struct Session<'a> {
    args: &'a GenerateArgs,
    generator: Generator,
    vocabulary: Option<Vocabulary>,
    edit: Option<Edit>,
    targets: Option<Targets>,
    outs: Outs,
    /// Number of motions in all.
    count: usize,
    shared: Shared,
    rows: Vec<Row>,
}

impl Session<'_> {
    /// Draws a sentence with each seed. Returns the motions that files with several motions need.
    fn draw_all(&mut self, request: &Request, seeds: &[u64]) -> Result<Vec<Motion>> {
        let label = &self.shared.label;
        let mut known = is_known(&self.generator, label, &request.caption)?;
        let known_to_encoder = self.vocabulary.as_ref().filter(|_| known);
        let words = unknown_words::compare(known_to_encoder, label, &request.caption);
        known &= words.as_ref().is_none_or(|words| words.unknown.is_empty() || words.has_known);
        let mut drawn = Vec::new();
        for seed in seeds {
            let motion = self.draw_one(request, *seed, known, words.as_ref())?;
            if self.outs.wants_all() {
                drawn.push(motion);
            } else if let (Output::Json, Some(row)) = (self.args.report(), self.rows.last()) {
                // This motion has no more files, so its line is printed at once.
                print::out(&row.json(&self.shared, &[]).to_string());
            }
        }
        Ok(drawn)
    }

    /// Draws a motion, writes its files and adds its row.
    fn draw_one(&mut self, request: &Request, seed: u64, known: bool, words: Option<&Compared>) -> Result<Motion> {
        let Self { args, shared, targets, .. } = self;
        let targets = targets.as_ref();
        let (motion, kept) = draw(&self.generator, request, Seed(seed), &shared.sampler, self.edit.as_ref(), targets)?;
        let number = self.rows.len() + 1;
        let arrays = args.write_arrays(&motion, number, self.count)?;
        let timing = motion.timing;
        let missed = targets.and_then(|targets| targets.missed(&motion));
        let note = format!("{}, {}, seed {seed}", shared.label, shared.sampler);
        let waypoints = targets.map(|targets| targets.waypoints.clone()).unwrap_or_default();
        let motion = Motion { kept: kept.clone(), ..exported(&request.caption, note, motion, waypoints) };
        let motion = args.out.prepared(motion);
        let written = self.outs.write(number, &motion).map_err(out::refused)?;
        let frames = motion.frames();
        self.rows.push(Row {
            prompt: request.caption.clone(),
            seed,
            frames,
            seconds: frames as f64 / motion.skeleton.fps,
            known,
            words: words.cloned(),
            kept,
            timing,
            missed,
            files: out::names(&written).chain(arrays).collect(),
            off: out::off_metres(&written),
        });
        Ok(motion)
    }
}

/// Returns true if the model recognises a word of the sentence; prints a note if not.
pub(super) fn is_known(generator: &Generator, label: &str, caption: &str) -> Result<bool> {
    let known = generator.knows(caption).map_err(model::refused)?;
    if !known && caption.trim().is_empty() {
        print::note(&format!("note: the sentence is empty, so {label} generates an arbitrary motion"));
    } else if !known {
        print::note(&format!(
            "note: the text encoder of {label} recognises no word of `{caption}`; the result is the same as for an \
             empty sentence"
        ));
    }
    Ok(known)
}

/// Wraps a generated motion for export.
pub(super) fn exported(
    caption: &str,
    note: String,
    motion: Generated,
    waypoints: Vec<motion::waypoints::Waypoint>,
) -> Motion {
    Motion {
        caption: caption.to_owned(),
        note,
        skeleton: Skeleton::of(motion.format),
        joints: motion.joints,
        features: Some(motion.features),
        waypoints,
        kept: Vec::new(),
    }
}

/// Generates a motion. Also returns the frames of an edited motion that were kept.
fn draw(
    generator: &Generator,
    request: &Request,
    seed: Seed,
    sampler: &Sampler,
    edit: Option<&Edit>,
    targets: Option<&Targets>,
) -> Result<(Generated, Vec<Range<usize>>)> {
    let (prompt, sampler) = (request.caption.as_str(), Some(sampler));
    let drawn = match (edit, targets) {
        (None, None) => {
            let frames = request.length.map(|length| length.frames(Skeleton::of(generator.format()).fps));
            generator.generate(prompt, frames, sampler, seed).map(|motion| (motion, Vec::new()))
        }
        (None, Some(targets)) => {
            let motion = generator.generate_controlled(prompt, sampler, seed, targets.request());
            motion.map(|motion| (motion, Vec::new()))
        }
        (Some(edit), _) => {
            let edited = generator.edit(prompt, &edit.motion, &edit.keep, sampler, seed);
            edited.map(|edited| (edited.motion, edited.kept))
        }
    };
    drawn.map_err(model::refused)
}

/// Writes the files that hold all motions. Each sentence has a section if it has several motions.
fn write_together(outs: &Outs, label: &str, requests: &[Request], motions: &[Vec<Motion>]) -> Result<Vec<String>> {
    let several = motions.len() > 1 && motions.iter().any(|drawn| drawn.len() > 1);
    let sections: Vec<(String, Vec<&Motion>)> = if several {
        let title = |request: &Request| request.caption.clone();
        requests.iter().map(title).zip(motions.iter().map(|drawn| drawn.iter().collect())).collect()
    } else {
        vec![(String::new(), motions.iter().flatten().collect())]
    };
    let written = outs.finish(label, &sections).map_err(out::refused)?;
    Ok(out::names(&written).collect())
}

/// Converts a time to milliseconds.
fn milliseconds(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

impl Row {
    /// The JSON line of a motion, which is also in the files `together`.
    fn json(&self, shared: &Shared, together: &[String]) -> Value {
        let Shared { label, sampler, loaded } = shared;
        json!({
            "schema_version": 1,
            "model": label,
            "prompt": self.prompt,
            "known": self.known,
            "unknown_words": self.words.as_ref().map(|words| &words.unknown),
            "nearest_known": self.words.as_ref().map(|words| &words.nearest),
            "frames": self.frames,
            "seconds": self.seconds,
            "kept": self.kept.iter().map(|span| [span.start, span.end]).collect::<Vec<_>>(),
            "sampler": sampler,
            "seed": self.seed,
            "files": self.files.iter().chain(together).collect::<Vec<_>>(),
            "skeleton_error_m": self.off,
            "sentence_ms": milliseconds(self.timing.total()),
            "text_ms": milliseconds(self.timing.text),
            "sampling_ms": milliseconds(self.timing.sampling),
            "decoding_ms": milliseconds(self.timing.decoding),
            "load_ms": milliseconds(*loaded),
            "control": self.missed.map(|missed| json!({
                "told": missed.targets,
                "average_error_m": missed.average,
                "worst_error_m": missed.worst,
                "missed_by_50cm": missed.location,
            })),
        })
    }
}

/// The report as text.
fn table(rows: &[Row], shared: &Shared, together: &[String], edit: Option<&Edit>) -> String {
    let Shared { label, sampler, loaded } = shared;
    let files = |row: &Row| row.files.iter().chain(together).cloned().collect::<Vec<_>>().join(", ");
    let mut text = match rows {
        [row] => {
            let kept = edit.map(|edit| edit.describe(row.frames, &row.kept)).unwrap_or_default();
            format!("{} from {label}: {} frames{kept}, {sampler}\n", files(row), row.frames)
        }
        rows => {
            let cells = |row: &Row| {
                vec![row.prompt.clone(), row.seed.to_string(), row.frames.to_string(), row.files.join(", ")]
            };
            let table = print::table(&["SENTENCE", "SEED", "FRAMES", "FILES"], rows.iter().map(cells).collect());
            let all =
                if together.is_empty() { String::new() } else { format!("{} with all of them, ", together.join(", ")) };
            format!("{table}\n\n{all}{} motions from {label}, {sampler}\n", rows.len())
        }
    };
    let mean = |part: fn(&Timing) -> Duration| {
        rows.iter().map(|row| milliseconds(part(&row.timing))).sum::<f64>() / rows.len().max(1) as f64
    };
    text += &format!(
        "{:.1} ms per sentence (text {:.1}, sampling {:.1}, decoding {:.1}); the model loaded in {:.0} ms",
        mean(Timing::total),
        mean(|timing| timing.text),
        mean(|timing| timing.sampling),
        mean(|timing| timing.decoding),
        milliseconds(*loaded),
    );
    if let Some(off) = rows.iter().filter_map(|row| row.off).reduce(f64::max) {
        text +=
            &format!("\nin .bvh and .glb, joints are up to {:.1} mm off, because bones keep their lengths", 1e3 * off);
    }
    for missed in rows.iter().filter_map(|row| row.missed) {
        text += &format!(
            "\n{} target positions: {:.1} cm off on average, {:.1} cm at most; {:.0} % are missed by more than 50 cm",
            missed.targets,
            100.0 * missed.average,
            100.0 * missed.worst,
            100.0 * missed.location,
        );
    }
    text
}

/// A motion to edit.
struct Edit {
    /// Values `[frames, features]`.
    motion: Vec<f32>,
    frames: usize,
    keep: Vec<Range<usize>>,
}

impl Edit {
    fn read(path: &Path, keep: &[Span], generator: &Generator) -> Result<Self> {
        let array = npy::read(&DataPath::local(path)).map_err(|error| Problem::usage(error.to_string()))?;
        let skeleton = Skeleton::of(generator.format());
        let refuse = |what: String| Problem::usage(format!("{}: {what}", path.display()));
        let [frames, width] = array.shape[..] else {
            return Err(refuse(format!("has shape {:?}; expected [frames, {}]", array.shape, skeleton.features)));
        };
        if width != skeleton.features {
            let name = generator.format().name();
            return Err(refuse(format!(
                "has {width} features per frame, but the model's skeleton (`{name}`) has {}",
                skeleton.features
            )));
        }
        if let Some(at) = array.data.iter().position(|value| !value.is_finite()) {
            return Err(refuse(format!("frame {} has a number that is not finite", at / width)));
        }
        let keep = keep.iter().map(|span| span.of(frames, skeleton.fps)).collect::<std::result::Result<_, String>>();
        Ok(Self { motion: array.data, frames, keep: keep.map_err(refuse)? })
    }

    /// Describes the kept spans, and the last frames that fill no token.
    fn describe(&self, frames: usize, kept: &[Range<usize>]) -> String {
        let spans: Vec<String> = kept.iter().map(|span| format!("{}-{}", span.start, span.end - 1)).collect();
        let rest = match self.frames - frames {
            0 => String::new(),
            rest => format!("; the last {rest} of {} do not fill a token and were left out", self.frames),
        };
        format!(" ({} stay{rest})", spans.join(", "))
    }
}
