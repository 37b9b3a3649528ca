//! Every kind that trains, on another backend than the other tests: `STRIDE_TEST_BACKEND`, or ndarray, which every test
//! build has. `tests/gpu.sh` runs this on accelerators.

use std::collections::BTreeSet;
use std::time::Duration;

use cluster_tests::cluster::{Cluster, stage_of};
use cluster_tests::{Bench, PATIENCE, digests, wait_within};
use protocol::stage::StageSettings;
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
/// Relative tolerance of a loss or a gradient norm. Backends sum in other orders, and inputs of a stage were trained on
/// the same backend.
const TOLERANCE: f64 = 1e-4;

fn other() -> String {
    std::env::var("STRIDE_TEST_BACKEND").unwrap_or_else(|_| "ndarray".to_owned())
}

/// Time limit of a run. Software Vulkan compiles and tunes kernels for minutes before a kind's first step. The ndarray
/// backend is not optimised in test builds, and a slow machine needs minutes for it.
fn patience() -> Duration {
    PATIENCE * if std::env::var_os("STRIDE_TEST_BACKEND").is_some() { 24 } else { 3 }
}

fn config() -> std::path::PathBuf {
    Bench::repository().join("tests/process/kinds.yaml")
}

/// Runs every kind with one worker of a backend. Returns the cluster, the run and its view.
fn run(backend: &str, sets: &[&str]) -> (Cluster, String, Value) {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join_by("w1", &[], &["--backend", backend]);
    let choice = format!("backend={backend}");
    let run = cluster.submit(&config(), &[&["--set", &choice][..], sets].concat());
    let view = cluster.wait_end_within(patience(), &run);
    assert_eq!(view["state"], "finished", "on {backend}: {view:#}\n{}", cluster.everything());
    (cluster, run, view)
}

fn kinds(view: &Value) -> Vec<(String, String)> {
    let stages = view["stages"].as_array().expect("stages");
    let text = |value: &Value| value.as_str().expect("a text").to_owned();
    stages.iter().map(|stage| (text(&stage["name"]), text(&stage["kind"]))).collect()
}

/// Sampled: nothing on ndarray, which takes three minutes; everything with `STRIDE_LONG_TESTS=1`.
#[test]
fn every_kind_trains_on_another_backend_as_on_flex() {
    if std::env::var_os("STRIDE_TEST_BACKEND").is_none() && !fixtures::long("every kind of training on ndarray") {
        return;
    }
    // Less than kinds.yaml says, where convolutions take most of the time on ndarray.
    let less = ["stages.stablemofusion.batch.global=3", "stages.stablemofusion.steps=1", "dataset.clips=20"];
    let sets = less.map(|less| ["--set", less]).concat();
    let (flex, run_on_flex, view) = run("flex", &sets);
    let (there, run_there, _) = run(&other(), &sets);
    let mut tried = BTreeSet::new();
    let mut all_off = Vec::new();
    for (stage, kind) in kinds(&view) {
        if flex.metrics(&run_on_flex, &stage).contains_key("gradient_norm") {
            tried.insert(kind);
        }
        all_off.extend(off(&stage, (&there, &run_there), (&flex, &run_on_flex)));
    }
    let trains = |kind: StageSettings| kind.training().is_some().then(|| kind.kind().to_owned());
    let all: BTreeSet<String> = StageSettings::all().into_iter().filter_map(trains).collect();
    assert_eq!(tried, all, "kinds.yaml has every kind that trains");
    all_off.sort_by(|a, b| b.0.total_cmp(&a.0));
    eprintln!("{} values on {}; the furthest off:", all_off.len(), other());
    all_off.iter().take(5).for_each(|(error, what)| eprintln!("  {error:.1e} {what}"));
    assert!(all_off[0].0 < TOLERANCE, "{:?}", all_off[0]);
}

/// Errors of a stage's values on one cluster against another, largest first, each with a description. Errors are
/// relative to the size of the value.
fn off(stage: &str, found: (&Cluster, &str), expected: (&Cluster, &str)) -> Vec<(f64, String)> {
    let (found, expected) = (found.0.metrics(found.1, stage), expected.0.metrics(expected.1, stage));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>(), "{stage}");
    let mut off = Vec::new();
    for (name, points) in &expected {
        assert_eq!(found[name].len(), points.len(), "{stage}: {name}");
        for (found, expected) in found[name].iter().zip(points) {
            let error = (found.1 - expected.1).abs() / expected.1.abs().max(1e-3);
            off.push((error, format!("{stage}: {name} after step {}: {} and {}", expected.0, found.1, expected.1)));
        }
    }
    off.sort_by(|a, b| b.0.total_cmp(&a.0));
    off
}

/// A worker is killed after a checkpoint, and its successor reaches the state of an undisturbed run. On a CPU backend
/// the bits are equal, which keys depend on. An accelerator's backend picks its kernels by timing in each process, so
/// another process rounds differently.
#[test]
fn p5_a_kill_on_another_backend_changes_no_byte() {
    let sets = ["--set", "stages.vae.steps=6", "--until", "vae"];
    let (undisturbed, run_undisturbed, whole) = run(&other(), &sets);
    let mut cluster = Cluster::start(TRAINER);
    let dies = ["env".to_owned(), "STRIDE_WORKER_FAILPOINT=checkpoint::after_commit@3".to_owned()];
    cluster.join_by("w1", &dies, &["--backend", &other()]);
    let choice = format!("backend={}", other());
    let id = cluster.submit(&config(), &[&["--set", &choice][..], &sets].concat());
    wait_within(patience(), "the worker to die", || (!cluster.alive("w1")).then_some(()));
    cluster.join_by("w2", &[], &["--backend", &other()]);
    let view = cluster.wait_end_within(patience(), &id);
    assert!(cluster.said("w2").contains("continues from the checkpoint after step 3"), "{}", cluster.said("w2"));
    let tuned = !["flex", "ndarray"].contains(&other().as_str());
    if tuned {
        let off = off("vae", (&cluster, &id), (&undisturbed, &run_undisturbed));
        eprintln!("after a kill on {}, the furthest off: {:.1e} {}", other(), off[0].0, off[0].1);
        assert!(off[0].0 < TOLERANCE, "{:?}", off[0]);
    } else {
        assert_eq!(digests(&view), digests(&whole));
    }
}

/// The smoke pipeline has an ordinary learning rate, so differences in the last bits grow from step to step. Sampled:
/// its first stage; all stages with `STRIDE_TEST_BACKEND`.
#[test]
fn the_smoke_pipeline_on_another_backend() {
    let last = if std::env::var_os("STRIDE_TEST_BACKEND").is_some() { "release" } else { "vae" };
    let until = ["--until", last];
    let run = |backend: &str| {
        let mut cluster = Cluster::start(TRAINER);
        cluster.join_by("w1", &[], &["--backend", backend]);
        let choice = format!("backend={backend}");
        let config = Bench::repository().join("configs/smoke.yaml");
        let run = cluster.submit(&config, &[&["--set", &choice][..], &until].concat());
        let view = cluster.wait_end_within(patience(), &run);
        assert_eq!(view["state"], "finished", "on {backend}: {view:#}\n{}", cluster.everything());
        (cluster.metrics(&run, "vae"), view)
    };
    let (expected, _) = run("flex");
    let (found, view) = run(&other());
    assert_eq!(stage_of(&view, last)["state"], "ran");
    let (expected, found) = (&expected["loss"], &found["loss"]);
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        let error = (found.1 - expected.1).abs() / expected.1;
        assert!(error < 1e-4, "loss after step {}: {} on {}, {} on flex", found.0, found.1, other(), expected.1);
    }
}
