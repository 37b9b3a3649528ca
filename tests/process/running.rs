//! Messages of a run when its output is a file; display and continuation of an interrupted run.

use std::fs;

use cluster_tests::{Bench, Running, wait_for};
use nix::sys::signal::Signal;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Ends a run as Ctrl-C does, once its training has saved a checkpoint.
fn interrupt(bench: &Bench, mut running: Running) -> cluster_tests::Said {
    wait_for("a checkpoint", || {
        assert!(running.alive(), "the run goes on");
        let said = bench.run(&["status", "-o", "json"]);
        let said = if said.code == Some(0) { said.json() } else { return None };
        let vae = said["stages"].as_array()?.iter().find(|stage| stage["name"] == "vae")?.clone();
        (vae["metrics"]["loss"].is_number() && vae["wall_s"].as_f64() > Some(0.5)).then_some(())
    });
    running.signal(Signal::SIGINT);
    running.wait().expect_code(130)
}

fn runs(bench: &Bench) -> Vec<String> {
    let said = bench.run(&["status", "--all", "-o", "json"]).expect_code(0).json();
    let names =
        said["runs"].as_array().expect("runs").iter().map(|run| run["run"].as_str().expect("a name").to_owned());
    names.collect()
}

#[test]
fn an_interrupted_run_says_where_and_the_same_command_continues_it() {
    let bench = Bench::new(TRAINER);
    let config = Bench::config("smoke.yaml");
    let command = ["run", &config, "--until", "vae", "--workers", "1", "--set", "stages.vae.steps=20000"];
    let said = interrupt(&bench, bench.spawn(&command));
    assert!(said.stdout.contains("interrupted at ") && said.stdout.contains(" of 20,000 steps"), "{}", said.stdout);
    for text in [&said.stdout, &said.stderr] {
        for part in ["paused", "skipped", "not asked for", "waits for", "\u{1b}", "sqlx"] {
            assert!(!text.contains(part), "`{part}` in\n{text}");
        }
    }
    assert!(!said.stdout.contains("train.mld"), "what was not asked for has no row: {}", said.stdout);
    let first = runs(&bench);
    let status = bench.run(&["status"]).expect_code(0).stdout;
    assert!(status.contains(&format!("run {}: interrupted", first[0])), "{status}");
    assert!(status.contains(" of 20,000 steps"), "{status}");

    let said = interrupt(&bench, bench.spawn(&command));
    assert!(said.stderr.contains("continues at "), "{}", said.stderr);
    assert_eq!(runs(&bench), first, "it is the same run");
    // The default is the newest run.
    let ended = bench.run(&["cancel"]).expect_code(0).stdout;
    assert!(ended.contains(&format!("run {}: cancelled", first[0])), "{ended}");
}

#[test]
fn finished_stages_are_whole_in_every_report() {
    let bench = Bench::new(TRAINER);
    let said = bench.run(&["run", &Bench::config("smoke.yaml"), "--workers", "1"]).expect_code(0);
    no_worker_is_left(&bench);
    let status = bench.run(&["status"]).expect_code(0).stdout;
    let again = bench.run(&["run", &Bench::config("smoke.yaml"), "--workers", "1"]).expect_code(0).stdout;
    for (stage, done) in [("vae", "12/12"), ("latents", "3/3"), ("mld", "16/16"), ("pcm", "12/12"), ("t2m_pcm", "3/3")]
    {
        for table in [&said.stdout, &status, &again] {
            let row = table.lines().find(|line| line.split_whitespace().next() == Some(stage)).expect("a row");
            assert!(row.split_whitespace().any(|cell| cell == done), "`{done}` is missing in\n{row}");
        }
    }
    assert!(!said.stderr.contains('\u{1b}') && !said.stderr.contains(" 0/"), "{}", said.stderr);
    let lines = said.stderr.lines().filter(|line| line.trim_start().starts_with("vae ")).count();
    assert!(lines <= 4, "begun, done, and twice why the loss jumps: {}", said.stderr);
    let board = bench.run(&["registry", "leaderboard", "smoke"]).expect_code(0).stdout;
    assert!(board.contains("smoke:1") && !board.contains("[MotionPCM]"), "the clips are procedural:\n{board}");
}

/// Checks what a server that takes over the store says of the workers of an ended run.
fn no_worker_is_left(bench: &Bench) {
    let _server = bench.spawn(&["serve", "--bind", "127.0.0.1:0"]);
    let workers = wait_for("the server", || {
        let said = bench.run(&["worker", "list", "-o", "json"]);
        if said.code != Some(0) {
            return None;
        }
        said.json().as_array().filter(|workers| !workers.is_empty()).cloned()
    });
    assert!(workers.iter().all(|worker| worker["state"] == "gone"), "{workers:?}");
}

#[test]
fn a_run_for_programs_keeps_its_pictures_as_well() {
    let bench = Bench::new(TRAINER);
    bench.run(&["data", "sample", "--format", "bvh", "recordings", "--clips", "8"]).expect_code(0);
    let config = Bench::config("mocap.yaml");
    let set = "stages.dataset.path=recordings";
    let command = ["run", &config, "--set", set, "--until", "dataset", "--workers", "1", "-o", "json"];
    let run = bench.run(&command).expect_code(0).json()["run"].as_str().expect("a run").to_owned();
    let pictures = fs::read_dir(bench.store().join("pictures").join(run)).expect("pictures");
    assert!(pictures.count() > 0, "the sheet of the recordings");
}
