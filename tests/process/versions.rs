//! Registry versions in place of stages, and transfers of versions between stores.

use std::fs;

use cluster_tests::cluster::Cluster;
use cluster_tests::{Bench, digests, wait_for};
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Latents by a version's VAE, and a teacher that starts from the same version's denoiser. Long enough that a kill hits
/// its middle.
const TUNED: &str = "name: tuned
seed: 5
dataset: {format: synthetic, clips: 32, val: 0.1, test: 0.2}
stages:
  latents: {kind: encode.latents, vae: smoke@staging, crops: 2}
  tuned:
    kind: train.mld
    vae: smoke@staging
    init: smoke@staging
    network: {width: 32, layers: 3, heads: 2, feed_forward: 64, dropout: 0.1}
    steps: 400
    batch: {global: 16, slices: 4}
    lr: 1e-3
    checkpoint: {every: 20}
";

/// Creates a store with the two students of the smoke pipeline as versions, and the pipeline above beside it.
fn with_versions() -> Bench {
    let bench = Bench::new(TRAINER);
    bench.pipeline("smoke.yaml", &["--workers", "2"]);
    fs::write(bench.path().join("tuned.yaml"), TUNED).expect("a pipeline");
    bench
}

/// Moves the alias `staging` to the other of the two versions.
fn promote_the_other(bench: &Bench) {
    let shown = bench.run(&["registry", "show", "smoke@staging", "-o", "json"]).expect_code(0).json();
    let other = if shown["version"]["version"] == 1 { "smoke@2" } else { "smoke@1" };
    bench.run(&["registry", "promote", other, "--to", "staging", "--reason", "a move"]).expect_code(0);
}

const RUN: [&str; 6] = ["run", "tuned.yaml", "-o", "json", "--workers", "1"];

#[test]
fn p6_a_training_that_begins_with_a_version_is_killed_and_goes_on_with_it() {
    let undisturbed = with_versions();
    let expected = digests(&undisturbed.run(&RUN).expect_code(0).json());
    let plan = || undisturbed.run(&["plan", "tuned.yaml", "-o", "json", "--no-time"]).expect_code(0).json();
    assert_eq!(plan()["stages"][3]["action"], "cached", "{}", plan());
    let logs = undisturbed.run(&["logs", "@last"]).expect_code(0).stdout;
    assert!(logs.contains("starts with") && logs.contains("not used: "), "{logs}");

    // Both students share one VAE, but each has its own denoiser.
    promote_the_other(&undisturbed);
    let moved = plan();
    assert_eq!(moved["stages"][3]["action"], "run", "{moved}");
    assert!(moved["stages"][3]["why"].as_str().is_some_and(|why| why.contains("the version `init`")), "{moved}");

    let bench = with_versions();
    let mut running = bench.spawn(&RUN);
    wait_for("the training to begin", || {
        let logs = fs::read_dir(bench.store().join("workers")).ok()?.flatten();
        let mut said = logs.map(|entry| fs::read_to_string(entry.path()).unwrap_or_default());
        said.any(|said| said.contains("/tuned attempt=")).then_some(())
    });
    running.kill();
    assert_eq!(running.wait().code, None, "it was over before the kill");
    promote_the_other(&bench);
    let resumed = bench.run(&["resume", "@last", "-o", "json", "--workers", "2"]).expect_code(0).json();
    assert_eq!(digests(&resumed), expected, "the alias has moved, the run's inputs have not");
}

#[test]
fn versions_that_do_not_fit_are_refused_by_plan_and_by_run() {
    let bench = with_versions();
    let runs = || bench.run(&["status", "--all", "-o", "json"]).expect_code(0).json()["runs"].as_array().map(Vec::len);
    let before = runs();
    for (set, words) in [
        ("stages.tuned.init=nobody@prod", "no model `nobody`"),
        ("stages.tuned.init=smoke@nobody", "no `smoke@nobody`"),
        ("stages.tuned.init=smoke@9", "no `smoke:9`"),
        ("stages.tuned.latents=smoke@staging", "versions of the registry do not contain latents"),
        ("stages.tuned.init=a/b@c", "is not a model version"),
        ("stages.other={kind: train.tokenizer, init: smoke@staging}", "no part of kind `tokenizer`"),
        ("stages.other={kind: train.control, model: tuned, init: smoke@1}", "no part of kind `control`"),
        ("stages.other={kind: register, model: x, from: smoke@1}", "a version of the registry; expected a stage"),
    ] {
        for verb in ["plan", "run"] {
            let said = bench.run(&[verb, "tuned.yaml", "--set", set]).expect_code(2);
            assert!(said.stderr.contains(words), "{verb} {set}: {}", said.stderr);
        }
    }
    assert_eq!(runs(), before, "nothing was begun");
    let nowhere = bench.run(&["plan", "tuned.yaml", "--store", "nowhere"]).expect_code(2);
    assert!(nowhere.stderr.contains("there is no store"), "{}", nowhere.stderr);
}

#[test]
fn a_bundle_draws_the_same_motion_from_another_store() {
    let bench = Bench::new(TRAINER);
    bench.pipeline("smoke.yaml", &["--workers", "2"]);
    let motion = |bench: &Bench, model: &str, file: &str| {
        bench.run(&["generate", "a person walks in a circle", "--model", model, "-o", file]).expect_code(0);
        fs::read(bench.path().join(file)).expect("the motion is written")
    };
    let expected = motion(&bench, "smoke@staging", "x.npy");
    for file in ["one.tar.zst", "two.tar.zst"] {
        bench.run(&["registry", "export", "smoke@staging", "-o", file]).expect_code(0);
    }
    let bundle = fs::read(bench.path().join("one.tar.zst")).expect("a bundle");
    assert_eq!(fs::read(bench.path().join("two.tar.zst")).expect("a bundle"), bundle, "one version, one file");
    let there = bench.run(&["registry", "export", "smoke@staging", "-o", "one.tar.zst"]).expect_code(2);
    assert!(there.stderr.contains("exists already"), "{}", there.stderr);

    let other = Bench::new(TRAINER);
    fs::write(other.path().join("smoke.tar.zst"), &bundle).expect("a copy");
    let cut = &bundle[..bundle.len() - 1000];
    fs::write(other.path().join("cut.tar.zst"), cut).expect("a copy");
    let refused = other.run(&["registry", "import", "cut.tar.zst"]);
    assert_eq!(refused.code, Some(9), "{}", refused.stderr);
    other.run(&["registry", "import", "smoke.tar.zst"]).expect_code(0);
    other.run(&["registry", "import", "smoke.tar.zst", "--model", "renamed"]).expect_code(0);
    assert_eq!(motion(&other, "smoke@1", "y.npy"), expected, "the same bits");
    assert_eq!(motion(&other, "renamed@latest", "z.npy"), expected, "whatever it is called");
    // A bundle has no captions, so words that the model never saw cannot be named.
    let said = other.run(&["generate", "quantum flapdoodle", "--model", "smoke@1", "-o", "u.npy", "-o", "json"]);
    assert!(said.stderr.contains("has no training captions of smoke"), "{}", said.stderr);
    assert_eq!((&said.json()["unknown_words"], &said.json()["nearest_known"]), (&Value::Null, &Value::Null));
    let metrics = |bench: &Bench, model: &str| {
        bench.run(&["registry", "show", model, "-o", "json"]).expect_code(0).json()["version"]["metrics"].clone()
    };
    assert_eq!(metrics(&other, "smoke@1"), metrics(&bench, "smoke@staging"));
    let listed = other.run(&["registry", "show", "smoke", "-o", "json"]).expect_code(0).json();
    assert_eq!(listed["versions"].as_array().map(Vec::len), Some(1), "imported twice, it is one version");
    other.run(&["registry", "fsck"]).expect_code(0);

    // Training can also start from an imported version.
    fs::write(other.path().join("tuned.yaml"), TUNED.replace("smoke@staging", "renamed@1")).expect("a pipeline");
    other.run(&["run", "tuned.yaml", "--set", "stages.tuned.steps=4", "--workers", "1"]).expect_code(0);

    // A server imports it over the network, and so does the command line on the server's machine.
    let cluster = Cluster::start(TRAINER);
    fs::write(cluster.bench().path().join("smoke.tar.zst"), &bundle).expect("a copy");
    let url = cluster.url();
    cluster.bench().run(&["registry", "import", "smoke.tar.zst", "--server", &url]).expect_code(0);
    cluster.bench().run(&["registry", "import", "smoke.tar.zst", "--model", "second"]).expect_code(0);
    cluster.bench().run(&["registry", "export", "second@1", "-o", "again.tar.zst", "--server", &url]).expect_code(0);
    assert_eq!(motion(cluster.bench(), "second@1", "x.npy"), expected, "by way of a server");
}
