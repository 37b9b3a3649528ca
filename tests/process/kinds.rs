//! Promises 1 and 4 for every stage kind: the digests are the same with 1, 2 and 3 workers, and with workers that die
//! in every stage. A kind that is missing in the pipeline fails the test.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use cluster_tests::cluster::{Cluster, WORKER_TOKEN};
use cluster_tests::{Bench, digests, wait_for};
use protocol::proof::SECRET_HEADER;
use protocol::stage::StageSettings;
use serde_json::{Value, json};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Kinds that read published files; they need the fixtures.
const OF_FIXTURES: [&str; 3] = ["data.open", "import.evaluator", "import.model"];

/// Real motion and the parity fixtures, if they are on this machine.
fn shared() -> Option<PathBuf> {
    fixtures::data("parity/04_evaluator_humanml")?;
    fixtures::data("humanml3d-mini")?.parent().map(Path::to_owned)
}

/// Writes the pipeline and its input files into the folder of `bench`.
fn pipeline(bench: &Bench) -> PathBuf {
    let read = |name: &str| fs::read_to_string(Bench::repository().join("tests/process").join(name)).expect(name);
    let mut text = read("kinds.yaml") + &read("kinds-rest.yaml");
    bench.run(&["data", "sample", "--format", "bvh", "--clips", "6", "recordings"]).expect_code(0);
    if let Some(shared) = shared() {
        super::bad_input::folder(&bench.path().join("folder"));
        let model = bench.path().join("evaluator/text_mot_match/model");
        let meta = bench.path().join("evaluator/Comp_v6_KLD01/meta");
        [&model, &meta].into_iter().for_each(|folder| fs::create_dir_all(folder).expect("created"));
        let pickle = shared.join("parity/04_evaluator_humanml/finest.tar");
        fs::copy(pickle, model.join("finest.tar")).expect("copied");
        for (from, to) in [("Mean.npy", "mean.npy"), ("Std.npy", "std.npy")] {
            fs::copy(shared.join("humanml3d-mini").join(from), meta.join(to)).expect("copied");
        }
        text += "  folder: {kind: data.open, format: humanml3d, path: folder}\n";
        text += "  imported: {kind: import.evaluator, path: evaluator}\n";
        fs::copy(shared.join("parity/01_vae_v2/weights.ckpt"), bench.path().join("weights.ckpt")).expect("copied");
        text += "  released: {kind: import.model, path: weights.ckpt, dataset: dataset}\n";
    }
    let path = bench.path().join("kinds.yaml");
    fs::write(&path, text).expect("written");
    path
}

fn kinds(view: &Value) -> BTreeSet<String> {
    let stages = view["stages"].as_array().expect("stages");
    stages.iter().map(|stage| stage["kind"].as_str().expect("a kind").to_owned()).collect()
}

fn run(bench: &Bench, workers: &str) -> Value {
    let path = pipeline(bench).display().to_string();
    bench.run(&["run", &path, "-o", "json", "--workers", workers]).expect_code(0).json()
}

/// The undisturbed run of one worker, with which all others are compared. It has every kind.
fn reference() -> &'static Value {
    static REFERENCE: OnceLock<Value> = OnceLock::new();
    REFERENCE.get_or_init(|| {
        let report = run(&Bench::new(TRAINER), "1");
        let all: BTreeSet<String> = StageSettings::all().iter().map(|stage| stage.kind().to_owned()).collect();
        let mut tried = kinds(&report);
        if shared().is_none() {
            tried.extend(OF_FIXTURES.map(str::to_owned));
        }
        assert_eq!(tried, all, "kinds.yaml, kinds-rest.yaml and this file together have every kind");
        report
    })
}

/// Sampled: three workers; also two with `STRIDE_LONG_TESTS=1`.
#[test]
fn p6_every_kind_has_the_same_digests_with_1_2_and_3_workers() {
    let counts: &[&str] = if fixtures::long("every kind with two workers") { &["2", "3"] } else { &["3"] };
    for workers in counts {
        let bench = Bench::new(TRAINER);
        assert_eq!(digests(&run(&bench, workers)), digests(reference()), "{workers} workers against 1");
        if *workers == "3" {
            draws_the_spectrum(&bench);
        }
    }
}

/// Checks that both panels have a line for every band, with a point for every step.
fn draws_the_spectrum(bench: &Bench) {
    bench.run(&["status", "--spectrum", "spectrum.svg"]).expect_code(0);
    let picture = fs::read_to_string(bench.path().join("spectrum.svg")).expect("the picture");
    assert_eq!((picture.matches("<polyline").count(), picture.matches("<circle").count()), (10, 80));
    assert!(picture.contains("1: 0-0.5 Hz") && picture.contains("5: over 4 Hz"), "{picture}");
    let said = bench.run(&["status", "--spectrum", "spectrum.svg", "--stage", "t2m"]).expect_code(7);
    assert!(said.stderr.contains("no finished stage"), "{}", said.stderr);
    bench.run(&["status", "--spectrum", "spectrum.jpeg"]).expect_code(2);
}

/// Runs the pipeline with one worker at a time, each of which dies at the `nth` hit of `point`. Returns the number of
/// deaths.
fn dies_at(point: &str, nth: u32) -> (Cluster, u32) {
    let mut cluster = Cluster::start(TRAINER);
    let path = pipeline(cluster.bench());
    let id = cluster.submit(&path, &[]);
    let mut deaths = 0;
    loop {
        let secret = format!("the-secret-of-process-{deaths}-known-to-this-test");
        let variables = [format!("STRIDE_WORKER_FAILPOINT={point}@{nth}"), format!("STRIDE_WORKER_SECRET={secret}")];
        cluster.join_by("w1", &[&["env".to_owned()], &variables[..]].concat(), &[]);
        let over = wait_for("the worker to die or the run to end", || {
            let ended = ["finished", "failed"].contains(&cluster.view(&id)["state"].as_str().unwrap_or_default());
            (ended || !cluster.alive("w1")).then_some(ended)
        });
        if over {
            break;
        }
        bury(&cluster, "w1", &secret);
        deaths += 1;
    }
    let view = cluster.wait_end(&id);
    assert_eq!(digests(&view), digests(reference()), "with workers dying at {point}");
    (cluster, deaths)
}

/// Reports a dead process as gone in its own name, so that its lease is not waited for.
fn bury(cluster: &Cluster, name: &str, secret: &str) {
    let workers = cluster.get("/v1/workers").expect("the coordinator is there");
    let known = workers.as_array().expect("workers").iter().find(|worker| worker["worker"] == name);
    let gone = json!({"incarnation": known.expect("a known worker")["incarnation"]}).to_string();
    let headers = [("content-type", "application/json"), (SECRET_HEADER, secret)];
    let path = format!("/v1/workers/{name}/gone");
    let reply = cluster.call_as(WORKER_TOKEN, "POST", &path, &headers, gone.as_bytes()).expect("answered");
    assert_eq!(reply.status, 200, "{:?}", reply.body);
}

/// Every training stage is lost after its first checkpoint, and after its last.
#[test]
fn p5_every_kind_that_trains_is_killed_after_each_of_its_steps() {
    let (cluster, _) = dies_at("checkpoint::after_commit", 1);
    let trains = |kind: &str| StageSettings::all().into_iter().any(|s| s.kind() == kind && s.training().is_some());
    let stages = reference()["stages"].as_array().expect("stages").iter();
    let said = cluster.said("w1");
    for stage in stages.filter(|stage| trains(stage["kind"].as_str().expect("a kind"))) {
        let name = stage["name"].as_str().expect("a name");
        let continued: BTreeSet<&str> = said
            .lines()
            .filter(|line| line.ends_with(&format!("/{name}")))
            .filter_map(|line| Some(line.split_once("continues from the checkpoint after step ")?.1))
            .collect();
        assert!(continued.len() >= 2, "{name} was not killed twice: {continued:?}");
    }
}

/// Every task of a worker, shards and merges included, is computed and lost before it is reported. Sampled: nothing; all
/// kinds with `STRIDE_LONG_TESTS=1`.
#[test]
fn p5_every_kind_is_killed_before_it_reports() {
    if !fixtures::long("a worker's death before each of its reports") {
        return;
    }
    // The first task of each worker is the one that its predecessor lost.
    let (_, deaths) = dies_at("outcome::before_report", 2);
    let stages = reference()["stages"].as_array().expect("stages");
    let of_workers = stages.iter().filter(|stage| stage["kind"] != "register").count();
    assert!(deaths as usize >= of_workers - 1, "{deaths} deaths in {of_workers} stages");
}
