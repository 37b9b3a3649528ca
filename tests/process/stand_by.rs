//! A coordinator whose catalog is in PostgreSQL, and a second server that stands by for it.

use std::time::Duration;

use cluster_tests::cluster::{Cluster, stage_of};
use cluster_tests::postgres::Postgres;

use crate::cluster::{VAE, config, equals_reference};

/// The store's folder of the second server; `--store` of the first is the bench's.
const SECOND: [&str; 2] = ["--store", "second"];

/// The leader is killed in the middle of a training stage of two workers. The stand-by answers at its own address, which
/// the workers know. The run ends on the digests of an undisturbed run in SQLite, with every value once.
#[test]
fn p4_a_stand_by_takes_over_in_the_middle_of_a_training_stage() {
    let Some(postgres) = Postgres::start() else { return };
    let blobs = tempfile::tempdir().expect("a folder for blobs");
    let catalog = postgres.address(&postgres.create());
    let place = blobs.path().join("blobs").display().to_string();
    let mut cluster = Cluster::start_with(env!("CARGO_BIN_EXE_trainer"), &["--catalog", &catalog, "--blobs", &place]);
    cluster.stand_by(&SECOND);
    for name in ["w1", "w2"] {
        cluster.join(name);
    }
    let run = cluster.submit(&config(), &VAE);
    cluster.wait_step(&run, "vae", 20);
    let before = cluster.address();
    let taken_over = cluster.fail_over();
    eprintln!("the stand-by answered {taken_over:?} after the leader's end");
    assert!(taken_over < Duration::from_secs(15), "{taken_over:?}");
    // A command finds the server that leads now, too.
    let both = format!("http://{before},{}", cluster.url());
    let found = cluster.bench().run(&["worker", "list", "--server", &both]).expect_code(0).stdout;
    assert!(found.contains("w1"), "{found}");
    let view = cluster.wait_end(&run);
    assert_eq!(stage_of(&view, "vae")["state"], "ran");
    equals_reference(&cluster, &run, &view);
}
