//! Breaks a training run on purpose, by a seed, and compares its results with those of an undisturbed run.
//!
//! A coordinator and three workers run as processes. Every five seconds on average, one of them is killed, stopped for
//! a while, or cut off the network. At the end every stage must be done, with the digests of one undisturbed worker,
//! and the store must be intact. See `tests/chaos.sh`.
#![expect(clippy::print_stdout, reason = "a harness prints what it did and measured")]

mod damage;
mod hardship;
mod measure;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

use cluster_tests::cluster::Cluster;
use cluster_tests::disk::Disk;
use cluster_tests::network::Network;
use cluster_tests::{Bench, digests, signal, wait_for};
use nix::sys::signal::Signal;
use serde_json::Value;

use crate::hardship::{Hardship, Random, Seed};
use crate::measure::Kill;

/// The quickstart with fewer clips and steps, so that many seeds are affordable.
const SETS: [&str; 16] = [
    "dataset.clips=60",
    "stages.vae.steps=150",
    "stages.vae.checkpoint.every=40",
    "stages.mld.steps=200",
    "stages.mld.checkpoint.every=40",
    "stages.lcm.steps=100",
    "stages.lcm.checkpoint.every=30",
    "stages.pcm.steps=100",
    "stages.pcm.checkpoint.every=30",
    "stages.latents.crops=2",
    "stages.fid_teacher.sampler.steps=8",
    "stages.fid_teacher.repeats=1",
    "stages.fid_lcm.repeats=1",
    "stages.fid_pcm.repeats=1",
    // So few clips do not show every activity.
    "stages.activities_lcm.activities=[{name: walk, words: [walks, walking]}, {name: jump, words: [jumps, jumping]}]",
    "stages.activities.activities=[{name: walk, words: [walks, walking]}, {name: jump, words: [jumps, jumping]}]",
];
const WORKERS: [&str; 3] = ["w1", "w2", "w3"];
/// Mean time between two disturbances.
const MEAN: f64 = 5.0;
/// Time without progress after which a run has hung, while the coordinator and a worker are available.
const STUCK: Duration = Duration::from_secs(60);
/// Bandwidth towards a host on a slow line, in kilobits per second.
const SLOW: u32 = 4_000;
/// Bandwidth of a line of 30 KB/s.
const CRAWL: u32 = 240;
/// Duration after which a run has hung.
const LIMIT: Duration = Duration::from_secs(3600);

/// Settings of the run: the quickstart, smaller unless `full`.
fn sets(full: bool) -> Vec<&'static str> {
    let sets: &[&str] = if full { &[] } else { &SETS };
    sets.iter().flat_map(|set| ["--set", *set]).collect()
}

fn config() -> PathBuf {
    Bench::repository().join("configs/quickstart.yaml")
}

fn between(random: &mut Random, low: f64, high: f64) -> Duration {
    Duration::from_secs_f64(low + random.unit() * (high - low))
}

/// Draws the time to the next disturbance.
fn wait(random: &mut Random) -> Duration {
    Duration::from_secs_f64(-MEAN * (1.0 - random.unit()).ln())
}

/// The end of a disturbance.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Remedy {
    /// Starts the successor of a killed worker.
    Join(usize),
    /// Continues a stopped worker.
    Wake(usize),
    /// Restores a worker's link.
    Mend(usize),
    /// Lets a worker's messages reach the others again.
    Unmute(usize),
    Serve,
    WakeServer,
    /// Frees the space of a full disk.
    Empty,
    /// Resumes a paused disk.
    Resume,
}

struct Chaos {
    cluster: Cluster,
    /// The store's own disk. Declared after the cluster, so that no process holds it when it is dropped.
    disk: Option<Disk>,
    hardship: Hardship,
    /// The worker that refuses connections.
    refuses: Option<usize>,
    network: Option<Network>,
    random: Random,
    begun: Instant,
    remedies: Vec<(Instant, Remedy)>,
    /// Workers that are dead, stopped or cut off.
    down: [bool; WORKERS.len()],
    server_down: bool,
    disk_down: bool,
    kills: Vec<Kill>,
    counts: BTreeMap<&'static str, u32>,
}

impl Chaos {
    fn start(trainer: &str, Seed { hardship, number }: Seed) -> Self {
        let network = Network::new(WORKERS.len());
        let disk = hardship.needs_disk().then(Disk::new).flatten();
        let address = network.as_ref().map_or_else(Cluster::free_address, Network::coordinator);
        let cluster = Cluster::listen_on(trainer, address, disk.as_ref().map(Disk::path).as_deref());
        let mut random = Random(number);
        let line = match hardship {
            Hardship::Slow => Some(SLOW),
            Hardship::Crawl => Some(CRAWL),
            _ => None,
        };
        if let (Some(network), Some(kilobits)) = (&network, line) {
            let host = random.index(WORKERS.len());
            if network.slow_down(host, kilobits) {
                println!("  {} is on a line of {kilobits} kbit/s", WORKERS[host]);
            }
        }
        let refuses = (hardship == Hardship::Refuse).then(|| random.index(WORKERS.len()));
        if let Some(i) = refuses {
            println!("  nobody can connect to {}", WORKERS[i]);
        }
        let mut chaos = Self {
            cluster,
            disk,
            hardship,
            refuses,
            network,
            random,
            begun: Instant::now(),
            remedies: Vec::new(),
            down: [false; WORKERS.len()],
            server_down: false,
            disk_down: false,
            kills: Vec::new(),
            counts: BTreeMap::new(),
        };
        for i in 0..WORKERS.len() {
            chaos.join(i);
        }
        chaos
    }

    fn join(&mut self, i: usize) {
        let wrap = self.network.as_ref().map(|network| network.inside(i)).unwrap_or_default();
        // Each host has its own loopback. On one machine, the worker listens on the other address family only.
        let nowhere = format!("{}:{}", if self.network.is_some() { "127.0.0.1" } else { "[::1]" }, 7_800 + i);
        let refuses = ["--peer-address", &nowhere];
        let more = if self.refuses == Some(i) { &refuses[..] } else { &[] };
        self.cluster.join_by(WORKERS[i], &wrap, more);
    }

    fn say(&mut self, what: &'static str, who: &str, how_long: Duration) {
        *self.counts.entry(what).or_default() += 1;
        println!("  {:>6.1} s  {what} {who} for {:.1} s", self.begun.elapsed().as_secs_f64(), how_long.as_secs_f64());
    }

    /// Causes one disturbance. Does nothing if its target is already down.
    fn disturb(&mut self, view: Option<&Value>) {
        let (dice, i) = (self.random.index(100), self.random.index(WORKERS.len()));
        let now = Instant::now();
        let (what, remedy, how_long) = match dice {
            0..25 if self.hardship == Hardship::Full => ("fill", Remedy::Empty, between(&mut self.random, 1.0, 15.0)),
            0..25 if self.hardship == Hardship::Paused => {
                ("pause", Remedy::Resume, between(&mut self.random, 0.5, 15.0))
            }
            0..30 if self.hardship == Hardship::OneWay => {
                ("mute", Remedy::Unmute(i), between(&mut self.random, 1.0, 60.0))
            }
            0..40 => ("kill", Remedy::Join(i), between(&mut self.random, 0.0, 4.0)),
            40..55 => ("stop", Remedy::Wake(i), between(&mut self.random, 0.5, 25.0)),
            55..75 => ("kill", Remedy::Serve, between(&mut self.random, 0.0, 6.0)),
            75..85 => ("stop", Remedy::WakeServer, between(&mut self.random, 0.5, 6.0)),
            _ => ("cut off", Remedy::Mend(i), between(&mut self.random, 1.0, 30.0)),
        };
        match remedy {
            Remedy::Join(i) | Remedy::Wake(i) | Remedy::Mend(i) | Remedy::Unmute(i) if self.down[i] => return,
            // A process that waits for a paused disk handles no signal.
            Remedy::Serve | Remedy::WakeServer if self.server_down || self.disk_down => return,
            Remedy::Empty | Remedy::Resume if self.disk_down || self.server_down || self.disk.is_none() => return,
            Remedy::Mend(_) | Remedy::Unmute(_) if self.network.is_none() => return,
            _ => {}
        }
        match remedy {
            Remedy::Join(i) => {
                let calm = !self.server_down && self.down.iter().all(|down| !down);
                self.kills.push(Kill {
                    at: SystemTime::now(),
                    worker: WORKERS[i],
                    members: view.map(|view| measure::gang_of(view, WORKERS[i])).unwrap_or_default(),
                    calm,
                    disturbed: None,
                });
                self.cluster.kill(WORKERS[i]);
            }
            Remedy::Wake(i) => self.cluster.signal(WORKERS[i], Signal::SIGSTOP),
            Remedy::Mend(i) => self.network.as_ref().expect("looked at above").cut(i),
            Remedy::Unmute(i) => self.network.as_ref().expect("looked at above").mute(i, true),
            Remedy::Serve => self.cluster.kill_server(),
            Remedy::WakeServer => signal(self.cluster.server().expect("it is up"), Signal::SIGSTOP),
            Remedy::Empty => self.disk.as_ref().expect("looked at above").fill(),
            Remedy::Resume => self.disk.as_mut().expect("looked at above").pause(),
        }
        let who = match remedy {
            Remedy::Join(i) | Remedy::Wake(i) | Remedy::Mend(i) | Remedy::Unmute(i) => {
                self.down[i] = true;
                WORKERS[i]
            }
            Remedy::Serve | Remedy::WakeServer => {
                self.server_down = true;
                "the coordinator"
            }
            Remedy::Empty | Remedy::Resume => {
                self.disk_down = true;
                "the disk"
            }
        };
        if let Some(last) = self.kills.last_mut()
            && remedy != Remedy::Join(i)
        {
            // A recovery under way after this is no measurement of that kill alone.
            last.disturbed.get_or_insert(SystemTime::now());
        }
        self.say(what, who, how_long);
        self.remedies.push((now + how_long, remedy));
    }

    fn mend(&mut self, all: bool) {
        let now = Instant::now();
        let due: Vec<Remedy> = self.remedies.iter().filter(|(at, _)| all || *at <= now).map(|(_, r)| *r).collect();
        self.remedies.retain(|(at, _)| !all && *at > now);
        for remedy in due {
            match remedy {
                Remedy::Join(i) => self.join(i),
                Remedy::Wake(i) => self.cluster.signal(WORKERS[i], Signal::SIGCONT),
                Remedy::Mend(i) => self.network.as_ref().expect("it was cut").mend(i),
                Remedy::Unmute(i) => self.network.as_ref().expect("it was muted").mute(i, false),
                Remedy::Serve => self.cluster.serve(),
                Remedy::WakeServer => signal(self.cluster.server().expect("it is there"), Signal::SIGCONT),
                Remedy::Empty => self.disk.as_ref().expect("it was filled").empty(),
                Remedy::Resume => self.disk.as_mut().expect("it was paused").resume(),
            }
            match remedy {
                Remedy::Join(i) | Remedy::Wake(i) | Remedy::Mend(i) | Remedy::Unmute(i) => self.down[i] = false,
                Remedy::Serve | Remedy::WakeServer => self.server_down = false,
                Remedy::Empty | Remedy::Resume => self.disk_down = false,
            }
        }
    }

    /// Restarts a coordinator that ended on a full disk. Any other end is an error.
    fn look_after_the_server(&mut self) -> Result<(), String> {
        if self.server_down || self.cluster.serving() {
            return Ok(());
        }
        if self.hardship != Hardship::Full {
            return Err(format!("the coordinator ended by itself:\n{}", self.cluster.everything()));
        }
        if !self.disk_down {
            *self.counts.entry("start after a full disk").or_default() += 1;
            self.cluster.serve();
        }
        Ok(())
    }

    /// Disturbs until the run has ended.
    fn run(&mut self, sets: &[&str]) -> Result<Value, String> {
        let run = self.cluster.submit(&config(), sets);
        let mut next = Instant::now() + wait(&mut self.random);
        let mut view = None;
        let (mut last, mut moved) = (Vec::new(), Instant::now());
        loop {
            let newest =
                if self.server_down || self.disk_down { None } else { self.cluster.get(&format!("/v1/runs/{run}")) };
            if let Some(newest) = newest {
                match newest["state"].as_str() {
                    Some("finished") => {
                        self.mend(true);
                        return Ok(newest);
                    }
                    Some("running") => view = Some(newest),
                    _ => return Err(format!("the run ended: {newest:#}\n{}", self.cluster.everything())),
                }
            }
            self.mend(false);
            self.look_after_the_server()?;
            if Instant::now() >= next {
                self.disturb(view.as_ref());
                next = Instant::now() + wait(&mut self.random);
            }
            for (i, name) in WORKERS.iter().enumerate() {
                if !self.down[i] && !self.cluster.alive(name) {
                    return Err(format!("worker {name} ended by itself:\n{}", self.cluster.everything()));
                }
            }
            let now = view.as_ref().map(progress).unwrap_or_default();
            if now != last || self.server_down || self.disk_down || self.down.iter().all(|down| *down) {
                (last, moved) = (now, Instant::now());
            }
            if moved.elapsed() > STUCK {
                return Err(format!("no progress for {STUCK:?}: {view:#?}\n{}", self.cluster.everything()));
            }
            if self.begun.elapsed() > LIMIT {
                return Err(format!("not over after {LIMIT:?}: {view:#?}\n{}", self.cluster.everything()));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Progress of each stage.
fn progress(view: &Value) -> Vec<(Value, Value)> {
    let stages = view["stages"].as_array().into_iter().flatten();
    stages.map(|stage| (stage["state"].clone(), stage["progress"]["done"].clone())).collect()
}

fn one(trainer: &str, sets: &[&str], seed: Seed, expected: &Value) -> Result<(), String> {
    println!("seed {seed}");
    let mut chaos = Chaos::start(trainer, seed);
    let view = chaos.run(sets)?;
    let took = chaos.begun.elapsed();
    let (found, expected) = (digests(&view), digests(expected));
    let different: Vec<&String> = expected.keys().filter(|stage| found.get(*stage) != expected.get(*stage)).collect();
    if !different.is_empty() {
        return Err(format!("seed {seed}: other digests of {different:?}:\n{found:#?}\nexpected {expected:#?}"));
    }
    if seed.hardship == Hardship::Damaged {
        let Chaos { cluster, random, .. } = &mut chaos;
        damage::between_runs(cluster, random, &view, |cluster| cluster.submit(&config(), sets), &WORKERS)?;
    }
    let logs = WORKERS.map(|name| (name, chaos.cluster.said(name)));
    let fsck = {
        chaos.cluster.kill_server();
        chaos.cluster.bench().run(&["registry", "fsck"])
    };
    if fsck.code != Some(0) {
        return Err(format!("seed {seed}: fsck says {:?}\n{}{}", fsck.code, fsck.stdout, fsck.stderr));
    }
    let counts: Vec<String> = chaos.counts.iter().map(|(what, count)| format!("{count} x {what}")).collect();
    println!(
        "  {} stages equal to the undisturbed run, fsck clean, {:.0} s; {}",
        expected.len(),
        took.as_secs_f64(),
        counts.join(", ")
    );
    measure::print(&chaos.kills, &logs);
    Ok(())
}

fn reference(trainer: &str, sets: &[&str]) -> Value {
    let bench = Bench::new(trainer);
    let config = config().display().to_string();
    let said = bench.run(&[&["run", &config, "--workers", "1", "-o", "json"][..], sets].concat()).expect_code(0);
    println!("undisturbed, one worker: {:.0} s", said.took.as_secs_f64());
    said.json()
}

/// Measures the time for a worker to join a gang that trains about 20 M parameters. Weights, both moments and a moving
/// average come from a peer over loopback.
fn join_large(trainer: &str) {
    const LARGE: [&str; 9] = [
        "dataset.clips=8",
        "stages.vae.network.width=448",
        "stages.vae.network.layers=5",
        "stages.vae.network.feed_forward=672",
        "stages.vae.ema=0.99",
        "stages.vae.windows.until=1",
        "stages.vae.windows.batch=2",
        "stages.vae.batch={global: 2, slices: 2}",
        "stages.vae.steps=100000",
    ];
    let sets: Vec<&str> = LARGE.iter().flat_map(|set| ["--set", *set]).chain(["--until", "vae"]).collect();
    let mut cluster = Cluster::start(trainer);
    cluster.join("w1");
    let run = cluster.submit(&config(), &sets);
    cluster.wait_step(&run, "vae", 2);
    let joined = Instant::now();
    cluster.join("w2");
    let transfer =
        wait_for("the second worker to take over the state", || measure::transfers(&cluster.said("w2")).pop());
    println!(
        "a joiner of a gang of {:.1} M parameters took over {:.0} MB in {:.2} s; {:.1} s after its process was started it was a member",
        transfer.bytes / 16e6,
        transfer.bytes / 1e6,
        transfer.seconds,
        joined.elapsed().as_secs_f64(),
    );
}

fn main() -> std::process::ExitCode {
    let mut arguments = std::env::args().skip(1).peekable();
    let trainer = arguments.next();
    let full = arguments.next_if(|argument| argument == "--full").is_some();
    let seeds: Result<Vec<Seed>, _> = arguments.map(|seed| seed.parse()).collect();
    let (trainer, seeds) = match (trainer, seeds) {
        (Some(trainer), Ok(seeds)) => (trainer, seeds),
        (_, seeds) => {
            eprintln!("usage: chaos TRAINER [--full] [HARDSHIP:]SEED...; `tests/chaos.sh` builds the trainer first");
            if let Err(problem) = seeds {
                eprintln!("{problem}");
            }
            return 2.into();
        }
    };
    let sets = sets(full);
    let trainer = std::fs::canonicalize(&trainer).map_or(trainer, |path| path.display().to_string());
    join_large(&trainer);
    let expected = reference(&trainer, &sets);
    let mut failed = Vec::new();
    for seed in &seeds {
        if let Err(message) = one(&trainer, &sets, *seed, &expected) {
            eprintln!("{message}");
            failed.push(seed.to_string());
        }
    }
    println!("{} of {} seeds passed", seeds.len() - failed.len(), seeds.len());
    if failed.is_empty() {
        return 0.into();
    }
    eprintln!("failed: {}", failed.join(" "));
    1.into()
}
