//! `trainer run --verify`: equal on the machine that trained, and a difference is found.

use cluster_tests::Bench;
use protocol::message::{Grant, MetricRow};
use protocol::{Attempt, Fence, Incarnation, StageName, TaskId};
use registry::{Holder, Store, Write};
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

fn verify(bench: &Bench, more: &[&str], code: i32) -> Value {
    let config = Bench::config("smoke.yaml");
    bench.run(&[&["run", &config, "-o", "json"][..], more].concat()).expect_code(code).json()
}

/// All five training stages of the smoke pipeline, from a checkpoint to the end, and from the beginning.
#[test]
fn p5_verify_finds_everything_equal_and_then_what_was_changed() {
    let bench = Bench::new(TRAINER);
    let config = Bench::config("smoke.yaml");
    let said = bench.run(&["run", &config, "--verify"]).expect_code(2);
    assert!(said.stderr.contains(".stride"), "there is no store yet: {}", said.stderr);
    let keep: Vec<String> = ["vae", "mld", "lcm", "pcm", "evaluator"]
        .map(|stage| format!("stages.{stage}.checkpoint.keep.ended=2"))
        .into_iter()
        .flat_map(|set| ["--set".to_owned(), set])
        .collect();
    let keep: Vec<&str> = keep.iter().map(String::as_str).collect();
    bench.pipeline("smoke.yaml", &[&["--workers", "2"], &keep[..]].concat());

    let said = verify(&bench, &["--verify", "5"], 0);
    let stages = said["stages"].as_array().expect("stages");
    assert_eq!(stages.len(), 5, "{said:#}");
    for stage in stages {
        assert!(stage["from"].as_u64() > Some(0), "from a checkpoint: {stage:#}");
        assert_eq!(stage["digests"], 2, "the last state and the output: {stage:#}");
        assert!(stage["values"].as_u64() >= Some(3), "{stage:#}");
        assert_eq!(stage["differences"], serde_json::json!([]));
    }

    // The last bit of one curve's last value is changed.
    tell_otherwise(&bench.store());
    let said = bench.run(&["run", &Bench::config("smoke.yaml"), "-o", "json", "--verify", "5"]).expect_code(9);
    let report: Value = serde_json::from_str(&said.stdout).expect("one object");
    for stage in report["stages"].as_array().expect("stages") {
        let differs = stage["differences"].as_array().is_some_and(|all| !all.is_empty());
        assert_eq!(differs, stage["stage"] == "mld", "{stage:#}");
    }
    assert!(said.stderr.contains("mld"), "{}", said.stderr);
}

#[tokio::main(flavor = "current_thread")]
async fn tell_otherwise(dir: &std::path::Path) {
    let store = Store::open(dir, Holder::this_process("a test")).await.expect("the store");
    let run = store.runs().await.expect("runs")[0].run.clone();
    let stage: StageName = "mld".into();
    let curve =
        store.points(&run, &stage, Some(&["loss".into()]), registry::Page::ALL).await.expect("values").remove("loss");
    let last = *curve.expect("a curve").points.last().expect("a value");
    let value = f64::from_bits(last.value.to_bits() ^ 1);
    // Written as a later attempt, which supersedes the value.
    let task = TaskId::of(&run, &stage, None);
    let grant = Grant {
        task: task.clone(),
        attempt: Attempt(99),
        fence: Fence(1 << 20),
        worker: "w9".into(),
        incarnation: Incarnation(1),
    };
    let rows = vec![MetricRow { step: last.step, key: "loss".into(), value }];
    let fence = Write::Fence { task, fence: grant.fence };
    store.write(vec![fence, Write::Metrics { grant, rows }]).await.expect("written");
}
