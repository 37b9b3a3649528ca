//! A store with its blobs in a bucket. A run gives the same results as in a folder, and problems are reported.

use std::fs;

use cluster_tests::bucket::{Bucket, NAME};
use cluster_tests::cluster::Cluster;
use cluster_tests::documented::{run_by, words};
use cluster_tests::{Bench, Running, Said, digests, states, wait_for};
use protocol::limits::SMALL_BLOB_BYTES;

use crate::cluster::{VAE, config, equals_reference};

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

    // Kill the process after an object is uploaded but before it is recorded.
    let mut command = bench.command(&arguments);
    command.env("STRIDE_FAILPOINT", "blob::after_rename@12");
    let killed = Running::start(command).wait();
    assert_eq!(killed.code, None, "the point was not reached:\n{}", killed.stderr);
    bench.run(&["registry", "fsck"]).expect_code(0);

    let interrupted = bench.run(&["status", "--all", "-o", "json"]).expect_code(0).json()["runs"][0].clone();
    assert!(interrupted["done"].as_u64() > Some(0), "{interrupted:#}");

    // The store remembers where its blobs are, and the same run continues.
    let report = bench.pipeline("smoke.yaml", &until);
    assert_eq!(digests(&report), digests(&reference));
    assert_eq!(report["run"], interrupted["run"]);
    bench.run(&["registry", "fsck"]).expect_code(0);
    assert!(bucket.objects().join("runs/first/sha256").is_dir() && !bench.store().join("blobs/sha256").exists());
    // Each of the two killed workers left at most one part. It is removed once its worker has been absent for ten minutes.
    assert!(fs::read_dir(bench.store().join("staging")).expect("a folder").count() <= 2, "nothing is kept twice");

    let again = bench.pipeline("smoke.yaml", &until);
    assert!(states(&again).values().all(|state| matches!(state.as_str(), "cached" | "skipped")), "{again:#}");
    bench.run(&["registry", "fsck"]).expect_code(0);
}

/// Workers without credentials read and write the bucket by signed requests. The server carries no bytes of blobs above
/// 64 KiB, and the digests are those of an undisturbed run on a folder.
#[test]
fn workers_pass_blobs_by_the_server() {
    let bucket = Bucket::start();
    let mut cluster = Cluster::on_bucket(TRAINER, &bucket, "direct");
    for name in ["w1", "w2"] {
        cluster.join(name);
    }
    let run = cluster.submit(&config(), &VAE);
    let view = cluster.wait_end(&run);
    equals_reference(&cluster, &run, &view);

    let large = walk(&bucket.objects().join("direct/sha256"))
        .iter()
        .filter(|path| fs::metadata(path).expect("an object").len() > SMALL_BLOB_BYTES)
        .count();
    assert!(large >= 3, "{large} large blobs: nothing was tested");
    let numbers = cluster.get("/metrics").expect("the server's numbers");
    let numbers = numbers.as_str().expect("a text");
    let carried: Vec<&str> = numbers.lines().filter(|line| line.starts_with("stride_blob_bytes_total")).collect();
    assert!(carried.iter().any(|line| line.contains("small")), "manifests pass through the server: {numbers}");
    assert!(!carried.iter().any(|line| line.contains("large")), "{carried:?}");
    assert!(walk(&bucket.objects().join("direct/arriving")).is_empty(), "what was sent has its name");
    cluster.kill_server();
    cluster.bench().run(&["registry", "fsck"]).expect_code(0);
}

/// Sampled: nothing; two quickstarts with `STRIDE_LONG_TESTS=1`. They use the optimised build that `TRAINER=path`
/// names, if it is set.
#[test]
fn the_quickstart_on_a_bucket_gives_the_digests_of_a_folder() {
    if !fixtures::long("the quickstart on a bucket") {
        return;
    }
    let trainer = std::env::var("TRAINER").unwrap_or_else(|_| TRAINER.to_owned());
    let reference = Bench::new(&trainer).pipeline("quickstart.yaml", &[]);
    let bucket = Bucket::start();
    let bench = Bench::new(&trainer).with_environment(bucket.environment());
    let report = bench.pipeline("quickstart.yaml", &["--blobs", &Bucket::url("quickstart")]);
    assert_eq!(digests(&report), digests(&reference));
    bench.run(&["registry", "fsck"]).expect_code(0);
    assert!(!bench.store().join("blobs/sha256").exists(), "all blobs are in the bucket");
    eprintln!("{} digests are equal", digests(&report).len());
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

/// The commands of `ops/README.md`, with our own bucket, folders and pipeline.
#[test]
fn the_commands_that_are_documented() {
    let bucket = Bucket::start();
    let bench = user(&bucket);
    let smoke = format!("{} --until vae", Bench::config("smoke.yaml"));
    let lines = run_by(&Bench::repository(), "tests/process/buckets.rs");
    let mut ran = 0;
    for line in lines {
        if let Some(variables) = line.strip_prefix("export ") {
            let known = bucket.environment();
            for variable in variables.split(' ').filter_map(|pair| pair.split_once('=')) {
                assert!(known.iter().any(|(name, _)| *name == variable.0), "{} is what the tests set", variable.0);
            }
            continue;
        }
        let line = line.replace("my-bucket", NAME).replace("configs/quickstart.yaml", &smoke);
        let line = line.replace("/backups", "backups").replace("/var/lib/stride", "served");
        let mut words = words(&line);
        if words[0] == "registry" {
            words.insert(0, "trainer".to_owned());
        }
        let arguments: Vec<&str> = words[1..].iter().map(String::as_str).collect();
        if arguments[0] == "serve" {
            let mut server = bench.spawn(&[&arguments[..], &["--bind", "127.0.0.1:0"]].concat());
            wait_for("the server to have its place in the bucket", || {
                assert!(server.alive(), "{line} ended");
                bucket.objects().join("stride/IDENTITY").exists().then_some(())
            });
            server.signal(nix::sys::signal::Signal::SIGTERM);
            let said = server.wait();
            assert_eq!(said.code, Some(0), "{}", said.stderr);
        } else {
            bench.run(&arguments).expect_code(0);
        }
        ran += 1;
    }
    assert_eq!(ran, 6, "each command, and no other");
    // The restored backup is complete.
    bench.run(&["registry", "fsck", "--store", "elsewhere"]).expect_code(0);
    let again =
        bench.run(&["run", &Bench::config("smoke.yaml"), "--until", "vae", "--store", "elsewhere", "-o", "json"]);
    let again = again.expect_code(0).json();
    assert!(states(&again).values().all(|state| matches!(state.as_str(), "cached" | "skipped")), "{again:#}");
}

/// Two folders share one bucket. Only the one that was opened last may continue, until the user chooses one.
#[test]
fn a_copy_of_the_folder_does_not_share_the_bucket() {
    let bucket = Bucket::start();
    let bench = user(&bucket);
    let config = Bench::config("smoke.yaml");
    let arguments = ["run", &config, "--until", "dataset", "--store"];
    bench.run(&[&arguments[..], &["first", "--blobs", &Bucket::url("shared")]].concat()).expect_code(0);
    let copied = Running::start({
        let mut command = std::process::Command::new("cp");
        command.args(["-a", "first", "second"]).current_dir(bench.path());
        command
    });
    copied.wait().expect_code(0);
    let objects = || walk(&bucket.objects());
    let run = |store: &str| bench.run(&[&arguments[..], &[store]].concat());

    run("first").expect_code(0);
    let before = objects();
    for refused in [run("second"), bench.run(&["registry", "gc", "--store", "second", "--grace", "0"])] {
        assert_ne!(refused.code, Some(0), "{}", refused.stdout);
        assert!(refused.stderr.contains("registry adopt"), "{}", refused.stderr);
    }
    assert_eq!(objects(), before, "nothing was collected");

    bench.run(&["registry", "adopt", "--store", "second"]).expect_code(0);
    run("second").expect_code(0);
    let refused = run("first");
    assert!(refused.code != Some(0) && refused.stderr.contains("registry adopt"), "{}", refused.stderr);
    bench.run(&["registry", "fsck", "--store", "second"]).expect_code(0);
}

/// The names of all objects that are blobs.
fn walk(dir: &std::path::Path) -> Vec<std::path::PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() { found.extend(walk(&path)) } else { found.push(path) }
    }
    found.sort();
    found
}
