//! The chapter "Your mocap" unchanged except for fewer updates, on the folder that it creates: features, a training, a
//! one-step student, and its motion as GLB.

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
    let shown = bench.run(&["registry", "show", "mocap@staging"]).expect_code(0).stdout;
    assert!(shown.contains(" 1 step(s)"), "a one-step student: {shown}");
    let glb = fs::read(bench.path().join("walk.glb")).expect("the last line writes it");
    assert!(glb.starts_with(b"glTF") && glb.len() > 10_000, "{} bytes", glb.len());
}
