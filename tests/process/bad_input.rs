//! Bad input: a message with file, line or field and advice, exit code 2, and an untouched store.

use std::fs;
use std::path::Path;
use std::process::Command;

use cluster_tests::{Bench, wait_for};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Runs a pipeline that must be refused with all of `parts` in the message.
#[track_caller]
fn refused(bench: &Bench, arguments: &[&str], parts: &[&str]) {
    let said = bench.run(arguments).expect_code(2);
    for part in parts {
        assert!(said.stderr.contains(part), "`{part}` is missing in:\n{}", said.stderr);
    }
    assert_eq!(said.stdout, "", "data goes to stdout, messages to stderr");
    assert!(!bench.store().exists(), "the store must be untouched");
}

fn changed(bench: &Bench, from: &str, to: &str) -> String {
    let text = fs::read_to_string(Bench::config("smoke.yaml")).expect("the shipped pipeline");
    assert!(text.contains(from), "smoke.yaml has no `{from}`");
    let path = bench.path().join("p.yaml");
    fs::write(&path, text.replacen(from, to, 1)).expect("written");
    path.display().to_string()
}

#[test]
fn p11_a_pipeline_with_mistakes() {
    let bench = Bench::new(TRAINER);
    for (from, to, parts) in [
        ("kind: train.vae", "kind: train.vae\n    warmpu: 3", vec!["p.yaml:", "warmpu", "warmup"]),
        ("kind: train.vae", "kind: train.vea", vec!["p.yaml:", "train.vea", "train.vae"]),
        ("steps: 16", "steps: soon", vec!["p.yaml:", "soon", "whole number"]),
        ("kind: encode.latents", "kind: encode.latents\n    vae: nobody", vec!["p.yaml:", "nobody"]),
        ("kind: train.vae", "kind: train.vae\n    dataset: latents", vec!["p.yaml:", "latents"]),
    ] {
        let path = changed(&bench, from, to);
        refused(&bench, &["run", &path], &parts);
    }
    let path = changed(&bench, "kind: train.vae", "kind: train.vae\n    dataset: vae");
    refused(&bench, &["run", &path], &["vae"]);
    refused(&bench, &["run", "nowhere.yaml"], &["nowhere.yaml"]);
    refused(&bench, &["run", &path, "--set", "stages.nobody.lr=1"], &["nobody"]);
}

/// A path that is no pipeline file: the message names its type and suggests a file.
#[test]
fn what_is_no_pipeline_is_named_with_what_was_meant() {
    let bench = Bench::new(TRAINER);
    let at = |name: &str| bench.path().join(name);
    fs::create_dir(at("empty")).expect("a folder");
    fs::create_dir(at("some")).expect("a folder");
    fs::copy(Bench::config("smoke.yaml"), at("some/smoke.yaml")).expect("copied");
    assert!(Command::new("mkfifo").arg(at("pipe")).status().expect("mkfifo runs").success());
    refused(
        &bench,
        &["run", "empty"],
        &["`empty`: it is a folder; expected a file", "hint: the folder has no pipelines; name a pipeline file"],
    );
    refused(&bench, &["run", "some"], &["hint: name one of its pipelines: some/smoke.yaml"]);
    refused(&bench, &["run", "some/smok.yaml"], &["there is no such file", "did you mean `some/smoke.yaml`?"]);
    refused(&bench, &["run", "pipe"], &["`pipe`: it is a named pipe; expected a file"]);
    refused(&bench, &["data", "inspect", "none.bvh"], &["none.bvh: there is no such file"]);
}

#[test]
fn another_format_of_the_dataset_needs_no_other_change() {
    let bench = Bench::new(TRAINER);
    let config = Bench::config("humanml3d-mini.yaml");
    let said = bench.run(&["config", "show", &config, "--set", "dataset.format=synthetic"]).expect_code(0);
    assert!(said.stdout.contains("data.synthetic"), "{}", said.stdout);
    let wrong = ["--set", "dataset.format=synthetic", "--set", "dataset.path=x"];
    let said = bench.run(&[&["plan", "--no-time", &config][..], &wrong].concat()).expect_code(2);
    assert!(said.stderr.contains("unknown key `path`"), "what the command line itself says is held against it");
}

/// Command lines that probably contain a mistake.
#[test]
fn a_command_line_that_is_probably_not_meant_is_refused_with_what_to_write() {
    let bench = Bench::new(TRAINER);
    fn generate<'a>(more: &[&'a str]) -> Vec<&'a str> {
        [&["generate", "--model", "x@y", "-o", "x.npy"][..], more].concat()
    }
    refused(
        &bench,
        &generate(&["a", "person", "walks"]),
        &["`a person walks` without quotes is 3 sentences", "hint: for one motion"],
    );
    let bare = ["generate", "a", "person", "walks"];
    refused(&bench, &bare, &["`a person walks` without quotes is 3 sentences", "hint: for one motion"]);
    refused(&bench, &["generate", "a person walks"], &["--model <MODEL>"]);
    refused(&bench, &generate(&["a person walks", "--guidance", "-3"]), &["--guidance", "expected 0 or more"]);
    refused(&bench, &generate(&["a person walks", "--seconds", "-4"]), &["expected more than 0"]);
    // Accepted as intended; the remaining error is the missing store.
    for fine in [&["a person walks", "jumps"][..], &["jumps"], &["a person walks", "--seconds", "4s"]] {
        refused(&bench, &generate(fine), &["there is no store"]);
    }
}

/// The exit codes in `--help` and those of actual commands.
#[test]
fn exit_codes_have_one_meaning_each() {
    let bench = Bench::new(TRAINER);
    let help = bench.run(&["--help"]).expect_code(0).stdout;
    for line in ["  3  a bug in this program", "  7  there is no such run, stage or model", "130  interrupted"] {
        assert!(help.contains(line), "`{line}` is missing in:\n{help}");
    }
    let config = Bench::config("smoke.yaml");
    bench.run(&["run", &config, "--until", "dataset", "--workers", "1"]).expect_code(0);
    for missing in [
        &["status", "nothing-1"][..],
        &["logs", "nothing-1"],
        &["generate", "a jump", "--model", "nothing@best", "-o", "x.npy"],
        &["registry", "show", "nothing"],
        &["registry", "history", "nothing"],
    ] {
        bench.run(missing).expect_code(7);
    }
}

/// Token stages that do not fit each other are found before the first of them trains.
#[test]
fn p11_tokens_and_decoders_that_do_not_fit() {
    let bench = Bench::new(TRAINER);
    let good = "name: p
dataset: {format: synthetic, clips: 10}
stages:
  kit: {kind: data.open, format: kit, path: kit}
  tokenizer: {kind: train.tokenizer}
  other: {kind: train.tokenizer, codes: 64}
  tokens: {kind: encode.tokens, tokenizer: tokenizer}
  momask: {kind: train.tokens, generator: masked, tokenizer: tokenizer}
  flow: {kind: train.discord, tokenizer: tokenizer, window: 64}
  smooth: {kind: model.decoder, model: momask, decoder: flow}
  kit_tokenizer: {kind: train.tokenizer, dataset: kit}
  kit_flow: {kind: train.discord, dataset: kit, tokenizer: kit_tokenizer, window: 64}
";
    let path = bench.path().join("p.yaml");
    for (from, to, parts) in [
        ("masked, tokenizer: tokenizer", "masked, tokenizer: other", ["p.yaml:8:", "their own tokenizer"]),
        (
            "train.discord, tokenizer: tokenizer",
            "train.discord, tokenizer: other",
            ["p.yaml:10:", "their own tokenizer"],
        ),
        (
            "kind: train.discord, tokenizer: tokenizer",
            "kind: train.discord, dataset: kit, tokenizer: tokenizer",
            ["p.yaml:9:", "21 joints (kit)"],
        ),
        ("model: momask, decoder: flow", "model: momask, decoder: kit_flow", ["p.yaml:10:", "21 joints (kit)"]),
        ("tokenizer: tokenizer, window: 64", "tokenizer: tokenizer, window: 62", ["p.yaml:9:", "multiple of 4"]),
        ("tokenizer: tokenizer}", "tokenizer: tokenizer, padded: 190}", ["p.yaml:7:", "multiple of 4"]),
    ] {
        assert!(good.contains(from), "{from}");
        fs::write(&path, good.replacen(from, to, 1)).expect("written");
        refused(&bench, &["run", &path.display().to_string()], &parts);
    }
}

/// Creates a folder in the published layout with three valid clips.
pub(crate) fn folder(path: &Path) {
    let source = fixtures::data("humanml3d-mini").expect("the caller has checked that real motion is there");
    for sub in ["new_joint_vecs", "texts"] {
        fs::create_dir_all(path.join(sub)).expect("created");
    }
    for name in ["Mean.npy", "Std.npy"] {
        fs::copy(source.join(name), path.join(name)).expect("copied");
    }
    let train = fs::read_to_string(source.join("train.txt")).expect("train.txt");
    let ids: Vec<_> = train.lines().take(12).collect();
    for id in &ids {
        fs::copy(source.join(format!("new_joint_vecs/{id}.npy")), path.join(format!("new_joint_vecs/{id}.npy")))
            .expect("copied");
        fs::copy(source.join(format!("texts/{id}.txt")), path.join(format!("texts/{id}.txt"))).expect("copied");
    }
    fs::write(path.join("train.txt"), ids[..8].join("\n")).expect("written");
    fs::write(path.join("val.txt"), ids[8..10].join("\n")).expect("written");
    fs::write(path.join("test.txt"), ids[10..].join("\n")).expect("written");
}

#[test]
fn a_broken_dataset_folder_is_named_file_by_file() {
    if fixtures::data("humanml3d-mini").is_none() {
        return;
    }
    let bench = Bench::new(TRAINER);
    let config = Bench::config("humanml3d-mini.yaml");
    let run = |data: &Path, parts: &[&str]| {
        refused(
            &bench,
            &["run", &config, "--set", &format!("dataset.path={}", data.display()), "--until", "dataset"],
            parts,
        );
    };
    run(&bench.path().join("missing"), &["missing"]);

    let data = bench.path().join("data");
    folder(&data);
    let first =
        fs::read_to_string(data.join("train.txt")).expect("train.txt").lines().next().expect("an id").to_owned();
    let clip = data.join(format!("new_joint_vecs/{first}.npy"));
    let good = fs::read(&clip).expect("a clip");

    fs::write(&clip, &good[..good.len() - 100]).expect("written");
    run(&data, &[&first, "bytes"]);

    let header = good.windows(1).position(|b| b[0] == b'\n').expect("an .npy header") + 1;
    let mut nan = good.clone();
    nan[header + 4 * 263 * 2 + 20..header + 4 * 263 * 2 + 24].copy_from_slice(&f32::NAN.to_le_bytes());
    fs::write(&clip, &nan).expect("written");
    run(&data, &[&first, "frame 2", "NaN"]);

    let mut narrow = good[..header].to_vec();
    let width = narrow.windows(4).position(|w| w == b"263)").expect("the shape in the header");
    narrow[width..width + 4].copy_from_slice(b"251)");
    let frames = (good.len() - header) / (4 * 263);
    narrow.extend_from_slice(&good[header..header + frames * 251 * 4]);
    fs::write(&clip, &narrow).expect("written");
    run(&data, &[&first, "263", "251"]);

    // A pipe in place of a file is reported, not waited for.
    fs::remove_file(&clip).expect("removed");
    assert!(Command::new("mkfifo").arg(&clip).status().expect("mkfifo runs").success());
    run(&data, &[&format!("{first}.npy: is a named pipe; expected a file")]);
    fs::remove_file(&clip).expect("removed");

    // Content of a file reaches the terminal only escaped.
    fs::write(&clip, &good).expect("written");
    let list = fs::read_to_string(data.join("val.txt")).expect("a list");
    fs::write(data.join("val.txt"), "\u{1b}[2J\u{1b}]0;title\u{7}\n").expect("written");
    let path = format!("dataset.path={}", data.display());
    let said = bench.run(&["run", &config, "--set", &path]).expect_code(2);
    assert!(said.stderr.contains("is not a clip id") && !said.stderr.contains('\u{1b}'), "{:?}", said.stderr);
    fs::write(data.join("val.txt"), list).expect("written");

    let caption = data.join(format!("texts/{first}.txt"));
    fs::write(&caption, "a person walks.#a/DET person/NOUN#0.0#0.0\nno fields here\n").expect("written");
    run(&data, &[&format!("{first}.txt:2")]);
}

#[test]
fn a_second_run_says_who_holds_the_store() {
    let bench = Bench::new(TRAINER);
    let config = Bench::config("smoke.yaml");
    let mut first = bench.spawn(&["run", &config]);
    let second = wait_for("the first run to hold the store", || {
        let said = bench.run(&["status", "-o", "json"]);
        (said.code == Some(0) && said.stdout.contains("running")).then(|| bench.run(&["run", &config]))
    });
    assert!(first.alive(), "the first run goes on");
    let second = second.expect_code(2);
    assert!(
        second.stderr.contains(&first.pid().to_string()),
        "it should name process {}:\n{}",
        first.pid(),
        second.stderr
    );
    first.kill();
    first.wait();
}
