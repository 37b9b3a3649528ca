//! Checkpoints that are large compared with everything else: their memory use, and interrupted uploads after the
//! coordinator's death.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use cluster_tests::cluster::Cluster;
use cluster_tests::{Bench, digests, wait_for};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
const MIB: u64 = 1 << 20;

fn config() -> PathBuf {
    Bench::repository().join("configs/smoke.yaml")
}

/// Settings of the smoke pipeline's VAE in another size, with the fewest steps that show the behaviour: one, a
/// checkpoint, and another.
fn large_vae(network: &str, workers: u8) -> Vec<String> {
    let sets = [
        format!("network={{width: {network}, heads: 4, dropout: 0.1}}"),
        "steps=3".to_owned(),
        "checkpoint.every=2".to_owned(),
        "windows={min: 40, max: 44, until: 1, batch: 2}".to_owned(),
        "batch={global: 2, slices: 2}".to_owned(),
        "ema=0.99".to_owned(),
        format!("workers={{min: {workers}, max: {workers}}}"),
    ];
    let sets = sets.into_iter().flat_map(|set| ["--set".to_owned(), format!("stages.vae.{set}")]);
    sets.chain(["--until".to_owned(), "vae".to_owned()]).collect()
}

fn words(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

/// Peak resident memory of a process in bytes; `None` once it is gone.
fn peak(pid: u32) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix(" kB")?.parse::<u64>().expect("a number") << 10)
}

/// Size of a stage's state in bytes, from the logs of its workers. A large one is stored in several blobs.
fn state_size(said: &str) -> u64 {
    let after = said.split("with a state of ").nth(1).unwrap_or_else(|| panic!("no stage began:\n{said}"));
    after.chars().take_while(|c| *c != ' ').filter(char::is_ascii_digit).collect::<String>().parse().expect("a number")
}

/// Log of a worker's first meeting with its gang: true if it adopted a peer's state, and its peak memory in bytes by
/// then.
fn met(cluster: &Cluster, name: &str) -> Option<(bool, u64)> {
    let said = cluster.said(name);
    let line = said.lines().find(|line| line.contains("met the gang"))?;
    let mib = line.split("peak_mib=").nth(1)?.split(' ').next()?.parse::<u64>().expect("a number");
    Some((line.contains("adopts=true"), mib * MIB))
}

/// A gang of two trains, saves and loses both its members in its last save. Two others take over the saved state,
/// publish it, and never train. `network` is the size of the VAE.
fn a_checkpoint_of(network: &str) {
    let mut cluster = Cluster::start(TRAINER);
    let idle = |cluster: &Cluster, name: &str| {
        wait_for("the worker to join", || cluster.said(name).contains(" joined").then_some(()));
        peak(cluster.pid(name)).expect("it runs")
    };
    let coordinator = cluster.server().expect("it runs");
    let dies = ["env".to_owned(), "STRIDE_WORKER_FAILPOINT=checkpoint::after_commit@2".to_owned()];
    cluster.join_by("a", &dies, &[]);
    let bare = (peak(coordinator).expect("it runs"), idle(&cluster, "a"));
    cluster.join_by("b", &dies, &[]);
    let run = cluster.submit(&config(), &words(&large_vae(network, 2)));

    let trainers = ["a", "b"].map(|name| (name, cluster.pid(name)));
    let mut trained = [0_u64; 2];
    while trainers.iter().all(|(name, _)| cluster.alive(name)) {
        for ((_, pid), most) in trainers.iter().zip(&mut trained) {
            *most = (*most).max(peak(*pid).unwrap_or_default());
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    for name in ["a", "b"] {
        cluster.kill(name);
    }

    for name in ["c", "d"] {
        cluster.join(name);
    }
    cluster.wait_end(&run);
    let state = state_size(&(cluster.said("c") + &cluster.said("d")));
    let taken = ["c", "d"].map(|name| {
        let (adopts, then) = met(&cluster, name).unwrap_or_else(|| panic!("{name}:\n{}", cluster.said(name)));
        (name, adopts, then, peak(cluster.pid(name)).expect("it runs"))
    });
    assert_eq!(
        taken.iter().filter(|(_, adopts, ..)| *adopts).count(),
        1,
        "rank 0 alone reads the checkpoint: {taken:?}"
    );

    // A checkpoint holds parameters, two moments and an average; the network holds its parameters once more.
    // What does not grow with the state, such as the allocator's segments, differs by up to 62 MiB between two workers.
    let (network, most) = (state / 4, 60 * MIB + 300 * MIB * state / (1600 * MIB));
    let over = |peak: u64, held: u64| peak.saturating_sub(held) / MIB;
    let served = peak(coordinator).expect("it runs");
    eprintln!(
        "a checkpoint of {} MiB, at most {} MiB beyond what is held: coordinator {} MiB, of which {} idle; worker idle {} MiB",
        state / MIB,
        most / MIB,
        served / MIB,
        bare.0 / MIB,
        bare.1 / MIB,
    );
    assert!(over(served, bare.0) <= most / MIB, "the coordinator");
    // The two train alike, and one of them saves.
    let [one, other] = trained;
    eprintln!("a: {} MiB at most, b: {} MiB; one of them has saved", one / MIB, other / MIB);
    assert!(one.abs_diff(other) <= most, "saving makes a difference");
    for (name, adopts, then, end) in taken {
        let held = bare.1 + state + network;
        let (how, begun, ended) =
            (if adopts { "from its peer" } else { "from the store" }, over(then, held), over(end, held));
        eprintln!("{name}: with its state {how} {} MiB, {begun} MiB beyond; in the end {ended} MiB beyond", then / MIB);
        assert!(begun <= most / MIB && ended <= most / MIB, "{name} takes over and publishes");
    }
    cluster.fsck();
}

/// Sampled: a quarter of a gigabyte; with `STRIDE_LONG_TESTS=1`, 1.6 GB with a margin of 300 MB.
#[test]
fn a_checkpoint_is_in_memory_once() {
    a_checkpoint_of("512, layers: 3, feed_forward: 1024");
    if fixtures::long("the memory of a checkpoint of 1.6 GB") {
        a_checkpoint_of("1024, layers: 5, feed_forward: 2048");
    }
}

/// The coordinator is killed while a checkpoint arrives. After its restart, the same worker continues the upload in the
/// same attempt from the bytes that had arrived.
#[test]
fn an_upload_goes_on_where_it_was_when_the_coordinator_was_killed() {
    let sets = large_vae("384, layers: 3, feed_forward: 512", 1);
    let reference = {
        let mut cluster = Cluster::start(TRAINER);
        cluster.join("w1");
        let run = cluster.submit(&config(), &words(&sets));
        cluster.wait_end(&run)
    };

    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let run = cluster.submit(&config(), &words(&sets));
    let staging = cluster.bench().store().join("staging");
    // The state is by far the largest upload.
    let arrived = || {
        let parts = fs::read_dir(&staging).ok()?.flatten();
        parts.filter_map(|part| Some(part.metadata().ok()?.len())).max()
    };
    wait_for("some of a checkpoint to arrive", || (arrived()? > 20 * MIB).then_some(()));
    cluster.kill_server();
    let there = arrived().expect("a part stays");
    assert!(there > 20 * MIB, "{there} bytes were left");
    cluster.serve();
    let view = cluster.wait_end(&run);
    assert_eq!(digests(&view), digests(&reference));
    let stage = cluster.stage(&run, "vae");
    assert_eq!(stage["attempt"], 1, "nobody had to begin anew");
    let said = cluster.said("w1");
    assert!(said.contains(&format!(" {there} of ")), "what had arrived was not sent again:\n{said}");
    cluster.fsck();
}
