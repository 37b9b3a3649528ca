//! Commands that only read, on a store without a coordinator: they start no process and change no file.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use cluster_tests::{Bench, Running, wait_for};
use nix::sys::signal::Signal;
use protocol::Digest;
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Each file with its time and digest. Logs of workers are excluded, because workers may outlive a killed trainer.
fn files(dir: &Path) -> BTreeMap<PathBuf, (SystemTime, Digest)> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(dir).expect("a folder").map(|entry| entry.expect("an entry")) {
        let (path, kind) = (entry.path(), entry.file_type().expect("a kind"));
        if kind.is_dir() {
            found.extend(if path.ends_with("workers") { BTreeMap::new() } else { files(&path) });
        } else {
            let changed = entry.metadata().and_then(|metadata| metadata.modified()).expect("a time");
            found.insert(path.clone(), (changed, Digest::of(&fs::read(&path).expect("a file"))));
        }
    }
    found
}

/// Runs every command that reads, and commands that would change something but name a missing object.
fn read_everything(bench: &Bench, finished: &str, interrupted: &str) {
    // SQLite maps its index even to read only the log.
    let state = || {
        let mut all = files(&bench.store());
        all.retain(|path, _| !path.ends_with("stride.db-shm"));
        all
    };
    let (config, before) = (Bench::config("smoke.yaml"), state());
    for (line, code) in [
        ("status", 0),
        ("status --all", 0),
        (&*format!("status {interrupted} -o json"), 0),
        ("logs", 0),
        (&*format!("logs {interrupted} --stage vae --follow"), 0),
        (&*format!("metrics {finished}"), 0),
        (&*format!("metrics {finished} --stage vae --key loss --csv"), 0),
        (&*format!("metrics {finished} --key none"), 7),
        (&*format!("files {finished}"), 0),
        (&*format!("files {finished} --name manifest.json --print"), 7),
        (&*format!("files {finished} --stage vea"), 7),
        ("sweep status", 7),
        ("worker list", 0),
        (&*format!("plan {config}"), 0),
        ("registry list", 0),
        ("registry show smoke@best", 0),
        ("registry history smoke", 0),
        ("registry lineage smoke@best", 0),
        ("registry gc --dry-run --grace 0", 0),
        ("registry fsck", 0),
        (&*format!("time smoke@best --stage mld --run {finished} --sentences 1"), 0),
        (&*format!("submit {config}"), 2),
        ("resume nobody", 7),
        ("pause nobody", 7),
        ("cancel nobody", 7),
    ] {
        bench.run(&line.split(' ').collect::<Vec<_>>()).expect_code(code);
        assert_eq!(state(), before, "`trainer {line}` changed a file");
    }
    bench.run(&["generate", "a person walks", "--model", "smoke@best", "-o", "walk.npy"]).expect_code(0);
    assert_eq!(state(), before, "`trainer generate` changed a file");
}

/// The name of a run, its state and the state of its stage `vae`.
fn state(bench: &Bench, run: &str) -> [String; 3] {
    let view = bench.run(&["status", run, "-o", "json"]).expect_code(0).json();
    let stages = view["stages"].as_array().expect("stages");
    let vae = stages.iter().find(|stage| stage["name"] == "vae").expect("a stage `vae`");
    [&view["run"], &view["state"], &vae["state"]].map(|value| value.as_str().expect("a word").to_owned())
}

/// Waits until the newest run trains, and returns its name, as reported by the process that holds the store.
fn trains(bench: &Bench, mut running: Running) -> (Running, String) {
    let run = wait_for("the stage to run", || {
        if !running.alive() {
            return Some(None);
        }
        let [run, _, vae] = state(bench, "@last");
        (vae == "running").then_some(Some(run))
    });
    match run {
        Some(run) => (running, run),
        None => panic!("the run is over: {:?}", running.wait()),
    }
}

/// Lists, prints and copies the files of a finished run.
fn check_files(bench: &Bench, run: &str) {
    let listed = bench.run(&["files", run, "-o", "json"]).expect_code(0).json();
    let listed = listed["files"].as_array().expect("files");
    assert!(listed.len() > 10, "{listed:?}");
    let report = ["files", run, "--stage", "fid_pcm", "--name", "report.json", "--print"];
    assert!(bench.run(&report).expect_code(0).json()["metrics"]["latent_fid"].is_number());
    assert!(bench.run(&["files", run, "--print"]).expect_code(2).stderr.contains("`--print` writes one"));
    assert!(bench.run(&["files", run, "--stage", "fid_pmc"]).expect_code(7).stderr.contains("did you mean `fid_pcm`?"));
    bench.run(&["files", run, "--copy", "copied"]).expect_code(0);
    let copied = bench.path().join("copied");
    for file in listed {
        let word = |key: &str| file[key].as_str().expect("a word");
        let bytes = fs::read(copied.join(word("stage")).join(word("output")).join(word("name"))).expect("a copy");
        assert_eq!(Digest::of(&bytes).to_string(), word("digest"));
    }
    assert_eq!(files(&copied).len(), listed.len(), "nothing else is there");
    bench.run(&["files", run, "--copy", "copied"]).expect_code(2);
}

#[test]
fn reading_a_store_that_nobody_holds_changes_nothing() {
    let bench = Bench::new(TRAINER);
    let finished = bench.pipeline("smoke.yaml", &["--workers", "1"])["run"].as_str().expect("a run").to_owned();
    let config = Bench::config("smoke.yaml");
    let sets = ["--set", "seed=7", "--set", "stages.vae.steps=20000"];
    let killed = bench.spawn(&[&["run", &config, "--workers", "1"][..], &sets].concat());
    let (mut killed, interrupted) = trains(&bench, killed);
    killed.kill();
    assert_eq!(killed.wait().code, None);

    assert!(fs::metadata(bench.store().join("stride.db-wal")).expect("a log").len() > 0);
    assert_eq!(state(&bench, "@last"), [&*interrupted, "interrupted", "ready"], "nobody works on it");
    assert_eq!(state(&bench, &finished), [&*finished, "finished", "ran"]);
    let status = bench.run(&["status", &finished]).expect_code(0).stdout;
    let vae = status.lines().find(|line| line.starts_with("vae ")).expect("a row");
    assert!(vae.contains("iB  ") && vae.ends_with(" new"), "memory, and why it ran: {status}");
    let json = bench.run(&["status", &interrupted, "-o", "json"]).expect_code(0).json();
    let why = json["stages"]
        .as_array()
        .expect("stages")
        .iter()
        .find(|stage| stage["name"] == "vae")
        .map(|stage| &stage["why"]);
    assert_eq!(why, Some(&Value::from("steps 12 -> 20000")), "{json}");
    let logs = bench.run(&["logs"]).expect_code(0).stdout;
    assert!(logs.starts_with("dataset w1 "), "{logs}");
    let values = bench.run(&["metrics", &finished, "--stage", "vae", "--key", "loss", "--csv"]).expect_code(0).stdout;
    let mut rows = values.lines();
    assert_eq!(rows.next(), Some("stage,name,step,value"));
    let is_value = |row: &str| row.starts_with("vae,loss,") && row.rsplit(',').all(|word| !word.is_empty());
    assert!(rows.clone().count() > 1 && rows.all(is_value), "{values}");
    bench.run(&["metrics", &finished, "--key", "loss", "--plot", "loss.svg"]).expect_code(0);
    let picture = fs::read_to_string(bench.path().join("loss.svg")).expect("a picture");
    assert!(picture.starts_with("<svg ") && picture.contains("<polyline"), "{picture}");
    check_files(&bench, &finished);
    read_everything(&bench, &finished, &interrupted);

    let (resumed, again) = trains(&bench, bench.spawn(&["resume", &interrupted, "--workers", "1"]));
    assert_eq!(again, interrupted);
    resumed.signal(Signal::SIGINT);
    resumed.wait().expect_code(130);
    assert_eq!(state(&bench, "@last"), [&*interrupted, "interrupted", "ready"]);
    read_everything(&bench, &finished, &interrupted);
}

/// A plan shows the cost of a run before its data exists. Both `plan` and `run` refuse runs that could never finish.
#[test]
fn a_plan_says_what_is_missing_and_what_a_run_would_take() {
    let bench = Bench::new(TRAINER);
    let recipe = Bench::config("motionpcm.yaml");
    // Run in a folder without data, where the recipe's paths do not exist.
    let plan = bench.run(&["plan", &recipe, "--no-time"]).expect_code(0).stdout;
    println!("{plan}");
    assert!(plan.lines().count() <= 40 && plan.lines().all(|line| line.chars().count() <= 100), "{plan}");
    for part in
        ["data/HumanML3D: no such folder", "deps/t2m/t2m", "deps/glove", "`data/HumanML3D` is missing", "384,000"]
    {
        assert!(plan.contains(part), "`{part}` is missing from\n{plan}");
    }
    let run = bench.run(&["run", &recipe]).expect_code(2).stderr;
    assert!(run.contains("deps/glove: no such folder") && run.contains("data/HumanML3D: no such folder"), "{run}");
    assert!(!bench.store().exists(), "nothing was stored");

    let smoke = Bench::config("smoke.yaml");
    let plan = bench.run(&["plan", &smoke, "-o", "json"]).expect_code(0).json();
    for stage in plan["stages"].as_array().expect("stages") {
        let (kind, name) = (stage["kind"].as_str().expect("a kind"), &stage["stage"]);
        if kind.starts_with("train.") || kind.starts_with("distill.") {
            assert!(stage["parameters"].as_u64() > Some(1_000) && stage["steps"].is_u64(), "{name}: {stage}");
        }
        if ["train", "distill", "evaluate", "encode"].contains(&kind.split('.').next().expect("a word")) {
            assert!(stage["seconds"].as_f64() > Some(0.0), "{name}: {stage}");
        }
    }
    let table = bench.run(&["plan", &smoke]).expect_code(0).stdout;
    assert!(table.contains("with one worker") && table.contains("updates per stage"), "{table}");

    // Settings that would otherwise fail hours later.
    let kit = bench.path().join("kit");
    std::fs::create_dir(&kit).expect("a folder");
    // 251 zeros, as `numpy.save` writes them.
    let mut mean = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    mean.extend(format!("{:<117}\n", "{'descr': '<f4', 'fortran_order': False, 'shape': (251,), }").bytes());
    mean.extend([0; 4 * 251]);
    std::fs::write(kit.join("Mean.npy"), mean).expect("a file");
    let folder = format!("dataset={{format: humanml3d, path: {}}}", kit.display());
    for (sets, part) in [
        (vec!["backend=cuda"], "--features cuda"),
        (vec!["stages.release.metric=fdi"], "reports `fdi`"),
        (vec!["stages.release.promote.require=[fdi <= 1]"], "needs `fdi`"),
        (vec!["stages.mld.checkpoint={every: 4, keep: {best: 1, metric: fdi}}"], "they record loss, gradient_norm, lr"),
        (vec![folder.as_str()], "251 features, like `kit`"),
    ] {
        for verb in ["plan", "run"] {
            let mut words = vec![verb, smoke.as_str()];
            words.extend(sets.iter().flat_map(|set| ["--set", set]));
            let said = bench.run(&words).expect_code(2).stderr;
            assert!(said.contains(part), "{verb} {sets:?}:\n{said}");
        }
    }
    assert!(!bench.store().exists(), "nothing was stored");
}
