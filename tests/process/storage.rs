//! A full disk and a read-only store: no half-written data, and a message with advice.

use cluster_tests::Bench;
use cluster_tests::mounted::Mounted;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

#[test]
fn p7_a_full_disk_stops_the_run_and_freeing_space_lets_it_go_on() {
    let bench = Bench::new(TRAINER);
    let disk = bench.path().join("disk");
    let Some(mounted) = Mounted::tmpfs(&disk, "size=4m") else { return };
    let (config, store) = (Bench::config("smoke.yaml"), disk.join("store").display().to_string());
    let full = bench.run(&["run", &config, "--store", &store]);
    assert!(matches!(full.code, Some(1 | 2)), "exit code {:?}\n{}", full.code, full.stderr);
    assert!(full.stderr.contains("space"), "{}", full.stderr);

    mounted.remount("size=200m");
    let report = bench.run(&["run", &config, "--store", &store, "-o", "json"]).expect_code(0).json();
    bench.run(&["registry", "fsck", "--store", &store]).expect_code(0);
    let fresh = Bench::new(TRAINER).pipeline("smoke.yaml", &[]);
    assert_eq!(cluster_tests::digests(&report), cluster_tests::digests(&fresh));
}

#[test]
fn a_read_only_store_is_refused() {
    let bench = Bench::new(TRAINER);
    let disk = bench.path().join("disk");
    let Some(mounted) = Mounted::tmpfs(&disk, "size=50m") else { return };
    mounted.remount("ro");
    let (config, store) = (Bench::config("smoke.yaml"), disk.join("store").display().to_string());
    let said = bench.run(&["run", &config, "--store", &store]).expect_code(2);
    assert!(said.stderr.to_lowercase().contains("read-only"), "{}", said.stderr);
}
