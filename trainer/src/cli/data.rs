//! `trainer data`: inspects recordings and names their motions, writes sample recordings, fetches published ones and
//! brings data to a server.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use mocap::arrays;
use mocap::bvh::Bvh;
use mocap::captions;
use mocap::detect::Up;
use mocap::joint_map::JointMap;
use mocap::take::{self, Reading};
use motion::DataPath;
use protocol::Seed;
use serde_json::json;

use super::datasets::{self, FetchArgs, ListArgs};
use super::push::{self, PushArgs};
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

#[derive(Debug, Subcommand)]
pub(crate) enum DataVerb {
    /// Shows what a recording (.bvh, .npy, .npz) contains and how it would be read, and proposes a joint map
    #[command(after_help = "Example:\n  trainer data inspect recordings/000000.bvh")]
    Inspect(InspectArgs),
    /// Writes synthetic clips as recordings with their captions
    #[command(after_help = "Example:\n  trainer data sample recordings --format bvh --clips 4")]
    Sample(SampleArgs),
    /// Writes a table of captions for recordings without one, by their file names, to correct
    #[command(after_help = "Example:\n  trainer data captions recordings")]
    Captions(CaptionsArgs),
    /// Lists published sets of motion
    #[command(after_help = "Example:\n  trainer data list")]
    List(ListArgs),
    /// Fetches a published set, checks every file, and adds captions and splits; run it again to continue
    #[command(after_help = "Example:\n  trainer data fetch bandai --accept-licence")]
    Fetch(FetchArgs),
    /// Computes the stages of a pipeline that read files, on this machine, for a server whose workers do not have the files
    #[command(after_help = "Example:\n  trainer data push configs/bandai.yaml --server https://stride:7700")]
    Push(Box<PushArgs>),
}

impl DataVerb {
    pub(super) fn output(&self) -> Output {
        match self {
            Self::Inspect(args) => args.output,
            Self::Sample(_) | Self::Captions(_) => Output::Table,
            Self::List(args) => args.output,
            Self::Fetch(args) => args.output,
            Self::Push(args) => args.output,
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct InspectArgs {
    /// The recording
    file: PathBuf,
    /// A joint map to try: the name of a shipped one, or a YAML file
    #[arg(long, value_name = "MAP")]
    map: Option<String>,
    /// Format of the answer; as a table, the map is YAML on stdout and the rest is on stderr
    #[arg(short, long, value_enum, default_value_t)]
    output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct CaptionsArgs {
    /// The folder of recordings
    folder: PathBuf,
    /// The table to write [default: captions.csv in the folder]
    #[arg(short = 'o', long = "out", value_name = "FILE.csv")]
    out: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct SampleArgs {
    /// The folder to write to, which must be empty or not exist
    folder: PathBuf,
    /// The format of the files
    #[arg(long, value_enum)]
    format: SampleFormat,
    /// Number of clips
    #[arg(long, default_value_t = 30, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    clips: u32,
    /// Seed of the clips; another number gives other clips
    #[arg(long, default_value_t = 7, value_name = "N")]
    seed: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SampleFormat {
    /// Skeletons and their rotations, in centimetres
    Bvh,
}

pub(crate) async fn data(verb: DataVerb) -> Result<u8> {
    match verb {
        DataVerb::Inspect(args) => inspect(&args),
        DataVerb::Captions(args) => write_captions(&args),
        DataVerb::Sample(args) => sample(&args),
        DataVerb::List(args) => Ok(datasets::list(&args)),
        DataVerb::Fetch(args) => datasets::fetch(&args),
        DataVerb::Push(args) => push::push(*args).await,
    }
}

fn inspect(args: &InspectArgs) -> Result<u8> {
    if !args.file.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("bvh")) {
        return inspect_array(&args.file, args.output);
    }
    let bvh = Bvh::read(&DataPath::local(&args.file)).map_err(Problem::usage)?;
    let map = args.map.as_deref().map(JointMap::load).transpose().map_err(Problem::usage)?;
    let seconds = bvh.frames as f64 / bvh.rate;
    let joints = bvh.nodes.iter().filter(|node| !node.end).count();
    let size = format!("{joints} joints, {} frames at {} fps ({seconds:.1} s)", bvh.frames, bvh.rate);
    let how = take::read(&bvh, &Reading { map, ..Reading::default() }).map_err(|error| {
        let names: Vec<&str> = bvh.nodes.iter().filter(|node| !node.end).map(|node| node.name.as_str()).collect();
        Problem::usage(format!("{}: {size}; {error}", args.file.display())).hint(format!(
            "the file has the joints {}; a joint map has the form that `trainer data inspect` prints for another file",
            names.join(", ")
        ))
    })?;
    if args.output == Output::Json {
        let sources = serde_json::to_value(&how.map.joints).map_err(Problem::failed)?;
        print::json(&json!({
            "file": args.file, "joints": joints, "frames": bvh.frames, "fps": bvh.rate, "seconds": seconds,
            "unit": how.detected.unit, "metres_per_unit": how.metres_per_unit, "up": how.up.to_string(),
            "sure_of_up": how.detected.sure_of_up, "shipped_map": how.shipped, "map": sources,
        }));
        return Ok(0);
    }
    print::note(&format!("{}: {size}", args.file.display()));
    print::note(&how.to_string());
    if how.shipped.is_some() {
        print::note("files with these joint names use this map by default");
    } else {
        print::note("save the map as a .yaml file and set `map` of data.features to it");
    }
    print::out(how.map.to_yaml().trim_end());
    Ok(0)
}

fn inspect_array(file: &Path, output: Output) -> Result<u8> {
    let joints = arrays::read(&DataPath::local(file)).map_err(Problem::usage)?;
    let frames = joints.data.len() / (3 * joints.joints);
    if output == Output::Json {
        print::json(&json!({"file": file, "joints": joints.joints, "frames": frames, "fps": joints.rate}));
        return Ok(0);
    }
    let rate = joints.rate.map_or("the frame rate is not in the file".to_owned(), |rate| format!("at {rate} fps"));
    print::out(&format!("{}: {frames} frames of {} joints, {rate}", file.display(), joints.joints));
    if joints.joints == 22 {
        let points: Vec<[f64; 3]> = joints.data.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect();
        let found = mocap::detect::detect(points.chunks_exact(22).take(200));
        let up = if found.sure_of_up { found.up } else { Up::Y };
        let guess = if found.sure_of_up { "" } else { " (a guess: the figure does not stand upright)" };
        print::out(&format!("unit {} (legs of {:.2}), {up} up{guess}", found.unit, found.leg));
    }
    Ok(0)
}

/// Writes a table with a row for each recording that has no caption.
fn write_captions(args: &CaptionsArgs) -> Result<u8> {
    let listing = mocap::listing::list(&DataPath::local(&args.folder), None).map_err(Problem::usage)?;
    let path = args.out.clone().unwrap_or_else(|| args.folder.join("captions.csv"));
    let bare: Vec<(String, String)> = listing
        .clips
        .iter()
        .filter(|clip| clip.captions.is_empty())
        .map(|clip| {
            let stem = clip.path.shown().file_stem().unwrap_or_default().to_string_lossy();
            (clip.id.clone(), captions::from_name(&stem))
        })
        .collect();
    if bare.is_empty() {
        let count = listing.clips.len();
        print::out(&format!("{}: each of the {count} recordings has a caption", args.folder.display()));
        return Ok(0);
    }
    let mut file = std::fs::File::create_new(&path).map_err(|error| {
        let problem = Problem::usage(format!("cannot write `{}`: {error}", path.display()));
        problem.hint("a table of captions is never replaced; write another one with `-o FILE.csv` and join them")
    })?;
    std::io::Write::write_all(&mut file, captions::to_table(&bare).as_bytes())
        .map_err(|error| Problem::failed(format!("cannot write `{}`: {error}", path.display())))?;
    let empty = bare.iter().filter(|(_, caption)| caption.is_empty()).count();
    print::out(&format!(
        "{}: {} of {} recordings had no caption; {} have one from their file name, {empty} are empty\nCorrect the \
         sentences, as in `a person walks forward`. A row without a sentence is refused.",
        path.display(),
        bare.len(),
        listing.clips.len(),
        bare.len() - empty
    ));
    Ok(0)
}

fn sample(args: &SampleArgs) -> Result<u8> {
    let SampleFormat::Bvh = args.format;
    let taken = std::fs::read_dir(&args.folder).is_ok_and(|mut entries| entries.next().is_some());
    if taken {
        return Err(Problem::usage(format!("{}: the folder is not empty; choose another one", args.folder.display())));
    }
    let worst = mocap::sample::write_bvh_folder(&args.folder, args.clips as usize, Seed(args.seed))
        .map_err(|error| Problem::failed(format!("{}: {error}", args.folder.display())))?;
    print::out(&format!(
        "{}: {} clips as BVH, with captions as TXT; joints differ from the clips' by at most {:.2} mm",
        args.folder.display(),
        args.clips,
        1000.0 * worst
    ));
    Ok(0)
}
