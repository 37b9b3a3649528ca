//! Cost estimates of a plan: the entries of its datasets, and the time of each stage, measured on this machine.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use motion::DataPath;
use pipeline::Pipeline;
use protocol::StageName;
use protocol::stage::{DataFeatures, DataFold, DataFormat, DataOpen, DataSynthetic};
use stages::run::estimate::{Entries, Estimate, estimate};

/// Time limit of all trial runs; the stage that reaches it is the last.
const BUDGET: Duration = Duration::from_secs(30);

/// Estimates each stage that can be tried.
pub(crate) fn estimates(pipeline: &Pipeline) -> BTreeMap<StageName, Estimate> {
    let Ok(device) = models::device::open(pipeline.backend, 0) else { return BTreeMap::new() };
    let mut entries: BTreeMap<StageName, Entries> = BTreeMap::new();
    for stage in &pipeline.stages {
        let settings = &stage.settings;
        let open = settings.get::<DataOpen>().map(listed);
        let made = || settings.get::<DataSynthetic>().map(synthetic);
        let recorded = || settings.get::<DataFeatures>().map(recorded);
        let fold = || settings.get::<DataFold>().and_then(|fold| folded(fold, &entries));
        if let Some(found) = open.or_else(made).or_else(recorded).or_else(fold) {
            entries.insert(stage.name.clone(), found);
        }
    }
    let pipeline = pipeline.clone();
    // Computes as a worker does: one thread, with a stack for deep graphs.
    let thread = std::thread::Builder::new().name("estimate".to_owned()).stack_size(64 << 20);
    let tried = thread.spawn(move || {
        worker::process::compute_here();
        estimate(&pipeline, &entries, &device, BUDGET)
    });
    // Without a thread, or if a stage panics on synthetic clips, the plan has no estimate.
    tried.map(|tried| tried.join().unwrap_or_default()).unwrap_or_default()
}

/// Counts the clips of a folder's lists; those of the published dataset if the folder does not exist.
fn listed(data: &DataOpen) -> Entries {
    let (train, val, test) = match data.format {
        DataFormat::Humanml3d => (23_384, 1_460, 4_384),
        DataFormat::Kit => (4_888, 300, 830),
    };
    let count = |name: &str, published: usize| {
        let list = std::fs::read_to_string(Path::new(&data.path).join(name));
        list.map_or(published, |list| list.lines().filter(|line| !line.trim().is_empty()).count())
    };
    Entries { train: count("train.txt", train), val: count("val.txt", val), test: count("test.txt", test) }
}

fn synthetic(data: &DataSynthetic) -> Entries {
    divided(data.clips, data.mirror, data.val, data.test)
}

/// Counts the recordings of a folder; a hundred if the folder does not exist.
fn recorded(data: &DataFeatures) -> Entries {
    let files = mocap::listing::list(&DataPath::local(&data.path), None).map_or(100, |listing| listing.clips.len());
    divided(files, data.mirror, data.val, data.test)
}

fn folded(data: &DataFold, entries: &BTreeMap<StageName, Entries>) -> Option<Entries> {
    let of = entries.get(&StageName::new(&*data.dataset))?;
    let all = of.train + of.val;
    let val = all / data.folds.max(1);
    Some(Entries { train: all - val, val, test: of.test })
}

fn divided(clips: usize, mirror: bool, val: f64, test: f64) -> Entries {
    let clips = (clips * if mirror { 2 } else { 1 }) as f64;
    let share = |share: f64| (clips * share).round() as usize;
    Entries { train: share(1.0 - val - test), val: share(val), test: share(test) }
}
