//! The chapter "Your mocap" unchanged except for fewer updates, on the folder that it creates: features, a trial that
//! promotes nothing, then the training, whose student draws a GLB.

use std::fs;
use std::path::Path;

use cluster_tests::Bench;
use cluster_tests::documented::{run_by, words};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// A few updates instead of a few hundred.
const FEWER: [&str; 6] = [
    "stages.vae.steps=6",
    "stages.vae.warmup=2",
    "stages.mld.steps=6",
    "stages.mld.warmup=2",
    "stages.pcm.steps=6",
    "stages.pcm.warmup=2",
];

#[test]
fn the_recordings_of_the_book() {
    let bench = Bench::new(TRAINER);
    let lines = run_by(&Bench::repository(), "tests/process/mocap.rs");
    assert_eq!(lines.len(), 5, "{lines:?}");
    let mut said = Vec::new();
    for line in &lines {
        println!("$ {line}");
        let line = line.replace("configs/mocap.yaml", &Bench::config("mocap.yaml"));
        let words = words(&line);
        assert_eq!(words[0], "trainer");
        let mut arguments: Vec<&str> = words[1..].iter().map(String::as_str).collect();
        if arguments[0] == "run" {
            arguments.extend(FEWER.iter().flat_map(|set| ["--set", set]));
        }
        said.push(bench.run(&arguments).expect_code(0));
    }
    let recordings = fs::read_dir(bench.path().join("my-mocap")).expect("the folder");
    let is_bvh = |path: &Path| path.extension().is_some_and(|ending| ending == "bvh");
    assert_eq!(recordings.filter(|entry| entry.as_ref().is_ok_and(|entry| is_bvh(&entry.path()))).count(), 30);
    assert!(said[1].stdout.contains("joints:") && said[1].stdout.contains("pelvis"), "{}", said[1].stdout);
    let report = bench.run(&["status", "@last", "-o", "json"]).expect_code(0).json();
    let states = cluster_tests::states(&report);
    assert!(states.values().all(|state| state == "ran" || state == "cached"), "{states:?}");
    assert_eq!(states["dataset"], "cached", "the features of the first run are those of the second");
    assert!(bench.path().join("trial.gif").exists());
    let listed = bench.run(&["registry", "list"]).expect_code(0).stdout;
    assert!(!listed.contains("mocap"), "a trial registers nothing: {listed}");

    let full = Bench::config("mocap-full.yaml");
    let mut arguments = vec!["run", &full, "--set", "stages.dataset.path=my-mocap", "-o", "json"];
    arguments.extend(FEWER.iter().flat_map(|set| ["--set", set]));
    let report = bench.run(&arguments).expect_code(0).json();
    let states = cluster_tests::states(&report);
    assert_eq!(states["dataset"], "cached", "the training takes over the features of the trial");
    let shown = bench.run(&["registry", "show", "mocap@staging"]).expect_code(0).stdout;
    assert!(shown.contains(" 1 step,"), "a one-step student: {shown}");
    bench.run(&["generate", "a person walks", "--model", "mocap@staging", "-o", "walk.glb"]).expect_code(0);
    let glb = fs::read(bench.path().join("walk.glb")).expect("a file");
    assert!(glb.starts_with(b"glTF") && glb.len() > 10_000, "{} bytes", glb.len());
}

/// A recording without a caption is counted by its reason, and a table of captions is offered and written.
#[test]
fn recordings_without_a_caption_get_one_by_their_name() {
    let bench = Bench::new(TRAINER);
    bench.run(&["data", "sample", "recordings", "--format", "bvh", "--clips", "6"]).expect_code(0);
    let folder = bench.path().join("recordings");
    fs::rename(folder.join("000002.bvh"), folder.join("walk_fast-02.bvh")).expect("renamed");
    fs::remove_file(folder.join("000002.txt")).expect("removed");
    let config = Bench::config("mocap.yaml");
    let run = ["run", &config, "--set", "stages.dataset.path=recordings", "--until", "dataset"];
    bench.run(&run).expect_code(0);
    let logs = bench.run(&["logs", "@last"]).expect_code(0).stdout;
    let counted = "left out: 1 without a caption; `trainer data captions FOLDER`";
    assert!(logs.contains(counted) && logs.contains("such as walk_fast-02: no caption"), "{logs}");

    let said = bench.run(&["data", "captions", "recordings"]).expect_code(0).stdout;
    assert!(said.contains("1 of 6 recordings had no caption; 1 have one from their file name"), "{said}");
    let table = fs::read_to_string(folder.join("captions.csv")).expect("the table");
    assert_eq!(table, "clip,caption\nwalk_fast-02,walk fast\n");
    let said = bench.run(&["data", "captions", "recordings"]).expect_code(0).stdout;
    assert!(said.contains("each of the 6 recordings has a caption"), "{said}");
    bench.run(&run).expect_code(0);
    let logs = bench.run(&["logs", "@last"]).expect_code(0).stdout;
    assert!(!logs.contains("left out: 1") && logs.contains("0 left out"), "{logs}");
}
