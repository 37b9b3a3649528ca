//! `trainer time`: the time of models per sentence, side by side.

use std::path::Path;

use clap::Args;
use models::device::DeviceInfo;
use protocol::stage::Sampler;
use serde_json::{Value, json};
use stages::generate::timing::{self, Times, WARM_UP};
use stages::generate::{DEFAULT_FRAMES, Generator};

use super::model::{self, Found};
use super::sampler::SamplerArgs;
use crate::client::Target;
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

#[derive(Debug, Args)]
pub(crate) struct TimeArgs {
    /// MODEL@ALIAS, MODEL@best or MODEL:VERSION
    #[arg(required_unless_present = "stage")]
    model: Vec<String>,
    /// The model of a run's stage, such as the teacher; these come first in the table
    #[arg(long, value_name = "STAGE")]
    stage: Vec<String>,
    /// The run of --stage: its name, a unique beginning of it, or `@last`
    #[arg(long, default_value = "@last", requires = "stage")]
    run: String,
    /// Sampling steps, one row for each that the model supports [default: as in the model's evaluation]
    #[arg(long, value_name = "N", value_delimiter = ',')]
    steps: Vec<usize>,
    #[command(flatten)]
    sampler: SamplerArgs,
    /// Number of timed sentences, after a warm-up
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    sentences: u32,
    /// Length of each motion in frames [default: 120]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Computing backend: flex, ndarray, wgpu or cuda [default: the first that this build and machine have]
    #[arg(long)]
    backend: Option<String>,
    #[command(flatten)]
    target: Target,
    /// Format of the table
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

/// A line of the table.
struct Row {
    label: String,
    sampler: Sampler,
    times: Times,
}

impl Row {
    fn ratio_to(&self, first: &Self) -> f64 {
        self.times.mean / first.times.mean
    }

    fn frames_per_second(&self, frames: usize) -> f64 {
        frames as f64 / self.times.mean
    }
}

pub(crate) async fn time(args: TimeArgs) -> Result<u8> {
    let reader = Reader::open(&args.target).await?;
    let mut found = Vec::new();
    if !args.stage.is_empty() {
        let run = reader.find(&args.run).await?;
        for name in &args.stage {
            found.push(model::stage(&reader, &run, name).await?);
        }
    }
    for name in &args.model {
        found.push(model::version(&reader, name).await?);
    }
    reader.close().await;
    let (device, info) = model::device(args.backend.as_deref())?;
    let mut models: Vec<(String, Generator, &Found)> = Vec::new();
    for found in &found {
        let generator = Generator::load(&found.manifest, &found.blobs, &device).map_err(Problem::failed)?;
        models.push((found.label.to_string(), generator, found));
    }
    let mut timed: Vec<(&str, &Generator, Sampler)> = Vec::new();
    for (label, generator, found) in &models {
        let samplers = samplers(label, generator, &found.measured, &args).map_err(|why| {
            Problem::usage(format!("{label}: {why}")).hint("leave out --steps to use the default of each model")
        })?;
        timed.extend(samplers.into_iter().map(|sampler| (label.as_str(), generator, sampler)));
    }

    // The same length for all, so that a model's time does not depend on its length estimator.
    let frames = args.frames.unwrap_or(DEFAULT_FRAMES);
    let sentences = timing::sentences(args.sentences as usize);
    let progress = progress((sentences.len() + WARM_UP) * timed.len());
    let pairs: Vec<(&Generator, &Sampler)> =
        timed.iter().map(|(_, generator, sampler)| (*generator, sampler)).collect();
    let all = timing::time(&pairs, &sentences, Some(frames), &mut || progress.inc(1)).map_err(model::refused)?;
    progress.finish_and_clear();
    let row = |((label, _, sampler), timings): (&(&str, &Generator, Sampler), &Vec<timing::Timing>)| {
        Times::of(timings).map(|times| Row { label: (*label).to_owned(), sampler: sampler.clone(), times })
    };
    let rows: Vec<Row> = timed.iter().zip(&all).filter_map(row).collect();
    show(&rows, frames, &Machine::here(&info), args.output);
    Ok(0)
}

/// The samplers for timing a model: its own, or one for each supported value of `--steps`. Values that only other
/// models support are skipped with a note. A model that supports none is refused.
fn samplers(
    label: &str,
    generator: &Generator,
    measured: &[(String, Sampler)],
    args: &TimeArgs,
) -> std::result::Result<Vec<Sampler>, String> {
    let with = |steps| args.sampler.sampler(steps, generator.sampler(), measured);
    if args.steps.is_empty() {
        return Ok(vec![with(None)?]);
    }
    let mut refused = Vec::new();
    let mut fits = Vec::new();
    for steps in &args.steps {
        let sampler = with(Some(*steps))?;
        match generator.check_sampler(&sampler) {
            Ok(()) => fits.push(sampler),
            Err(why) => refused.push(why.to_string()),
        }
    }
    if fits.is_empty() {
        return Err(refused.join("; "));
    }
    refused.iter().for_each(|why| print::note(&format!("{label}: left out: {why}")));
    Ok(fits)
}

/// Properties of the machine that affect times.
struct Machine {
    backend: &'static str,
    device: String,
    threads: usize,
    instruction_set: &'static str,
    processor: Option<String>,
}

impl Machine {
    fn here(device: &DeviceInfo) -> Self {
        let information = std::fs::read_to_string(Path::new("/proc/cpuinfo")).unwrap_or_default();
        let processor = information.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
        Self {
            backend: device.backend.name(),
            device: device.name.clone(),
            threads: timing::threads(),
            instruction_set: models::instruction_set(),
            processor: processor.map(|(_, name)| name.trim().to_owned()),
        }
    }
}

fn show(rows: &[Row], frames: usize, machine: &Machine, output: Output) {
    let Some(first) = rows.first() else { return };
    match output {
        Output::Json => print::json(&document(rows, first, frames, machine)),
        Output::Table => print::out(&table(rows, first, frames, machine)),
    }
}

fn document(rows: &[Row], first: &Row, frames: usize, machine: &Machine) -> Value {
    let rows = rows.iter().map(|row| {
        json!({
            "model": row.label,
            "sampler": row.sampler,
            "sentences": row.times.sentences,
            "aits_s": row.times.mean,
            "median_s": row.times.median,
            "p95_s": row.times.p95,
            "text_s": row.times.text,
            "sampling_s": row.times.sampling,
            "decoding_s": row.times.decoding,
            "ratio": row.ratio_to(first),
            "frames_per_second": row.frames_per_second(frames),
        })
    });
    json!({
        "schema_version": 1,
        "frames": frames,
        "warm_up": WARM_UP,
        "machine": {
            "backend": machine.backend,
            "device": machine.device,
            "threads": machine.threads,
            "instruction_set": machine.instruction_set,
            "processor": machine.processor,
        },
        "rows": rows.collect::<Vec<_>>(),
    })
}

fn table(rows: &[Row], first: &Row, frames: usize, machine: &Machine) -> String {
    let milliseconds = |seconds: f64| format!("{:.2}", seconds * 1e3);
    let cells = rows.iter().map(|row| {
        vec![
            row.label.clone(),
            row.sampler.steps.to_string(),
            milliseconds(row.times.mean),
            milliseconds(row.times.median),
            milliseconds(row.times.p95),
            format!("{:.3}", row.ratio_to(first)),
            format!("{:.0}", row.frames_per_second(frames)),
        ]
    });
    let heads = ["MODEL", "STEPS", "AITS ms", "MEDIAN ms", "P95 ms", "RATIO", "FRAMES/s"];
    let processor = machine.processor.as_deref().unwrap_or("processor unknown");
    let Machine { backend, device, threads, instruction_set, .. } = machine;
    format!(
        "{}\n\n{} sentences, one at a time, after {WARM_UP} for warm-up; models alternate; {frames} frames each; measured \
         from the sentence to the features\n{backend} ({device}) with {threads} threads, {instruction_set}, {processor}",
        print::table(&heads, cells.collect()),
        first.times.sentences,
    )
}

/// A progress bar, hidden without a terminal.
fn progress(motions: usize) -> indicatif::ProgressBar {
    if print::on_terminal() { indicatif::ProgressBar::new(motions as u64) } else { indicatif::ProgressBar::hidden() }
}
