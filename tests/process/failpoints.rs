//! Promises 2 and 5: `kill -9` before and after each write, fsync, rename and commit of a checkpoint or a result, then
//! the same command again. The digests are equal, and half-written data is never visible.

use cluster_tests::{Bench, Running, digests};
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Points inside the store, which is part of the trainer's own process.
const STORE: [&str; 8] = [
    "blob::before_write",
    "blob::after_write",
    "blob::before_fsync",
    "blob::after_fsync",
    "blob::before_rename",
    "blob::after_rename",
    "db::before_commit",
    "db::after_commit",
];

/// Points of a checkpoint's upload by a worker. Only the worker dies; the trainer replaces it and the same run
/// continues.
const WORKER: [&str; 6] = [
    "checkpoint::before_upload",
    "checkpoint::after_upload",
    "checkpoint::before_commit",
    "checkpoint::after_commit",
    "outcome::before_report",
    "outcome::after_report",
];

fn undisturbed() -> Value {
    Bench::new(TRAINER).pipeline("smoke.yaml", &["--workers", "1"])
}

#[test]
fn p7_the_trainer_dies_at_every_point_of_the_store() {
    let reference = undisturbed();
    for point in STORE {
        let bench = Bench::new(TRAINER);
        let config = Bench::config("smoke.yaml");
        // Late enough that training stages have begun, after the opening of the store and its first events.
        let at = if point.starts_with("db::") { 25 } else { 9 };
        let mut command = bench.command(&["run", &config, "--workers", "2"]);
        command.env("STRIDE_FAILPOINT", format!("{point}@{at}"));
        let killed = Running::start(command).wait();
        assert_eq!(killed.code, None, "{point} was not reached:\n{}", killed.stderr);
        bench.run(&["registry", "fsck"]).expect_code(0);
        let report = bench.pipeline("smoke.yaml", &["--workers", "2"]);
        assert_eq!(digests(&report), digests(&reference), "after a kill at {point}");
    }
}

#[test]
fn p7_a_worker_dies_at_every_point_of_a_checkpoint() {
    let reference = undisturbed();
    for point in WORKER {
        let bench = Bench::new(TRAINER);
        let config = Bench::config("smoke.yaml");
        let mut command = bench.command(&["run", &config, "--workers", "2", "-o", "json"]);
        // Every worker process dies there, replacements too; each first gets a little further.
        let at = if point.ends_with("_commit") { 5 } else { 12 };
        command.env("STRIDE_WORKER_FAILPOINT", format!("{point}@{at}"));
        let report = Running::start(command).wait().expect_code(0).json();
        assert_eq!(digests(&report), digests(&reference), "with workers dying at {point}");
        bench.run(&["registry", "fsck"]).expect_code(0);
    }
}

#[test]
fn a_panic_in_the_coordinator_ends_the_command_and_the_next_goes_on() {
    let reference = undisturbed();
    let bench = Bench::new(TRAINER);
    let config = Bench::config("smoke.yaml");
    let mut command = bench.command(&["run", &config, "--workers", "1"]);
    command.env("STRIDE_COORDINATOR_PANIC", "20");
    let ended = Running::start(command).wait().expect_code(3);
    assert!(ended.stderr.contains("the coordinator has failed"), "{}", ended.stderr);
    assert!(ended.stderr.contains("continues from it"), "{}", ended.stderr);
    // A server's clock alone produces a batch every second.
    let mut command = bench.command(&["serve", "--bind", "127.0.0.1:0"]);
    command.env("STRIDE_COORDINATOR_PANIC", "3");
    let ended = Running::start(command).wait().expect_code(3);
    assert!(ended.stderr.contains("the coordinator has failed"), "{}", ended.stderr);
    assert!(ended.stderr.contains("start the server again"), "{}", ended.stderr);
    let report = bench.pipeline("smoke.yaml", &["--workers", "1"]);
    assert_eq!(digests(&report), digests(&reference));
}
