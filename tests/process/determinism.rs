//! Promises 1 and 4: a stage's value hangs neither on the number of workers nor on who died when.

use std::sync::OnceLock;

use cluster_tests::{Bench, Running, digests, signal, states, wait_for};
use nix::sys::signal::Signal;
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
const CONFIG: &str = "smoke.yaml";
/// Long enough that a kill lands inside each training stage.
const LONGER: [&str; 8] = [
    "--set",
    "stages.vae.steps=300",
    "--set",
    "stages.mld.steps=500",
    "--set",
    "stages.lcm.steps=300",
    "--set",
    "stages.pcm.steps=200",
];
/// The stages that train, in order.
const TRAINING: [&str; 4] = ["vae", "mld", "lcm", "pcm"];

/// The undisturbed run of one worker that all others are compared with.
fn reference() -> &'static Value {
    static REFERENCE: OnceLock<Value> = OnceLock::new();
    REFERENCE.get_or_init(|| longer(&Bench::new(TRAINER), "1"))
}

fn longer(bench: &Bench, workers: &str) -> Value {
    bench.pipeline(CONFIG, &[&["--workers", workers][..], &LONGER[..]].concat())
}

fn start(bench: &Bench, workers: &str) -> Running {
    let config = Bench::config(CONFIG);
    bench.spawn(&[&["run", &config, "-o", "json", "--workers", workers][..], &LONGER[..]].concat())
}

/// Waits until `stage` has applied `step` updates; false when it is done already.
fn reaches(bench: &Bench, stage: &str, step: u64) -> bool {
    wait_for(&format!("stage {stage} to reach step {step}"), || {
        let said = bench.run(&["status", "-o", "json"]);
        let runs: Value = serde_json::from_str(&said.stdout).ok()?;
        let view = runs.as_array().map_or(&runs, |all| all.first().unwrap_or(&Value::Null));
        let found = view["stages"].as_array()?.iter().find(|s| s["name"] == stage)?;
        match found["state"].as_str()? {
            "running" if found["progress"]["done"].as_u64()? >= step => Some(true),
            "ran" | "resumed" | "cached" => Some(false),
            "failed" => panic!("stage {stage} failed: {}", found["message"]),
            _ => None,
        }
    })
}

#[test]
fn p6_the_digests_are_the_same_with_1_2_and_3_workers() {
    for workers in ["2", "3"] {
        let report = longer(&Bench::new(TRAINER), workers);
        assert_eq!(digests(&report), digests(reference()), "{workers} workers against 1");
    }
}

#[test]
fn p12_a_second_run_is_cached_and_fast() {
    let bench = Bench::new(TRAINER);
    let first = bench.pipeline(CONFIG, &["--workers", "2"]);
    let config = Bench::config(CONFIG);
    let again = bench.run(&["run", &config, "-o", "json"]).expect_code(0);
    let report = again.json();
    for (stage, state) in states(&report) {
        assert_eq!(state, "cached", "stage {stage}");
    }
    assert_eq!(digests(&report), digests(&first));
    assert!(again.took.as_secs_f64() < 2.0, "a cached run took {:?}", again.took);
}

#[test]
fn p5_the_trainer_is_killed_in_every_training_stage() {
    let bench = Bench::new(TRAINER);
    let mut killed = 0;
    for stage in TRAINING {
        let mut running = start(&bench, "2");
        if reaches(&bench, stage, 30) {
            running.kill();
            killed += 1;
        }
        running.wait();
    }
    assert!(killed >= 3, "the kills must land inside stages; only {killed} did");
    let report = longer(&bench, "2");
    assert_eq!(digests(&report), digests(reference()));
}

#[test]
fn p4_a_worker_is_killed_in_every_training_stage() {
    let bench = Bench::new(TRAINER);
    let running = start(&bench, "2");
    let mut killed = 0;
    for stage in TRAINING {
        if reaches(&bench, stage, 30) {
            let workers = running.workers();
            if let Some(pid) = workers.values().nth(killed % workers.len().max(1)) {
                signal(*pid, Signal::SIGKILL);
                killed += 1;
            }
        }
    }
    assert!(killed >= 3, "the kills must land inside stages; only {killed} did");
    let report = running.wait().expect_code(0).json();
    assert_eq!(digests(&report), digests(reference()));
}

#[test]
fn an_interrupt_saves_and_the_same_command_goes_on() {
    let bench = Bench::new(TRAINER);
    let running = start(&bench, "2");
    assert!(reaches(&bench, "mld", 30), "the interrupt must land inside the stage");
    running.signal(Signal::SIGINT);
    let said = running.wait().expect_code(130);
    assert!(said.stderr.contains("trainer run"), "it should say how to go on:\n{}", said.stderr);
    let report = longer(&bench, "1");
    assert_eq!(states(&report)["mld"], "resumed");
    assert_eq!(digests(&report), digests(reference()));
}
