//! A training whose workers are jobs of a real Slurm, whose catalog is in PostgreSQL and whose blobs are in a bucket.

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use cluster_tests::bucket::Bucket;
use cluster_tests::cluster::{Cluster, stage_of};
use cluster_tests::postgres::Postgres;
use cluster_tests::slurm::Slurm;
use cluster_tests::{wait_for, wait_within};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::cluster::{Curves, VAE, config, equals};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
/// Time in which Slurm notices that a node is lost, and more.
const NODE_LOSS: Duration = Duration::from_secs(120);
/// Time of the whole training on a busy machine.
const TRAINING: Duration = Duration::from_secs(400);

/// A stage that lasts as long as Slurm needs for all faults, and the one before it.
fn long() -> [&'static str; 8] {
    let mut sets = VAE;
    (sets[1], sets[5]) = ("stages.vae.steps=1000", "stages.vae.checkpoint.every=200");
    sets
}

/// The same run of one worker as fast as it can, with SQLite and a folder.
fn undisturbed() -> (Value, Curves) {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join_by("w1", &["env".to_owned(), "STRIDE_WORKER_PACE=0".to_owned()], &[]);
    let run = cluster.submit(&config(), &long());
    let view = cluster.wait_end_within(TRAINING, &run);
    let curves = cluster.metrics(&run, "vae");
    (view, curves)
}

/// A running job and its node.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Job {
    id: String,
    node: String,
}

fn send(pid: u32, signal: Signal) {
    kill(Pid::from_raw(i32::try_from(pid).expect("a process")), signal).expect("the process runs");
}

/// Ends workers that are out of Slurm's reach, and the processes of the lost node that wait for them.
fn end_stranded(pattern: &str) {
    let found = Command::new("pgrep").args(["-f", pattern]).output().expect("pgrep runs");
    for worker in String::from_utf8_lossy(&found.stdout).lines().filter_map(|line| line.parse::<u32>().ok()) {
        let status = fs::read_to_string(format!("/proc/{worker}/status")).unwrap_or_default();
        let parent = status.lines().find_map(|line| line.strip_prefix("PPid:")?.trim().parse::<u32>().ok());
        let is_step =
            |pid: &u32| fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|comm| comm.contains("slurmstepd"));
        for pid in parent.filter(is_step).into_iter().chain([worker]) {
            // It may have ended by itself.
            let _ = kill(Pid::from_raw(i32::try_from(pid).expect("a process")), Signal::SIGKILL);
        }
    }
}

struct Site {
    slurm: Slurm,
    cluster: Cluster,
    run: String,
    begun: Instant,
}

impl Site {
    fn asked(&self, program: &str, arguments: &[&str]) -> String {
        self.slurm.ask(program, arguments).unwrap_or_else(|error| panic!("{program} {arguments:?}: {error}"))
    }

    /// The running jobs of the launcher; `None` while the controller does not answer.
    fn jobs(&self) -> Option<Vec<Job>> {
        let listed = self.slurm.ask("squeue", &["-h", "-p", "batch", "-t", "RUNNING", "-o", "%i %N"]).ok()?;
        let job = |line: &str| {
            let (id, node) = line.split_once(' ')?;
            Some(Job { id: id.to_owned(), node: node.trim().to_owned() })
        };
        Some(listed.lines().filter_map(job).collect())
    }

    /// Waits until `more` jobs run besides `apart`, without `lost`, and returns them.
    fn others(&self, apart: Option<&Job>, lost: Option<&Job>, more: usize, what: &str) -> Vec<Job> {
        let found = wait_within(NODE_LOSS, what, || {
            let mut jobs = self.jobs()?;
            jobs.retain(|job| Some(job) != apart);
            (jobs.len() == more && !jobs.iter().any(|job| Some(job) == lost)).then_some(jobs)
        });
        let stage = self.cluster.stage(&self.run, "vae");
        eprintln!("{:5.1} s, step {}: {what}", self.begun.elapsed().as_secs_f64(), stage["progress"]["done"]);
        assert_eq!(stage["state"], "running", "the stage outlasts this: {stage:#}");
        found
    }

    /// Like [`others`](Self::others), for one other job.
    fn other(&self, apart: Option<&Job>, lost: &Job, what: &str) -> Job {
        self.others(apart, Some(lost), 1, what).remove(0)
    }
}

/// Jobs are cancelled, preempted and drained; the controller hangs and is killed; a node is lost while its worker lives;
/// the server is killed, and its stand-by takes over. The run ends on the digests of SQLite and a folder, in one attempt,
/// with every value once.
#[test]
fn p4_whatever_slurm_does_a_training_ends_on_the_digests_of_a_folder() {
    let Some(postgres) = Postgres::start() else { return };
    let Some(slurm) = Slurm::start(3) else { return };
    let expected = undisturbed();
    let bucket = Bucket::start();
    let catalog = postgres.address(&postgres.create());
    let mut cluster = Cluster::on_bucket_with(TRAINER, &bucket, "slurm", &["--catalog", &catalog]);
    cluster.stand_by(&["--store", "second"]);
    // Its jobs inherit both. A step of 80 ms lets the stage outlast all faults on a fast machine, too.
    let variables = [format!("SLURM_CONF={}", slurm.configuration().display()), "STRIDE_WORKER_PACE=80".to_owned()];
    let wrap = [&["env".to_owned()], &variables[..]].concat();
    let name = format!("t{}", std::process::id());
    let options = ["--workers", "0..2", "--idle", "60s", "--program", TRAINER, "--", "--exclusive", "--mem=100"];
    cluster.launch(&name, &wrap, "slurm", &options);
    let run = cluster.submit(&config(), &long());
    let mut site = Site { slurm, cluster, run, begun: Instant::now() };
    site.cluster.wait_step(&site.run, "vae", 20);

    let mut jobs = site.others(None, None, 2, "two jobs for the demand");
    let (stranded, lost) = (jobs.remove(0), jobs.remove(0));
    // The controller notices this after half a minute. The worker lives on.
    send(site.slurm.pid(&format!("slurmd.{}", stranded.node)), Signal::SIGKILL);
    let taken_over = site.cluster.fail_over();
    assert!(taken_over < Duration::from_secs(15), "{taken_over:?}");
    site.asked("scancel", &[&lost.id]);
    site.other(Some(&stranded), &lost, "a job instead of a cancelled one");

    let controller = site.slurm.pid("slurmctld");
    send(controller, Signal::SIGSTOP);
    std::thread::sleep(Duration::from_secs(3));
    send(controller, Signal::SIGCONT);
    send(controller, Signal::SIGKILL);
    std::thread::sleep(Duration::from_secs(1));
    site.slurm.start_controller();
    let lost = site.other(Some(&stranded), &stranded, "the jobs after the controller hung and was killed");

    let urgent = ["-p", "urgent", "-w", &lost.node, "--exclusive", "--output=/dev/null", "--wrap", "sleep 1"];
    site.asked("sbatch", &urgent);
    let lost = site.other(Some(&stranded), &lost, "a job instead of a preempted one");
    // Its worker still works, so no job follows it.
    site.other(None, &stranded, "one job after a lost node");

    let node = format!("nodename={}", lost.node);
    site.asked("scontrol", &["update", &node, "state=drain", "reason=test"]);
    site.asked("scancel", &[&lost.id]);
    let instead = site.other(None, &lost, "a job instead of one on a drained node");
    assert_ne!(instead.node, lost.node, "a drained node takes no job");

    let Site { slurm, mut cluster, run, .. } = site;
    let view = cluster.wait_end_within(TRAINING, &run);
    let stage = stage_of(&view, "vae");
    assert_eq!((&stage["state"], stage["attempt"].as_u64()), (&Value::from("ran"), Some(1)), "{stage:#}");
    equals(&cluster, &run, &view, &expected);

    cluster.kill(&name);
    let _ = slurm.ask("scancel", &["-p", "batch"]);
    end_stranded(&format!("worker join .*{name}-"));
    wait_for("the jobs to end", || slurm.ask("squeue", &["-h", "-p", "batch"]).ok()?.is_empty().then_some(()));
}
