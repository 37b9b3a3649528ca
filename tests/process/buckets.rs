//! A store whose blobs lie in a bucket: a run gives what it gives in a folder, and what stands in the way is said.

use std::fs;

use cluster_tests::bucket::Bucket;
use cluster_tests::{Bench, Running, Said, digests, states};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// A user of `bucket`.
fn user(bucket: &Bucket) -> Bench {
    Bench::new(TRAINER).with_environment(bucket.environment())
}

#[test]
fn a_run_on_a_bucket_that_is_killed_and_goes_on_gives_the_digests_of_a_folder() {
    let until = ["--workers", "2", "--until", "fid_teacher"];
    let reference = Bench::new(TRAINER).pipeline("smoke.yaml", &until);
    let bucket = Bucket::start();
    let (bench, url) = (user(&bucket), Bucket::url("runs/first"));
    let config = Bench::config("smoke.yaml");
    let arguments = [&["run", &config, "--blobs", &url][..], &until].concat();

    // An object is there, and nobody has been told.
    let mut command = bench.command(&arguments);
    command.env("STRIDE_FAILPOINT", "blob::after_rename@12");
    let killed = Running::start(command).wait();
    assert_eq!(killed.code, None, "the point was not reached:\n{}", killed.stderr);
    bench.run(&["registry", "fsck"]).expect_code(0);

    // The store remembers where its blobs are.
    let report = bench.pipeline("smoke.yaml", &until);
    assert_eq!(digests(&report), digests(&reference));
    assert!(states(&report).values().any(|state| state == "cached"), "what was done before the kill is done");
    bench.run(&["registry", "fsck"]).expect_code(0);
    assert!(bucket.objects().join("runs/first/sha256").is_dir() && !bench.store().join("blobs/sha256").exists());
    // The killed process was about to remove one, which goes once its worker has not come back for it for ten minutes.
    assert!(fs::read_dir(bench.store().join("staging")).expect("a folder").count() <= 1, "nothing is kept twice");

    let again = bench.pipeline("smoke.yaml", &until);
    assert!(states(&again).values().all(|state| matches!(state.as_str(), "cached" | "skipped")), "{again:#}");
    bench.run(&["registry", "fsck"]).expect_code(0);
}

#[test]
fn what_is_wrong_with_a_bucket_is_said() {
    let bucket = Bucket::start();
    let config = Bench::config("smoke.yaml");
    let run = |variable: (&'static str, &str), url: &str| -> Said {
        let bench = user(&bucket);
        let mut command = bench.command(&["run", &config, "--blobs", url, "--until", "vae"]);
        command.env(variable.0, variable.1);
        let said = Running::start(command).wait().expect_code(2);
        assert!(!bench.store().join("stride.db").exists(), "no store was made");
        said
    };
    let url = Bucket::url("p");
    let refused = run(("AWS_SECRET_ACCESS_KEY", "another word"), &url);
    assert!(refused.stderr.contains("access was refused"), "{}", refused.stderr);
    let missing = run(("AWS_REGION", "us-east-1"), "s3://nowhere/p");
    assert!(missing.stderr.contains("there is no bucket `nowhere`"), "{}", missing.stderr);
    let plain = run(("AWS_ALLOW_HTTP", "false"), &url);
    assert!(plain.stderr.contains("AWS_ALLOW_HTTP=true"), "{}", plain.stderr);
    let away = run(("AWS_ENDPOINT_URL", "http://127.0.0.1:9"), &url);
    assert!(away.stderr.contains("that the server runs"), "{}", away.stderr);
}
