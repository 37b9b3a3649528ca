//! `trainer gallery`: one page with the motions of a run's models for the same sentences and seeds, side by side. The
//! real clip with the nearest caption is beside them.

use std::collections::BTreeSet;
use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use mocap::export::{Motion, Outs, write_all};
use mocap::requests::Request;
use motion::features::recover_joints;
use motion::vocabulary::Vocabulary;
use motion::{Dataset, Skeleton};
use protocol::Seed;
use protocol::message::RunView;
use protocol::stage::Sampler;
use protocol::units::counted;
use serde_json::{Value, json};
use stages::generate::Generator;

use super::generate::{exported, is_known};
use super::model;
use super::out;
use super::remote::check_parent;
use super::sampler::SamplerArgs;
use super::sentences::SentenceArgs;
use crate::client::Target;
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

/// Default sentences: movements that every dataset has.
const SENTENCES: [&str; 6] = [
    "a person walks forward",
    "a person runs in a circle",
    "a person jumps up",
    "a person kicks with the right leg",
    "a person waves with the left hand",
    "a person sits down",
];

#[derive(Debug, Args)]
pub(crate) struct GalleryArgs {
    /// The run: its name, a unique beginning of it, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    /// Stages whose models are shown, in this order [default: all that have a model, in the order of the pipeline]
    #[arg(long, value_name = "STAGE", value_delimiter = ',')]
    stage: Vec<String>,
    /// Sentence to draw, may be repeated [default: six movements]
    #[arg(long = "prompt", value_name = "TEXT")]
    prompts: Vec<String>,
    /// Sampling steps of every model [default: as in its evaluation]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    #[command(flatten)]
    sampler: SamplerArgs,
    #[command(flatten)]
    sentences: SentenceArgs,
    /// Leave out the real clips beside the models
    #[arg(long)]
    no_real: bool,
    /// Computing backend: flex, ndarray, wgpu or cuda [default: the first that this build and machine have]
    #[arg(long)]
    backend: Option<String>,
    /// File of the page, or a `.png` for a sheet of poses
    #[arg(short = 'o', long = "out", value_name = "FILE", default_value = "gallery.html")]
    out: PathBuf,
    #[command(flatten)]
    target: Target,
    /// Format of the report
    #[arg(long, value_enum, default_value_t)]
    pub(super) report: Output,
}

pub(crate) async fn gallery(args: GalleryArgs) -> Result<u8> {
    let requests = args.sentences.requests(&args.prompts, &SENTENCES)?;
    let seeds = args.sentences.seeds();
    check_parent(&args.out)?;
    let reader = Reader::open(&args.target).await?;
    let run = reader.find(&args.run).await?;
    let mut all = model::stages(&run);
    // A registered version is the model of another stage.
    let registered =
        |name: &str| run.stages.iter().any(|stage| stage.name.as_str() == name && stage.kind == "register");
    if all.iter().any(|name| !registered(name)) {
        all.retain(|name| !registered(name));
    }
    let names = if args.stage.is_empty() { all } else { args.stage.iter().map(String::as_str).collect() };
    let real = match args.no_real {
        true => None,
        false => model::dataset(&reader, &run).await?,
    };
    let beside = usize::from(real.is_some());
    let count = requests.len() * seeds.len() * (names.len() + beside);
    let form = Outs::new(std::slice::from_ref(&args.out), count).map_err(out::refused)?;
    if !form.wants_all() {
        return Err(Problem::usage(format!("cannot write `{}`: expected .html or .png", args.out.display())));
    }
    if names.is_empty() {
        return Err(Problem::usage(format!("no stage of run `{}` has a model yet", run.run)));
    }
    let (device, _) = model::device(args.backend.as_deref())?;
    let mut grid = Grid { requests: &requests, seeds: &seeds, rows: vec![Vec::new(); requests.len() * seeds.len()] };
    grid.add_real(real.as_ref());
    let drawn = grid.add_models(&args, &reader, &run, &names, &device).await?;
    reader.close().await;
    let sections: Vec<(String, Vec<&Motion>)> =
        grid.titles().into_iter().zip(grid.rows.iter().map(|row| row.iter().collect())).collect();
    write_all(&format!("Models of {}", run.run), &sections, &args.out).map_err(out::refused)?;
    let count: usize = grid.rows.iter().map(Vec::len).sum();
    match args.report {
        Output::Json => print::json(&json!({
            "schema_version": 1,
            "run": run.run,
            "models": drawn,
            "motions": count,
            "files": [args.out.display().to_string()],
        })),
        Output::Table => print::out(&format!(
            "{}: {count} motions, {} for {} and {}, of {}",
            args.out.display(),
            names.join(", "),
            counted(requests.len(), "sentence"),
            counted(seeds.len(), "seed"),
            run.run
        )),
    }
    Ok(0)
}

/// A row for each sentence and seed; a column for the real clips, then one for each model.
struct Grid<'a> {
    requests: &'a [Request],
    seeds: &'a [u64],
    rows: Vec<Vec<Motion>>,
}

impl Grid<'_> {
    /// The other seeds of a sentence have the same real clip, so only the first row shows it.
    fn add_real(&mut self, dataset: Option<&Dataset>) {
        let real = dataset.map(|dataset| real_clips(dataset, self.requests)).unwrap_or_default();
        for (clip, rows) in real.into_iter().zip(self.rows.chunks_mut(self.seeds.len().max(1))) {
            rows.iter_mut().take(1).for_each(|row| row.extend(clip.clone()));
        }
    }

    /// Draws with the models of `names`, and returns what drew.
    async fn add_models(
        &mut self,
        args: &GalleryArgs,
        reader: &Reader,
        run: &RunView,
        names: &[&str],
        device: &Device,
    ) -> Result<Vec<Value>> {
        let mut lengths: Vec<Option<usize>> = vec![None; self.rows.len()];
        let (mut drawn, mut shown) = (Vec::new(), BTreeSet::new());
        for name in names {
            let found = model::stage(reader, run, name).await?;
            // Two stages may have the same model, such as a student and its registered version.
            if !shown.insert(found.artifact) {
                continue;
            }
            let generator = Generator::load(&found.manifest, &found.blobs, device).map_err(Problem::failed)?;
            let sampler = match args.sampler.sampler(args.steps, generator.sampler(), &found.measured) {
                Ok(sampler) => sampler,
                // The evaluations use several samplers: use the papers' sampler of its kind, which the page notes.
                Err(_) => args.sampler.sampler(args.steps, generator.sampler(), &[]).map_err(Problem::usage)?,
            };
            generator.check_sampler(&sampler).map_err(model::refused)?;
            self.add_model(name, &generator, &sampler, &mut lengths)?;
            drawn.push(json!({"stage": name, "sampler": sampler}));
        }
        Ok(drawn)
    }

    /// The first model sets the length for all, so that the motions are comparable.
    fn add_model(
        &mut self,
        name: &str,
        generator: &Generator,
        sampler: &Sampler,
        lengths: &mut [Option<usize>],
    ) -> Result<()> {
        let fps = Skeleton::of(generator.format()).fps;
        for (i, request) in self.requests.iter().enumerate() {
            is_known(generator, name, &request.caption)?;
            for (k, seed) in self.seeds.iter().enumerate() {
                let row = i * self.seeds.len() + k;
                let frames = match (request.length, lengths[row]) {
                    (Some(length), _) => length.frames(fps),
                    (None, Some(frames)) => frames,
                    (None, None) => generator.frames(&request.caption, Seed(*seed)).map_err(model::refused)?,
                };
                lengths[row] = Some(frames);
                let motion = generator.generate(&request.caption, Some(frames), Some(sampler), Seed(*seed));
                let motion = motion.map_err(model::refused)?;
                let note = format!("{sampler}, {:.0} ms", motion.timing.total().as_secs_f64() * 1e3);
                self.rows[row].push(exported(name, note, motion, Vec::new()));
            }
        }
        Ok(())
    }

    fn titles(&self) -> Vec<String> {
        let titles = self.requests.iter().flat_map(|request| {
            self.seeds.iter().map(move |seed| match self.seeds.len() {
                1 => request.caption.clone(),
                _ => format!("{} (seed {seed})", request.caption),
            })
        });
        titles.collect()
    }
}

/// Finds for each sentence the training clip with the nearest caption; two sentences have different clips.
fn real_clips(dataset: &Dataset, requests: &[Request]) -> Vec<Option<Motion>> {
    let plain = |text: &str| text.trim().trim_end_matches('.').to_lowercase();
    let train = dataset.entries_of(protocol::stage::Split::Train);
    let captions = || {
        let of = |entry: usize| dataset.entries[entry].captions.iter().map(move |caption| (entry, *caption));
        train.iter().copied().flat_map(of).map(|(entry, caption)| (entry, dataset.captions[caption].text.as_str()))
    };
    let vocabulary = Vocabulary::of(captions().map(|(_, text)| text));
    let mut taken = BTreeSet::new();
    let mut nearest = |request: &Request| {
        let (entry, text) = vocabulary.nearest(&request.caption, NEAREST).into_iter().find_map(|sentence| {
            captions().find(|(entry, text)| plain(text) == sentence && !taken.contains(&dataset.entries[*entry].clip))
        })?;
        let entry = &dataset.entries[entry];
        taken.insert(entry.clip);
        let (skeleton, features) = (dataset.skeleton(), dataset.features(entry).to_vec());
        Some(Motion {
            caption: "real clip".to_owned(),
            note: format!("{}: {text}", entry.id),
            skeleton,
            joints: recover_joints(&features, skeleton),
            features: Some(features),
            waypoints: Vec::new(),
            kept: Vec::new(),
        })
    };
    requests.iter().map(&mut nearest).collect()
}

/// Nearest captions among which a real clip is looked for.
const NEAREST: usize = 8;
