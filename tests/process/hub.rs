//! A text encoder by its hub id, without a network. It is found in the hub's cache, or refused with advice before
//! anything runs.

use std::fs;
use std::path::Path;

use cluster_tests::{Bench, states};
use hostile::seeds::encoder_folder;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";

fn pipeline(bench: &Bench, more: &str) {
    let text = format!(
        "name: p\ndataset: {{format: synthetic, clips: 12}}\nstages:\n  words: {{kind: text.embed, encoder: clip, path: tiny/clip{more}}}\n"
    );
    fs::write(bench.path().join("p.yaml"), text).expect("a file of ours");
}

/// Creates the cache that `huggingface_hub` would keep for a small CLIP.
fn fill_cache(home: &Path) {
    let root = home.join("hub/models--tiny--clip");
    for (name, bytes) in encoder_folder(false) {
        let file = root.join("snapshots").join(COMMIT).join(name);
        fs::create_dir_all(file.parent().expect("below")).expect("a folder of ours");
        fs::write(file, bytes).expect("a file of ours");
    }
    fs::create_dir_all(root.join("refs")).expect("a folder of ours");
    fs::write(root.join("refs/main"), COMMIT).expect("a file of ours");
}

#[test]
fn an_encoder_of_the_hub_without_a_network() {
    let home = tempfile::tempdir().expect("a folder");
    let variables = [("HF_HOME", home.path().display().to_string()), ("HF_HUB_OFFLINE", "1".to_owned())];
    let bench = Bench::new(TRAINER).with_environment(variables);
    pipeline(&bench, "");
    let planned = bench.run(&["plan", "p.yaml", "--no-time"]).expect_code(0);
    assert!(planned.stdout.contains("tiny/clip: not in the hub's cache"), "{}", planned.stdout);
    assert!(planned.stdout.contains("HF_HUB_OFFLINE is set"), "{}", planned.stdout);
    let refused = bench.run(&["run", "p.yaml"]).expect_code(2);
    for part in ["stage `words`: `tiny/clip` is not in the cache", "HF_HUB_OFFLINE is set", "hf download tiny/clip"] {
        assert!(refused.stderr.contains(part), "{part}: {}", refused.stderr);
    }
    assert!(!bench.store().exists(), "nothing has begun");

    fill_cache(home.path());
    let run = || bench.run(&["run", "p.yaml", "-o", "json"]).expect_code(0).json();
    assert_eq!(states(&run())["words"], "ran");
    assert_eq!(states(&run())["words"], "cached");
    // The same content under its commit is the same encoder.
    pipeline(&bench, &format!(", revision: {COMMIT}"));
    assert_eq!(states(&run())["words"], "cached");
    pipeline(&bench, ", revision: v2");
    let refused = bench.run(&["run", "p.yaml"]).expect_code(2);
    assert!(refused.stderr.contains("`tiny/clip@v2` is not in the cache"), "{}", refused.stderr);

    // Other content is another encoder.
    pipeline(&bench, "");
    let merges = home.path().join("hub/models--tiny--clip/snapshots").join(COMMIT).join("merges.txt");
    fs::write(merges, "#version: 0.2\na b</w>\n\n").expect("a file of ours");
    assert_eq!(states(&run())["words"], "ran");

    // A folder of that name takes precedence, and has no revision.
    fs::create_dir_all(bench.path().join("tiny/clip")).expect("a folder of ours");
    let refused = bench.run(&["run", "p.yaml"]).expect_code(2);
    assert!(refused.stderr.contains("tiny/clip: the folder has no `config.json`"), "{}", refused.stderr);
    pipeline(&bench, ", revision: main");
    let refused = bench.run(&["run", "p.yaml"]).expect_code(2);
    assert!(refused.stderr.contains("`revision` is set, but `path` is the folder"), "{}", refused.stderr);
}
