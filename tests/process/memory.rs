//! Memory of workers: datasets are shared, and running out of memory is reported once and not retried.

use std::fs;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use cluster_tests::cluster::stage_of;
use cluster_tests::{Bench, PATIENCE, Running, Said};
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Runs the smoke pipeline's VAE at another width, by a command inside `wrap`.
fn run(bench: &Bench, width: u32, wrap: &[&str]) -> Said {
    let width = format!("stages.vae.network.width={width}");
    let config = Bench::config("smoke.yaml");
    let trainer = bench.command(&["run", &config, "--until", "vae", "--workers", "1", "--set", &width, "-o", "json"]);
    let mut command = Command::new(wrap[0]);
    command.args(&wrap[1..]).arg(trainer.get_program()).args(trainer.get_args());
    command.current_dir(bench.path()).env_remove("RUST_LOG").env("NO_COLOR", "1").process_group(0);
    Running::start(command).wait()
}

/// Checks that the stage failed for good, for this reason, after one try.
fn check(bench: &Bench, said: Said, reason: &str) {
    let said = said.expect_code(1);
    let report: Value = serde_json::from_str(&said.stdout).unwrap_or_else(|e| panic!("{e}: {}", said.stdout));
    let message = stage_of(&report, "vae")["message"].as_str().unwrap_or_default().to_owned();
    assert!(message.contains("out of memory") && message.contains(reason), "{message}\n{}", said.stderr);
    assert!(message.contains("batch"), "it should say what to do: {message}");
    let log = fs::read_to_string(bench.store().join("workers/w1.log")).expect("a log");
    let begins = log.lines().filter(|line| line.contains(" begin ") && line.contains("/vae attempt=")).count();
    assert_eq!(begins, 1, "tried once:\n{log}");
}

/// A refused allocation aborts the worker.
#[test]
fn p15_a_worker_whose_allocation_is_refused_is_final() {
    if Command::new("prlimit").arg("--version").output().is_err() {
        fixtures::skip("`prlimit` bounds a worker's memory here and is not there");
        return;
    }
    let bench = Bench::new(TRAINER);
    // More than everything else here needs, and less than the 7 GB of all weights; the first weights have 1.8 GB.
    let said = run(&bench, 12_288, &["prlimit", "--as=4294967296"]);
    check(&bench, said, "was refused");
}

/// A control group with a memory limit for the processes of a wrapped command.
struct Group(PathBuf);

impl Group {
    /// Creates a group. Skips the test where groups cannot be created.
    fn new(bytes: u64) -> Option<Self> {
        let name = format!("stride-{}", std::process::id());
        // In cgroup v1 the second limit covers memory and swap together, in v2 only swap.
        let limits = [
            ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.memsw.limit_in_bytes", bytes),
            ("/sys/fs/cgroup", "memory.max", "memory.swap.max", 0),
        ];
        for (root, limit, with_swap, swapped) in limits {
            let group = Path::new(root).join(&name);
            if fs::create_dir(&group).is_err() {
                continue;
            }
            let group = Self(group);
            if fs::write(group.0.join(limit), bytes.to_string()).is_ok() {
                // Missing if the kernel does not account for swap.
                let _ = fs::write(group.0.join(with_swap), swapped.to_string());
                return Some(group);
            }
        }
        fixtures::skip("a worker that the kernel kills for want of memory needs root and control groups");
        None
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // Fails if a process still runs; the group then merely stays.
        let _ = fs::remove_dir(&self.0);
    }
}

/// The kernel kills the worker, as the largest process of a group that has used up its memory.
#[test]
fn p15_a_worker_that_the_kernel_kills_for_want_of_memory_is_final() {
    let Some(group) = Group::new(600 << 20) else { return };
    let enter = format!("echo $$ > {}/cgroup.procs && exec \"$@\"", group.0.display());
    for _ in 0..4 {
        let bench = Bench::new(TRAINER);
        // The first weights have 0.8 GB.
        let said = run(&bench, 8_192, &["sh", "-c", &enter, "sh"]);
        if said.code.is_some() {
            return check(&bench, said, "the kernel killed it");
        }
        eprintln!("the kernel took the command too, before the worker's memory was free; once more");
    }
    panic!("the kernel took the command each time");
}

/// Kilobytes of a process's own memory, and of the store's blobs that it has mapped.
fn memory(pid: u32) -> Option<(u64, u64)> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let own = status.lines().find(|line| line.starts_with("RssAnon:"))?.split_whitespace().nth(1)?.parse().ok()?;
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).ok()?;
    let blobs = maps.lines().filter(|line| line.contains("/blobs/sha256/"));
    let bytes = blobs.filter_map(|line| {
        let (from, to) = line.split(' ').next()?.split_once('-')?;
        Some(u64::from_str_radix(to, 16).ok()? - u64::from_str_radix(from, 16).ok()?)
    });
    Some((own, bytes.sum::<u64>() >> 10))
}

/// A machine holds a dataset once, for any number of workers. Sampled: three workers and about 50 MB of clips; with
/// `STRIDE_LONG_TESTS=1`, sixteen workers and 4 GB, the size of HumanML3D.
#[test]
fn p15_workers_of_a_machine_share_a_dataset() {
    let is_long = fixtures::long("sixteen workers on a dataset of 4 GB");
    let (clips, workers, own_mb) = if is_long { (42_000, 16, 400) } else { (550, 3, 40) };
    let bench = Bench::new(TRAINER);
    let pipeline = format!(
        "name: shared\nseed: 7\ndataset: {{format: synthetic, clips: {clips}, val: 0.02, test: 0.02}}\nstages:\n  \
         vae: {{kind: train.vae, latent: {{tokens: 1, dim: 16}}, network: {{width: 16, layers: 1, heads: 1, feed_forward: 16}}, \
         steps: 1000000, batch: {{global: 16, slices: 16}}, checkpoint: {{every: 1000}}}}\n"
    );
    fs::write(bench.path().join("shared.yaml"), pipeline).expect("writable");
    let mut run = bench.spawn(&["run", "shared.yaml", "--workers", &workers.to_string()]);
    let dataset_kb = || -> u64 {
        let output = Command::new("du").arg("-sk").arg(bench.store().join("blobs")).output().expect("du");
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        said.split_whitespace().next().and_then(|kb| kb.parse().ok()).unwrap_or_default()
    };
    // Sixteen workers that hash 4 GB each share a few cores.
    let until = Instant::now() + if is_long { PATIENCE * 6 } else { PATIENCE };
    let all = loop {
        assert!(run.alive() && Instant::now() < until, "all workers map the dataset and go on");
        let all: Vec<_> = run.workers().values().filter_map(|pid| memory(*pid)).collect();
        let kb = dataset_kb();
        let is_mapped = |(_, mapped): &(u64, u64)| *mapped > kb / 2;
        if all.len() == workers && kb > 20_000 && all.iter().all(is_mapped) {
            break all;
        }
        thread::sleep(Duration::from_millis(100));
    };
    let kb = dataset_kb();
    eprintln!("dataset {} MB; each worker's own and mapped memory in MB: {:?}", kb >> 10, {
        all.iter().map(|(own, mapped)| (own >> 10, mapped >> 10)).collect::<Vec<_>>()
    });
    assert!(kb >> 10 > own_mb, "the dataset is larger than what a worker may hold: {} MB", kb >> 10);
    assert!(
        all.iter().all(|(own, _)| own >> 10 < own_mb),
        "each worker holds less than {own_mb} MB of its own: {all:?}"
    );
    run.kill();
}
