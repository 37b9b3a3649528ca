//! Instructions per training step, counted by callgrind at toy sizes and compared with `instructions.txt`.
//!
//! The trainings run twice, with different numbers of steps; the difference holds no start-up. A count above the table by
//! more than [`MOST`] fails. A change that is worth it writes the table, with its reason:
//! `UPDATE_COUNTS="reason" cargo test -p stages --test instructions`.
//!
//! Counts are of the dev profile, one thread and the AVX2 kernels, because valgrind hides AVX-512. They depend on the
//! compiler and on the sizes of caches, so the table names them. Not its job: speed, which `cargo bench -p models` measures.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

use burn::tensor::Device;
use protocol::stage::{
    Batch, DataSynthetic, Decay, DistillLcm, DistillPcm, Distillation, EncodeLatents, LatentShape, Network, Optimizer,
    Replicas, Shape, StageSettings, TextEmbed, TrainMld, TrainVae, Training, VaeLoss, Windows,
};
use protocol::{Digest, Steps};
use stage_lab::Bench;

/// The largest growth that passes.
const MOST: f64 = 0.03;
/// Step counts of the two runs: whole pools of batches that are sorted by length.
const RUNS: [u64; 2] = [4, 8];
/// The number of steps, in the environment of a counted process.
const STEPS: &str = "STRIDE_COUNTED_STEPS";
const TABLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/instructions.txt");

/// Name, settings and inputs (field, stage).
type Link = (&'static str, StageSettings, Vec<(&'static str, &'static str)>);

fn training(steps: u64) -> Training {
    Training {
        steps: Steps(steps),
        batch: Batch { global: 4, slices: 2 },
        lr: 1e-3,
        warmup: Steps(2),
        decay: Decay::Cosine,
        optimizer: Optimizer::default(),
        max_grad_norm: 1.0,
        sync: Replicas::default(),
        stop: None,
    }
}

/// The quickstart's networks with a third of their width, and stages that these need.
fn chain(steps: u64) -> Vec<Link> {
    let network =
        |layers| Network { width: 32, layers, heads: 2, feed_forward: 64, dropout: 0.0, ..Network::default() };
    let vae = |until: f64| {
        let windows = Windows { min: 20, max: 32, until, ..Windows::default() };
        let loss = VaeLoss { feet: 3.0, joint: 1.0, ..VaeLoss::default() };
        let latent = LatentShape { tokens: 4, dim: 16 };
        let vae =
            TrainVae { latent, network: network(1), windows, loss, training: training(steps), ..TrainVae::default() };
        StageSettings::TrainVae(vae)
    };
    let mld = TrainMld { network: network(3), training: training(steps), ..TrainMld::default() };
    let distillation =
        || Distillation { training: training(steps), guidance: (0.5, 5.0), ..DistillLcm::default().distillation };
    let lcm = DistillLcm { distillation: distillation() };
    let pcm = DistillPcm { phases: 1, adversarial: 0.1, distillation: distillation(), ..DistillPcm::default() };
    let dataset = vec![("dataset", "dataset")];
    let teacher = vec![("teacher", "mld"), ("latents", "latents"), ("text", "text")];
    vec![
        ("dataset", StageSettings::DataSynthetic(DataSynthetic { clips: 24, ..DataSynthetic::default() }), vec![]),
        ("text", StageSettings::TextEmbed(TextEmbed::default()), dataset.clone()),
        ("windows", vae(1.0), dataset.clone()),
        ("clips", vae(0.0), dataset),
        (
            "latents",
            StageSettings::EncodeLatents(EncodeLatents { crops: 1, shards: 1, ..EncodeLatents::default() }),
            vec![("dataset", "dataset"), ("vae", "clips")],
        ),
        ("mld", StageSettings::TrainMld(mld), vec![("vae", "clips"), ("latents", "latents"), ("text", "text")]),
        ("lcm", StageSettings::DistillLcm(lcm), teacher.clone()),
        ("pcm", StageSettings::DistillPcm(pcm), teacher),
    ]
}

/// Callgrind writes its counts when this is called.
#[inline(never)]
fn a_counted_stage_begins(name: &str) {
    std::hint::black_box(name);
}

/// The body of a counted process.
#[test]
#[ignore = "it runs under callgrind, started by the test below"]
fn counted() {
    let steps = std::env::var(STEPS).expect("the number of steps").parse().expect("a number");
    let mut bench = Bench::new(Device::flex(), 7, 1);
    let mut outputs: BTreeMap<&str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain(steps) {
        a_counted_stage_begins(name);
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|error| panic!("{name}: {error}"));
        outputs.insert(name, ran.output());
    }
    a_counted_stage_begins("");
}

/// The instructions of every stage of one counted process.
fn count(folder: &Path, steps: u64) -> Vec<u64> {
    let out = folder.join(format!("steps-{steps}"));
    let status = Command::new("valgrind")
        .args(["--tool=callgrind", "--quiet", "--dump-before=*a_counted_stage_begins*"])
        .arg(format!("--callgrind-out-file={}", out.display()))
        .arg(std::env::current_exe().expect("this program"))
        .args(["--exact", "counted", "--ignored", "--test-threads=1"])
        .env(STEPS, steps.to_string())
        .env("RAYON_NUM_THREADS", "1")
        .output()
        .expect("valgrind runs");
    assert!(status.status.success(), "the counted process: {}", String::from_utf8_lossy(&status.stderr));
    // The first dump holds what came before the first stage, dump 2 the first stage.
    let dump = |number: usize| {
        let path = format!("{}.{number}", out.display());
        let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
        let total = text.lines().find_map(|line| line.strip_prefix("totals: "));
        total.and_then(|total| total.trim().parse().ok()).unwrap_or_else(|| panic!("no total in {path}"))
    };
    (0..chain(steps).len()).map(|stage| dump(stage + 2)).collect()
}

/// The output of a program, without the newline.
fn says(program: &str, argument: &str) -> Option<String> {
    let output = Command::new(program).arg(argument).output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Sizes of the caches, by which matrix products are cut into blocks.
fn caches() -> String {
    let size = |index| std::fs::read_to_string(format!("/sys/devices/system/cpu/cpu0/cache/index{index}/size"));
    let sizes: Vec<String> = (0..4).map(|index| size(index).unwrap_or_default().trim().to_owned()).collect();
    sizes.join(" ")
}

#[test]
fn a_step_takes_no_more_instructions_than_the_table_says() {
    let Some(valgrind) = says("valgrind", "--version") else {
        assert!(std::env::var_os("CI").is_none(), "valgrind is not installed; `apt-get install valgrind`");
        return fixtures::skip("valgrind is not installed");
    };
    if models::instruction_set() != "avx512" && models::instruction_set() != "avx2" {
        return fixtures::skip("the table is for processors with AVX2");
    }
    let rustc = says("rustc", "--version").expect("the compiler that built this test");
    let tools = format!("{rustc}, {valgrind}, caches of {}", caches());
    let table = std::fs::read_to_string(TABLE).unwrap_or_default();
    let reason = std::env::var("UPDATE_COUNTS").ok();
    assert!(reason.as_deref() != Some(""), "UPDATE_COUNTS is the reason of the change");
    let known = table.lines().next().and_then(|line| line.strip_prefix("# ")).unwrap_or_default();
    if reason.is_none() && known != tools {
        return fixtures::skip(&format!("the table was made by {known}, and here is {tools}"));
    }

    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let [few, many] = std::thread::scope(|scope| {
        RUNS.map(|steps| scope.spawn(move || count(path, steps))).map(|run| run.join().expect("a counted run"))
    });
    let steps = RUNS[1] - RUNS[0];
    let mut written = format!("# {tools}\n# training, instructions per step, reason of the last change\n");
    let mut worse = Vec::new();
    for ((name, settings, _), (few, many)) in chain(0).iter().zip(few.iter().zip(&many)) {
        if settings.shape() != Shape::Gang {
            continue;
        }
        let found = (many - few) / steps;
        let line = table.lines().find_map(|line| line.strip_prefix(&format!("{name}, ")));
        let (old, old_reason) = line.and_then(|line| line.split_once(", ")).unwrap_or(("0", ""));
        let old: u64 = old.parse().expect("a count in the table");
        let change = found as f64 / old as f64 - 1.0;
        eprintln!("{name}: {found} instructions per step ({:+.1} %)", 100.0 * change);
        if change > MOST {
            worse.push(format!("{name} {:+.1} %", 100.0 * change));
        }
        let changed = change.abs() > MOST;
        let reason = reason.as_deref().filter(|_| changed).unwrap_or(old_reason);
        writeln!(written, "{name}, {found}, {reason}").expect("a string");
    }
    if reason.is_some() {
        std::fs::write(TABLE, written).expect("the table");
    } else {
        assert!(worse.is_empty(), "more instructions per step than in {TABLE}: {}", worse.join(", "));
    }
}
