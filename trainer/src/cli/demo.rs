//! `trainer demo`: a teacher and its one-step student, which come with the program, draw the same sentences. Options serve
//! a page on which they draw, or repeat their training.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use checkpoint::model::extend;
use clap::Args;
use coordinator::{Config, Coordinator};
use mocap::export::{Motion, gif_of_all, write_all};
use protocol::stage::Backend;
use protocol::{Manifest, Seed};
use registry::bundle::{FORMAT, Head};
use registry::cli::{Command, Data};
use registry::{Holder, Store};
use serde_json::json;
use stages::generate::Generator;
use tokio::signal::unix::{SignalKind, signal};

use super::generate::exported;
use super::model::{self, CAPTIONS, Found};
use super::{out, unknown_words};
use crate::client::{self, Target};
use crate::local::fleet::{Crew, Fleet};
use crate::local::pack::{Pack, Packed};
use crate::local::{pipeline_file, run};
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};

/// The teacher and the student of the quickstart: `trainer demo --pack` makes the file.
const MODELS: &[u8] = include_bytes!("../../demo/models.pack");
/// The pipeline that trains them.
const QUICKSTART: &str = include_str!("../../../configs/quickstart.yaml");
/// Names of the two models in the demo's store, in the order of the file.
const NAMES: [&str; 2] = ["demo-teacher", "demo-student"];
/// The quickstart's teacher, the evaluation that says how it is sampled, and the alias of its best student.
const TEACHER: &str = "mld";
const TEACHER_MEASURED: &str = "fid_teacher";
const STUDENT: &str = "quickstart@staging";
/// Default sentences, each a movement that can be told from the others in a still picture.
const SENTENCES: [&str; 6] = [
    "a person walks forward",
    "a person jumps up",
    "a person kicks with the right leg",
    "a person waves with the left hand",
    "a person sits down",
    "a person raises both arms",
];
/// Checkpoints of the quickstart that its page shows as thumbnails.
const THUMBNAILS: [&str; 3] = [
    "stages.mld.checkpoint={every: 800, keep: {latest: 10, ended: 10}}",
    "stages.lcm.checkpoint={every: 250, keep: {latest: 10, ended: 10}}",
    "stages.pcm.checkpoint={every: 325, keep: {latest: 10, ended: 10}}",
];
/// Interval at which the page's worker is checked.
const BEAT: Duration = Duration::from_millis(200);

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  trainer demo
  trainer demo \"a person walks like a zombie\" \"a person claps\"
  trainer demo --ui
  trainer demo --train

The models are those of configs/quickstart.yaml, trained on procedural clips. These commands make their file:
  trainer run configs/quickstart.yaml --store made
  trainer demo --pack trainer/demo/models.pack --dir made")]
pub(crate) struct DemoArgs {
    /// Sentence to draw, may be repeated [default: six movements]
    #[arg(value_name = "PROMPT")]
    prompts: Vec<String>,
    /// Folder for the pictures and the store; made if it is missing
    #[arg(long, value_name = "DIR", default_value = "stride-demo")]
    dir: PathBuf,
    /// Then serves a page on which the models draw, until Ctrl-C
    #[arg(long, conflicts_with = "train")]
    ui: bool,
    /// Then trains such models, the quickstart, on a page with curves and thumbnails
    #[arg(long)]
    train: bool,
    /// Makes the file of the models from the store in --dir, which ran the quickstart
    #[arg(long, value_name = "FILE", hide = true, conflicts_with_all = ["prompts", "ui", "train"])]
    pack: Option<PathBuf>,
    /// Format of the report
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

pub(crate) async fn demo(args: DemoArgs, command: String) -> Result<u8> {
    if let Some(file) = &args.pack {
        return pack(&args.dir, file).await;
    }
    let start = Instant::now();
    let store = args.dir.join("store");
    if args.dir.exists() && !args.dir.is_dir() {
        let message = format!("`--dir {}` is not a folder", args.dir.display());
        return Err(Problem::usage(message).hint("name a folder, which may be a new one"));
    }
    let written = |error| Problem::usage(format!("cannot write to `{}`: {error}", args.dir.display()));
    std::fs::create_dir_all(&args.dir).map_err(written)?;
    install(&store).await?;
    let files = ["demo.html", "demo.png", "demo.gif"].map(|name| args.dir.join(name));
    // A training that continues leaves its pictures as they are.
    let drawn = args.train && args.prompts.is_empty() && files.iter().all(|file| file.exists());
    if !drawn {
        draw(&args, &store, &files).await?;
        report(args.output, &files, start.elapsed());
    }
    let shown = |path: &Path| client::shown(path);
    if args.train {
        return train(&args, store, command).await;
    }
    if args.ui {
        return serve(&args, &store).await;
    }
    if args.output == Output::Table {
        let dir =
            if args.dir == Path::new("stride-demo") { String::new() } else { format!(" --dir {}", shown(&args.dir)) };
        print::out(&format!(
            "\nNext:\n  trainer generate \"a person claps\" --model {}:1 --store {} -o clap.gif\n  \
             trainer demo --ui{dir}       a page on which both models draw\n  \
             trainer demo --train{dir}    trains such models, and shows how they learn",
            NAMES[1],
            shown(&store)
        ));
    }
    Ok(0)
}

/// Prints which files were drawn.
fn report(output: Output, files: &[PathBuf; 3], took: Duration) {
    let seconds = took.as_secs_f64();
    let shown = |path: &Path| client::shown(path);
    match output {
        Output::Json => print::json(&json!({
            "schema_version": 1,
            "models": NAMES.map(|name| format!("{name}:1")),
            "files": files.iter().map(|file| shown(file)).collect::<Vec<_>>(),
            "seconds": seconds,
        })),
        Output::Table => print::out(&format!(
            "{} shows the motions from all sides; open it in a browser\n{} is a sheet of them\n{} is a moving picture\n\
             teacher (50 steps) above, one-step student below; drawn in {seconds:.1} s",
            shown(&files[0]),
            shown(&files[1]),
            shown(&files[2])
        )),
    }
}

/// Adds the models to the demo's store, once.
async fn install(store: &Path) -> Result<()> {
    let pack = Pack::read(MODELS).map_err(|error| Problem::new(exit::FAULT, error.context("the demo's models")))?;
    let opened = Store::open_with(store, None, Holder::this_process("trainer demo")).await?;
    let bundle = store.join("demo.tar.zst");
    for model in &pack.models {
        pack.write_bundle(model, &bundle)?;
        let added = opened.import_bundle(&bundle, None).await;
        // The store has its files now.
        let _ = std::fs::remove_file(&bundle);
        added.map_err(Problem::failed)?;
    }
    drop(opened);
    Ok(())
}

/// Draws the sentences into the files: a page and a sheet of both models, and a moving picture of the student's motions.
async fn draw(args: &DemoArgs, store: &Path, [page, sheet, film]: &[PathBuf; 3]) -> Result<()> {
    let target = Target { store: store.to_owned(), server: Default::default() };
    let reader = Reader::open(&target).await?;
    let (device, _) = model::device(None)?;
    let given: Vec<&str> = args.prompts.iter().map(String::as_str).collect();
    let sentences = if given.is_empty() { SENTENCES.to_vec() } else { given };
    let mut rows: Vec<Vec<Motion>> = vec![Vec::new(); sentences.len()];
    // The student draws last, so this is its sampler at the end.
    let mut sampler = String::new();
    for (name, role) in NAMES.into_iter().zip(["teacher", "student"]) {
        let Found { manifest, blobs, .. } = model::version(&reader, &format!("{name}:1")).await?;
        let generator = Generator::load(&manifest, &blobs, &device).map_err(Problem::failed)?;
        sampler = generator.sampler().to_string();
        for (sentence, row) in sentences.iter().zip(&mut rows) {
            super::generate::is_known(&generator, role, sentence)?;
            // The student's motion is as long as the teacher's.
            let frames = row.first().map(Motion::frames);
            let motion = generator.generate(sentence, frames, None, Seed(3)).map_err(model::refused)?;
            let note = format!("{sampler}, {:.0} ms", motion.timing.total().as_secs_f64() * 1e3);
            row.push(exported(&format!("{role}: {sentence}"), note, motion, Vec::new()));
        }
    }
    reader.close().await;
    let sections: Vec<(String, Vec<&Motion>)> =
        sentences.iter().zip(&rows).map(|(sentence, row)| ((*sentence).to_owned(), row.iter().collect())).collect();
    for file in [page, sheet] {
        write_all("Teacher beside its one-step student", &sections, file).map_err(out::refused)?;
    }
    let students = sentences.iter().zip(&rows).filter_map(|(sentence, row)| {
        let motion = row.last()?.clone();
        Some(Motion { caption: (*sentence).to_owned(), note: sampler.clone(), ..motion })
    });
    gif_of_all(&students.collect::<Vec<_>>(), film).map_err(out::refused)
}

/// Trains the quickstart in the demo's store.
async fn train(args: &DemoArgs, store: PathBuf, command: String) -> Result<u8> {
    let sets = THUMBNAILS.map(str::to_owned);
    let file = pipeline_file::of_text("quickstart.yaml", QUICKSTART.to_owned(), &sets)?;
    let options = run::Options { store, blobs: None, workers: None, output: args.output, ui: true, command };
    run::run(run::Request::Submit { file: Box::new(file), until: None }, options).await
}

/// Serves the page and one worker until Ctrl-C.
async fn serve(args: &DemoArgs, folder: &Path) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot listen for signals: {error}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let store = Store::open_existing(folder, Holder::this_process("trainer demo")).await?;
    let handle = Coordinator::start(store.clone(), Config::embedded()).await?;
    let announced = client::announce(&store, &handle)?;
    let mut fleet = Fleet::start(&Crew { count: 1, backend: Backend::default(), draws: false }, &handle, folder)?;
    let link = handle.page_link();
    match args.output {
        Output::Json => print::json(&json!({"schema_version": 1, "page": link})),
        Output::Table => print::out(&format!("\npage {link}\nCtrl-C ends it")),
    }
    let outcome = loop {
        tokio::select! {
            _ = interrupt.recv() => break Ok(0),
            _ = terminate.recv() => break Ok(0),
            why = handle.failed() => break Err(Problem::coordinator_failed(why)),
            () = tokio::time::sleep(BEAT) => match fleet.reap(true) {
                Ok(dead) => for death in dead {
                    // One that never joined is unknown and holds no work.
                    let _ = handle.worker_gone(&death.worker).await;
                },
                Err(problem) => break Err(problem),
            },
        }
    };
    fleet.kill(&handle).await;
    drop(announced);
    handle.shutdown().await;
    outcome
}

/// Writes the file of the models from a store whose newest run is the quickstart.
async fn pack(store: &Path, file: &Path) -> Result<u8> {
    let target = Target { store: store.to_owned(), server: Default::default() };
    let reader = Reader::open(&target).await?;
    let run = reader.find("@last").await?;
    let teacher = model::stage(&reader, &run, TEACHER).await?;
    let sampler = teacher.measured.first().map(|(_, sampler)| sampler.clone());
    let manifest = extend(&teacher.manifest, sampler.as_ref(), &Default::default()).map_err(Problem::failed)?;
    let student = model::version(&reader, STUDENT).await?;
    let measured = run.stages.iter().find(|stage| stage.name.as_str() == TEACHER_MEASURED);
    let of_teacher = measured.map(|stage| stage.metrics.clone()).unwrap_or_default();
    let show = Command::Show { reference: STUDENT.to_owned() };
    let Some(Data::Version { version, .. }) = reader.registry(&show).await?.data else {
        return Err(Problem::new(exit::FAULT, anyhow::anyhow!("the registry's answer is no version")));
    };
    let captions = unknown_words::captions(&reader, student.artifact).await?.unwrap_or_default();
    let captions = unknown_words::covering(&captions);
    let models = vec![
        packed(NAMES[0], manifest, of_teacher, &captions)?,
        packed(NAMES[1], student.manifest, version.metrics.clone(), &captions)?,
    ];
    reader.close().await;
    teacher.blobs.add(student.blobs);
    let read = |digest| -> anyhow::Result<Vec<u8>> { Ok(checkpoint::Blobs::get(&teacher.blobs, digest)?.to_vec()) };
    let bytes = Pack::of(models, &read)?.to_bytes()?;
    std::fs::write(file, &bytes)
        .map_err(|error| Problem::failed(format!("cannot write `{}`: {error}", file.display())))?;
    print::out(&format!("{}: {} bytes", file.display(), bytes.len()));
    Ok(0)
}

/// Describes a model for the file.
fn packed(name: &str, manifest: Manifest, metrics: BTreeMap<String, f64>, captions: &[&str]) -> Result<Packed> {
    let head = Head {
        format: FORMAT,
        model: name.parse().map_err(Problem::usage)?,
        version: 1,
        artifact: manifest.digest(),
        metrics: metrics.into_iter().map(|(key, value)| (key, Some(value))).collect(),
        source: json!({"pipeline": "quickstart", "metric": "latent_fid", "mode": "min", CAPTIONS: captions}),
    };
    Ok(Packed { head, manifest })
}
