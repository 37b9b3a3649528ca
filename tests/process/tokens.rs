//! Token stages: promises 1 and 4, and editing part of a motion on the command line.

use cluster_tests::{Bench, Running, digests};

use crate::determinism::begins;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Two tokenizers, a generator of each masked kind, a flow decoder. Long enough that a kill hits the middle of each
/// training stage.
const PIPELINE: &str = "name: tokens
seed: 1234
dataset: {format: synthetic, clips: 24, val: 0.1, test: 0.2}
text: {encoder: hashed}
stages:
  tokenizer:
    kind: train.tokenizer
    codes: 16
    code_dim: 8
    quantizers: 3
    network: {width: 16, depth: 2, growth: 2, dropout: 0.1}
    window: 16
    steps: 120
    batch: {global: 8, slices: 4}
    lr: 1e-3
    warmup: 2
    checkpoint: {every: 20}
  tokens: {kind: encode.tokens, tokenizer: tokenizer, shards: 3}
  momask:
    kind: train.tokens
    generator: masked
    network: {width: 16, layers: 1, heads: 2, feed_forward: 32, embedding: 8}
    steps: 120
    batch: {global: 8, slices: 4}
    lr: 1e-3
    checkpoint: {every: 20}
  plain:
    kind: train.tokenizer
    codes: 16
    code_dim: 8
    quantizers: 1
    resets: remembering
    network: {width: 16, depth: 2, growth: 2}
    window: 16
    steps: 120
    batch: {global: 8, slices: 4}
    lr: 1e-3
    warmup: 2
    checkpoint: {every: 20}
  ids: {kind: encode.tokens, tokenizer: plain, shards: 2}
  mmm:
    kind: train.tokens
    generator: mmm
    tokens: ids
    tokenizer: plain
    network: {width: 16, layers: 2, heads: 2, feed_forward: 32, word_blocks: 1}
    steps: 120
    batch: {global: 8, slices: 4}
    lr: 1e-3
    checkpoint: {every: 20}
  flow:
    kind: train.discord
    tokenizer: tokenizer
    network: {width: 8, condition: 8}
    window: 16
    solver_steps: 2
    ema: 0.9
    steps: 120
    batch: {global: 8, slices: 4}
    lr: 1e-3
    warmup: 2
    checkpoint: {every: 20}
  smooth: {kind: model.decoder, model: momask, decoder: flow}
  reconstruction: {kind: evaluate.reconstruction, tokenizer: tokenizer, decoder: flow, shards: 2}
";
const TRAINING: [&str; 5] = ["tokenizer", "momask", "plain", "mmm", "flow"];

fn bench() -> (Bench, String) {
    let bench = Bench::new(TRAINER);
    let path = bench.path().join("p.yaml");
    std::fs::write(&path, PIPELINE).expect("written");
    (bench, path.display().to_string())
}

fn start(bench: &Bench, path: &str, workers: &str) -> Running {
    bench.spawn(&["run", path, "-o", "json", "--workers", workers])
}

#[test]
fn p5_p6_tokens_have_the_same_digests_with_2_workers_and_after_kills() {
    let (alone, path) = bench();
    let reference = start(&alone, &path, "1").wait().expect_code(0).json();
    let (bench, path) = bench();
    for stage in TRAINING {
        let mut running = start(&bench, &path, "2");
        begins(&bench, stage);
        running.kill();
        let said = running.wait();
        assert_eq!(said.code, None, "stage {stage} was over before the kill:\n{}", said.stderr);
    }
    let report = start(&bench, &path, "2").wait().expect_code(0).json();
    assert_eq!(digests(&report), digests(&reference));
    edits(&alone);
}

/// Edits motions with `--edit`, with the models of the stages.
fn edits(bench: &Bench) {
    let draw = ["generate", "a person walks", "--stage", "momask", "--frames", "62", "-o", "walk.npy"];
    bench.run(&draw).expect_code(0);
    for (stage, more) in [("momask", vec![]), ("smooth", vec![]), ("mmm", vec!["--steps", "4"])] {
        let edit = ["generate", "a jump", "--stage", stage, "--edit", "walk.npy", "--keep", "0:1s,-1s:"];
        let json = ["-o", "edited.npy", "--report", "json"];
        let said = bench.run(&[&edit[..], &json[..], &more[..]].concat()).expect_code(0).json();
        // 62 frames are 15 tokens; the last second starts within the eleventh.
        assert_eq!(said["kept"], serde_json::json!([[0, 20], [44, 60]]), "{stage}: {said}");
        assert_eq!(said["frames"], 60, "{stage}");
    }
    let said = bench.run(
        &[&["generate", "a jump", "--stage", "momask", "--edit", "walk.npy", "--keep", "8:"][..], &["-o", "e.npy"]]
            .concat(),
    );
    let said = said.expect_code(0);
    assert!(said.stdout.contains("8-59 stay; the last 2 of 62 do not fill a token"), "{}", said.stdout);
    for (keep, words) in [
        ("0:9s", "has 62 frames"),
        (":", "nothing is left to generate"),
        ("1:3", "nothing stays"),
        ("now", "expected FROM:TO"),
    ] {
        let arguments =
            ["generate", "a jump", "--stage", "momask", "--edit", "walk.npy", "--keep", keep, "-o", "e.npy"];
        let said = bench.run(&arguments).expect_code(2);
        assert!(said.stderr.contains(words), "{keep}: {}", said.stderr);
    }
}
