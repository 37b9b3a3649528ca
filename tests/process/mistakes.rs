//! Wrong pipelines and wrong command lines with their whole messages, which are read like any text: each says what is
//! wrong, where, and what to do. `UPDATE_DOCS=1` writes them anew.

use std::fmt::Write as _;
use std::fs;
use std::process::Command;

use cluster_tests::Bench;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// A pipeline without mistakes. Each case changes one place.
const GOOD: &str = r#"name: p
seed: 1
dataset: {format: synthetic, clips: 60}
stages:
  vae: {kind: train.vae, steps: 100, batch: {global: 8, slices: 2}, warmup: 10, lr: 1e-3}
  latents: {kind: encode.latents, vae: vae}
  mld: {kind: train.mld, warmup: 10, steps: 100}
  pcm: {kind: distill.pcm, teacher: mld, phases: 1, guidance: [0.5, 5]}
  fid: {kind: evaluate.latent_fid, model: pcm, teacher: mld, sampler: {steps: 1, guidance: 2}}
  out: {kind: register, model: m, from: [pcm], mode: min, promote: {to: staging, require: ["latent_fid <= 3"]}}
"#;

/// A place and its replacement. An empty place is the whole file.
const PIPELINES: &[(&str, &str)] = &[
    ("kind: train.vae", "kind: train.vea"),
    ("kind: train.vae, steps", "steps"),
    ("steps: 100, batch", "steps: soon, batch"),
    ("steps: 100, batch", "steps: -5, batch"),
    ("steps: 100, batch", "steps: 1.5, batch"),
    ("steps: 100, batch", "steps: 1e99, batch"),
    ("steps: 100, batch", "steps: , batch"),
    ("steps: 100, batch", "step: 100, batch"),
    ("lr: 1e-3", "lr: fast"),
    ("lr: 1e-3", "lr: 0"),
    ("lr: 1e-3", "lr: -1"),
    ("lr: 1e-3", "lr: .nan"),
    ("lr: 1e-3", "learning_rate: 1e-3"),
    ("global: 8, slices: 2", "global: 7, slices: 2"),
    ("global: 8, slices: 2", "global: 0, slices: 2"),
    ("global: 8, slices: 2", "global: 8, slices: 0"),
    ("{global: 8, slices: 2}", "8"),
    ("{global: 8, slices: 2}", "[8, 2]"),
    ("vae: vae}", "vae: vea}"),
    ("vae: vae}", "vae: mld}"),
    ("vae: vae}", "vae: latents}"),
    ("vae: vae}", "vae: []}"),
    ("vae: vae}", "vae: other@prod}"),
    ("teacher: mld, phases", "teacher: vae, phases"),
    ("teacher: mld, phases", "teacher: pcm, phases"),
    ("phases: 1", "phases: 0"),
    ("phases: 1", "phases: many"),
    ("model: pcm, teacher", "model: pmc, teacher"),
    ("model: pcm, teacher", "model: vae, teacher"),
    ("steps: 1, guidance", "steps: 0, guidance"),
    ("steps: 1, guidance", "steps: 2000, guidance"),
    ("guidance: 2", "guidance: -3"),
    ("guidance: 2", "solver: euler"),
    ("sampler: {steps: 1, guidance: 2}", "sampler: fast"),
    ("format: synthetic", "format: sythetic"),
    ("format: synthetic, clips: 60", "format: humanml3d"),
    ("format: synthetic, clips: 60", "format: humanml3d, path: nowhere"),
    ("clips: 60", "clips: 0"),
    ("clips: 60", "clips: 99999999999"),
    ("clips: 60", "clip: 60"),
    ("{format: synthetic, clips: 60}", "synthetic"),
    ("dataset: {format: synthetic, clips: 60}\n", ""),
    ("name: p\n", ""),
    ("name: p\n", "name: a/b\n"),
    ("seed: 1", "seed: -1"),
    ("seed: 1", "seed: lucky"),
    ("seed: 1", "sed: 1"),
    ("seed: 1", "seed: 1\nbackend: tpu"),
    ("seed: 1", "seed: 1\ntext: {encoder: gpt}"),
    ("seed: 1", "seed: 1\ntext: {encoder: clip}"),
    ("  vae:", "  my vae:"),
    ("  mld:", "  vae:"),
    ("steps: 100}", "steps: 100, steps: 200}"),
    ("  latents:", "\tlatents:"),
    ("steps: 100}", "steps: 100"),
    ("\"latent_fid <= 3\"", "\"latent_fid <= 3"),
    ("steps: 100}", "steps: *same}"),
    ("", ""),
    ("", "# nothing yet\n"),
    ("", "- train.vae\n- train.mld\n"),
    ("", "name: p\ndataset: {format: synthetic}\nstages: {}\n"),
    ("", "name: p\ndataset: {format: synthetic}\n"),
    ("mode: min", "metric: latent_fidd, mode: min"),
    ("mode: min", "mode: lowest"),
    ("latent_fid <= 3", "latent_fid =< 3"),
    ("latent_fid <= 3", "latent_fit <= 3"),
    ("from: [pcm]", "from: []"),
    ("from: [pcm]", "from: [pmc]"),
    ("model: m,", "model: my model,"),
    ("lr: 1e-3", "lr: 1e-3, sweep: {lr: [1e-3, 1e-4]}"),
];

/// Arguments of a command line, as a shell reads them.
const COMMANDS: &[&str] = &[
    "",
    "rnu p.yaml",
    "run",
    "run nope.yaml",
    "run empty",
    "run some",
    "run some/goood.yaml",
    "run pipe",
    "run p.yaml q.yaml",
    "run p.yaml --wrokers 2",
    "run p.yaml --workers 0",
    "run p.yaml --workers many",
    "run p.yaml --workers -1",
    "run p.yaml --until vea",
    "run p.yaml --set lr",
    "run p.yaml --set stages.vea.lr=1",
    "run p.yaml --set stages.vae.lrr=1",
    "run p.yaml --set stages.vae.lr=fast",
    "run p.yaml --set dataset.format=humanml",
    "run p.yaml --set dataset.format=humanml3d",
    "run p.yaml --store p.yaml",
    "run p.yaml --blobs ftp://x",
    "run p.yaml --verify soon",
    "run p.yaml -o xml",
    "plan p.yaml --until vae",
    "status",
    "status quickstart-1",
    "status --store p.yaml",
    "logs --stage",
    "metrics @last --csv",
    "sweep",
    "sweep best",
    "pause --all",
    "generate",
    "generate a person walks",
    "generate 'a person walks'",
    "generate 'a person walks' -m x@y",
    "generate 'a person walks' -m x@y -o walk.mov",
    "generate 'a person walks' -m x@y -o walk",
    "generate 'a person walks' -m x@y -o nodir/walk.gif",
    "generate 'a person walks' -m x@y -o x.npy --guidance -3",
    "generate 'a person walks' -m x@y -o x.npy --guidance strong",
    "generate 'a person walks' -m x@y -o x.npy --seconds -4",
    "generate 'a person walks' -m x@y -o x.npy --seconds soon",
    "generate 'a person walks' -m x@y -o x.npy --frames 0",
    "generate 'a person walks' -m x@y -o x.npy --frames 1.5",
    "generate 'a person walks' -m x@y -o x.npy --frames 90 --seconds 3",
    "generate 'a person walks' -m x@y -o x.npy --frames 90,80",
    "generate 'a person walks' -m x@y -o x.npy -n 0",
    "generate 'a person walks' -m x@y -o x.npy -n 5000",
    "generate 'a person walks' -m x@y -o x.npy --seed -1",
    "generate 'a person walks' -m x@y -o x.npy --sampler ddim",
    "generate 'a person walks' -m x@y -o x.npy --sampler solvr=ddim",
    "generate 'a person walks' -m x@y -o x.npy --sampler solver=euler",
    "generate 'a person walks' -m x@y -o x.npy --sampler steps=4",
    "generate 'a person walks' -m x@y -o x.npy --edit m.npy",
    "generate 'a person walks' -m x@y -o x.npy --keep 0:1s",
    "generate 'a person walks' -m x@y -o x.npy --stage mld",
    "generate 'a person walks' -m x@y -o x.npy --run @last",
    "generate 'a person walks' -m x@y -o x.npy --captions none.txt",
    "generate 'a person walks' -m x@y -o x.npy --report xml",
    "gallery -o gallery.gif",
    "export none.npy -o x.glb",
    "export p.yaml -o x.glb",
    "export none.npy",
    "data inspect none.bvh",
    "data inspect p.yaml",
    "data fetch amass",
    "data sample some --format bvh",
    "import none.ckpt --as m --part mld --statistics none",
    "import none.ckpt --as m --part vae --statistics none",
    "time",
    "time x@y",
    "schema --yaml",
    "completions tcsh",
    "config show nope.yaml",
    "demo --dir p.yaml",
    "demo --ui --train",
    "serve --bind nowhere",
    "serve --bind 0.0.0.0:0",
    "serve --token short",
    "serve --token-file none.txt",
    "worker join",
    "submit p.yaml --server http://127.0.0.1:9",
    "registry show",
    "registry show x",
    "registry promote x@best --to prod",
    "registry forget --ended-before soon",
    "registry import none.tar.zst",
    "registry list -o xml",
];

/// Compares with the file, or writes it.
fn compare(name: &str, found: &str) {
    let path = Bench::repository().join("tests/process/mistakes").join(name);
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&path, found).expect("written");
    }
    let kept = fs::read_to_string(&path).unwrap_or_default();
    for (i, (kept, found)) in kept.lines().zip(found.lines()).enumerate() {
        assert_eq!(kept, found, "{name}:{}; UPDATE_DOCS=1 writes it anew", i + 1);
    }
    assert_eq!(kept.lines().count(), found.lines().count(), "{name}; UPDATE_DOCS=1 writes it anew");
}

/// Checks that a message starts with the user's mistake and reports no fault of the program.
fn check(what: &str, code: Option<i32>, said: &str) {
    assert!(matches!(code, Some(2 | 6 | 7)), "{what}: {code:?}\n{said}");
    assert!(said.starts_with("error: ") || said.contains("Usage: "), "{what}: {said}");
    for word in ["panicked", "unwrap", "Error(", "os error"] {
        assert!(!said.contains(word), "{what}: `{word}` in\n{said}");
    }
}

#[test]
fn p11_malformed_pipelines_with_their_messages() {
    let bench = Bench::new(TRAINER);
    let path = bench.path().join("p.yaml");
    fs::write(&path, GOOD).expect("written");
    bench.run(&["plan", "--no-time", "p.yaml"]).expect_code(0);
    let mut all = String::new();
    for &(from, to) in PIPELINES {
        assert!(GOOD.contains(from), "{from}");
        let text = if from.is_empty() { to.to_owned() } else { GOOD.replacen(from, to, 1) };
        fs::write(&path, text).expect("written");
        let said = bench.run(&["run", "p.yaml"]);
        check(&format!("{from} -> {to}"), said.code, &said.stderr);
        assert!(!bench.store().exists(), "{to}: the store must be untouched");
        let _ = writeln!(all, "- {}\n+ {}\n\n{}\n", from.escape_debug(), to.escape_debug(), said.stderr.trim_end());
    }
    compare("pipelines.txt", &all);
}

#[test]
fn p11_wrong_command_lines_with_their_messages() {
    let bench = Bench::new(TRAINER);
    let at = |name: &str| bench.path().join(name);
    fs::create_dir(at("empty")).expect("a folder");
    fs::create_dir(at("some")).expect("a folder");
    fs::write(at("some/good.yaml"), GOOD).expect("written");
    fs::write(at("p.yaml"), GOOD).expect("written");
    assert!(Command::new("mkfifo").arg(at("pipe")).status().expect("mkfifo runs").success());
    let mut all = String::new();
    for &line in COMMANDS {
        let words = cluster_tests::documented::words(line);
        let said = bench.run(&words.iter().map(String::as_str).collect::<Vec<_>>());
        check(line, said.code, &said.stderr);
        assert!(!bench.store().exists(), "{line}: the store must be untouched");
        let code = said.code.unwrap_or_default();
        let _ = writeln!(all, "$ trainer {line}\n{}\nexit code {code}\n", said.stderr.trim_end());
    }
    compare("commands.txt", &all);
}
