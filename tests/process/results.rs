//! `docs/results/`: runs the script that makes tables on a toy pipeline, and checks that its templates can be filled.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::Command;

use cluster_tests::Bench;
use serde_json::{Value, json};
use tables::{Source, render};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Every kind of evaluation that a template quotes, trained twice.
const TOY: &str = "name: toy
seed: 3
dataset: {format: synthetic, clips: 40, val: 0.1, test: 0.4, mirror: false}
stages:
  evaluator: {kind: train.evaluator, network: {movement: 8, motion: 8, text: 8, embedding: 8}, movement: {until: 0.5, window: 24, batch: 0}, steps: 4, batch: {global: 4, slices: 1}}
  vae_1: &vae {kind: train.vae, latent: {tokens: 2, dim: 8}, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, steps: 2, batch: {global: 4, slices: 1}}
  vae_2: *vae
  latents: {kind: encode.latents, vae: vae_1, crops: 2, shards: 1}
  mld: {kind: train.mld, vae: vae_1, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, steps: 2, batch: {global: 4, slices: 1}}
  lcm: {kind: distill.lcm, guidance: [1, 3], steps: 2, batch: {global: 4, slices: 1}}
  control: {kind: train.control, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, embedding: 16, steps: 2, batch: {global: 4, slices: 1}}
  told: {kind: evaluate.control, joints: [pelvis], percent: [100, 25], frames: [5], sampler: {steps: 1, guidance: 2}, repeats: 2, split: test, all_if_small: true, shards: 1}
  recon: {kind: evaluate.reconstruction, vae: vae_1, shards: 1}
  fid: {kind: evaluate.latent_fid, model: lcm, teacher: mld, split: all, sampler: {steps: 1, guidance: 2}, repeats: 2, components: 4, shards: 1}
  shown: {kind: evaluate.recognition, model: lcm, split: all, motions: 4, sampler: {steps: 1, guidance: 2}, activities: [{name: both hands, words: [hand, hands, arm, arms]}, {name: rest, words: [a, the, person, someone]}]}
  real: {kind: evaluate.t2m, real: true, pools: [8], repeats: 2, split: test, shards: 1}
  t2m_vae_1: {kind: evaluate.t2m, vae: vae_1, pools: [8], repeats: 2, split: test, shards: 1}
  t2m_vae_2: {kind: evaluate.t2m, vae: vae_2, pools: [8], repeats: 2, split: test, shards: 1}
  t2m: {kind: evaluate.t2m, model: lcm, sampler: {steps: 1, guidance: 2}, pools: [8], repeats: 2, multimodality: {captions: 2, samples: 3, pairs: 2}, split: test, shards: 1}
";

const TEMPLATE: &str = "{{set vae_1 steps}} steps, {{bare real samples :0}} clips
{{real fid :2}} {{t2m_vae_* fid :4}} {{t2m multimodality}} {{fid latent_fid_test}}
";

fn regenerate(dir: &Path, store: &Path, tables: &Path) -> String {
    let script = Bench::repository().join("docs/results/regenerate.sh");
    let mut command = Command::new("bash");
    command.arg(script).arg(dir.join("toy.yaml")).args(["--workers", "1", "--store"]).arg(store);
    command.env("TRAINER", TRAINER).env("TABLES", tables);
    let said = command.output().expect("bash runs");
    let stderr = String::from_utf8_lossy(&said.stderr);
    assert!(said.status.success(), "{}\n{stderr}", String::from_utf8_lossy(&said.stdout));
    fs::read_to_string(dir.join("toy.md")).expect("the text is written")
}

#[test]
fn tables_are_made_from_a_run_and_again_from_what_it_stored() {
    let tables = Path::new(TRAINER).with_file_name("tables");
    if !tables.exists() {
        fixtures::skip(&format!("no {}; build it with `cargo build --bin tables`", tables.display()));
        return;
    }
    let bench = Bench::new(TRAINER);
    let dir = bench.path();
    fs::write(dir.join("toy.yaml"), TOY).expect("a file");
    fs::write(dir.join("toy.in.md"), TEMPLATE).expect("a file");
    let text = regenerate(dir, &bench.store(), &tables);
    println!("{text}");
    let run: Value =
        serde_json::from_str(&fs::read_to_string(dir.join("toy.json")).expect("written")).expect("one JSON object");
    let samples = metrics(&run, "real")["samples"].as_f64().expect("a number");
    assert!(text.starts_with(&format!("2 steps, {samples:.0} clips\n")) && text.matches('±').count() >= 3, "{text}");
    assert_eq!(regenerate(dir, &bench.store(), &tables), text, "nothing is computed again");

    let folder = Bench::repository().join("docs/results");
    let mut shipped = 0;
    for file in fs::read_dir(&folder).expect("a folder").map(|file| file.expect("a file").file_name()) {
        if let Some(name) = file.to_str().and_then(|file| file.strip_suffix(".in.md")) {
            a_shipped_template_can_be_filled(&bench, &run, &folder.join(name));
            shipped += 1;
        }
    }
    assert!(shipped > 0, "{shipped} templates");
}

fn metrics<'a>(run: &'a Value, stage: &str) -> &'a Value {
    let stages = run["stages"].as_array().expect("stages");
    &stages.iter().find(|one| one["name"] == stage).unwrap_or_else(|| panic!("no stage `{stage}`"))["metrics"]
}

/// Names of the shares of an evaluation of activities.
fn activities(settings: &Value) -> Vec<String> {
    let all = settings["activities"].as_array().expect("activities").iter();
    all.map(|activity| format!("accuracy/{}", activity["name"].as_str().expect("a name"))).collect()
}

/// Checks that a template quotes only stages of the pipeline beside it, and only metrics that their evaluations report.
fn a_shipped_template_can_be_filled(bench: &Bench, toy: &Value, path: &Path) {
    let pipeline = path.with_extension("yaml").display().to_string();
    let pipeline = bench.run(&["config", "show", &pipeline, "-o", "json"]).expect_code(0).json();
    let with = |stage: &str, more: &[String]| -> BTreeMap<String, f64> {
        let names = metrics(toy, stage).as_object().expect("metrics").keys().cloned();
        names.chain(more.iter().cloned()).map(|name| (name, 0.5)).collect()
    };
    let stages = pipeline["stages"].as_array().expect("stages").iter().map(|stage| {
        let own = if stage["settings"].is_object() { &stage["settings"] } else { stage };
        let metrics = match own["kind"].as_str().expect("a kind") {
            "evaluate.reconstruction" if own["evaluator"] != "" => with("recon", &["fid".to_owned()]),
            "evaluate.reconstruction" => with("recon", &[]),
            "evaluate.latent_fid" => with("fid", &[]),
            "evaluate.recognition" => with("shown", &activities(own)),
            "evaluate.control" => with("told", &[]),
            "evaluate.t2m" if own["real"] == true => with("real", &[]),
            "evaluate.t2m" if own["vae"] != "" => with("t2m_vae_1", &[]),
            "evaluate.t2m" => with("t2m", &[]),
            _ => BTreeMap::new(),
        };
        json!({"name": stage["name"], "metrics": metrics, "wall_s": 1.0})
    });
    let run = json!({"stages": stages.collect::<Vec<_>>()});
    let template = fs::read_to_string(path.with_extension("in.md")).expect("the template");
    let text = render(&template, &Source { run, pipeline: pipeline.clone() }).unwrap_or_else(|why| panic!("{why}"));
    let columns: BTreeSet<usize> =
        text.lines().filter(|line| line.starts_with("| ")).map(|l| l.matches('|').count()).collect();
    assert!(!text.contains("{{") && columns.iter().all(|columns| (3..=9).contains(columns)), "{columns:?}");

    // The page beside it, which the book includes, is the text that the stored run gives.
    if let Ok(stored) = fs::read_to_string(path.with_extension("json")) {
        let run = serde_json::from_str(&stored).expect("it is JSON");
        let text = render(&template, &Source { run, pipeline }).unwrap_or_else(|why| panic!("{why}"));
        let page = fs::read_to_string(path.with_extension("md")).expect("the page");
        assert!(page == text, "{0}.md is not what {0}.json gives; run regenerate.sh", path.display());
    }
}
