//! Breaks a training run on purpose, by a seed, and compares what it made with what an undisturbed run makes.
//!
//! A coordinator and three workers as processes; on average every five seconds one of them is killed, stopped for a while,
//! or cut off the network. In the end every stage must be done, with the digests of one worker that nobody disturbed, and
//! the store must be whole. See `tests/chaos.sh`.
#![expect(clippy::print_stdout, reason = "a harness prints what it did and measured")]

mod measure;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

use cluster_tests::cluster::Cluster;
use cluster_tests::network::Network;
use cluster_tests::{Bench, digests, signal, wait_for};
use nix::sys::signal::Signal;
use serde_json::Value;

use crate::measure::Kill;

/// The quickstart with fewer clips and steps, so that many seeds are affordable.
const SETS: [&str; 14] = [
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
];
const WORKERS: [&str; 3] = ["w1", "w2", "w3"];
/// Mean time between two disturbances.
const MEAN: f64 = 5.0;
/// A run that gets no further for so long, while the coordinator and a worker are there to work on it, has hung.
const STUCK: Duration = Duration::from_secs(60);
/// Every so many seeds one host is on a slow line.
const SLOW_EVERY: u64 = 4;
/// What comes to that host, in kilobits a second.
const SLOW: u32 = 4_000;
/// A run that takes longer has hung.
const LIMIT: Duration = Duration::from_secs(3600);

/// What is run: the quickstart, smaller unless `full`.
fn sets(full: bool) -> Vec<&'static str> {
    let sets: &[&str] = if full { &[] } else { &SETS };
    sets.iter().flat_map(|set| ["--set", *set]).collect()
}

fn config() -> PathBuf {
    Bench::repository().join("configs/quickstart.yaml")
}

/// SplitMix64: what happens, and when, is a function of the seed.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// In `0..1`.
    fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> Duration {
        Duration::from_secs_f64(low + self.unit() * (high - low))
    }

    fn wait(&mut self) -> Duration {
        Duration::from_secs_f64(-MEAN * (1.0 - self.unit()).ln())
    }
}

/// What ends a disturbance.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Remedy {
    /// A killed worker's successor starts.
    Join(usize),
    /// A stopped worker goes on.
    Wake(usize),
    /// A worker's link is mended.
    Mend(usize),
    Serve,
    WakeServer,
}

struct Chaos {
    cluster: Cluster,
    network: Option<Network>,
    random: Random,
    begun: Instant,
    remedies: Vec<(Instant, Remedy)>,
    /// Workers that are dead, stopped or cut off.
    down: [bool; WORKERS.len()],
    server_down: bool,
    kills: Vec<Kill>,
    counts: BTreeMap<&'static str, u32>,
}

impl Chaos {
    fn start(trainer: &str, seed: u64) -> Self {
        let network = Network::new(WORKERS.len());
        let cluster = match &network {
            Some(network) => Cluster::listen(trainer, network.coordinator()),
            None => Cluster::start(trainer),
        };
        let mut random = Random(seed);
        if let Some(network) = network.as_ref().filter(|_| seed.is_multiple_of(SLOW_EVERY)) {
            let host = (random.next() % WORKERS.len() as u64) as usize;
            if network.slow_down(host, SLOW) {
                println!("  {} is on a line of {SLOW} kbit/s", WORKERS[host]);
            }
        }
        let mut chaos = Self {
            cluster,
            network,
            random,
            begun: Instant::now(),
            remedies: Vec::new(),
            down: [false; WORKERS.len()],
            server_down: false,
            kills: Vec::new(),
            counts: BTreeMap::new(),
        };
        for i in 0..WORKERS.len() {
            chaos.join(i);
        }
        chaos
    }

    fn join(&mut self, i: usize) {
        match &self.network {
            Some(network) => self.cluster.join_by(WORKERS[i], &network.inside(i), &[]),
            None => self.cluster.join(WORKERS[i]),
        }
    }

    fn say(&mut self, what: &'static str, who: &str, how_long: Duration) {
        *self.counts.entry(what).or_default() += 1;
        println!("  {:>6.1} s  {what} {who} for {:.1} s", self.begun.elapsed().as_secs_f64(), how_long.as_secs_f64());
    }

    /// One disturbance. What is down already is left alone.
    fn disturb(&mut self, view: Option<&Value>) {
        let (dice, i) = (self.random.next() % 100, (self.random.next() % WORKERS.len() as u64) as usize);
        let now = Instant::now();
        let (what, remedy, how_long) = match dice {
            0..40 => ("kill", Remedy::Join(i), self.random.between(0.0, 4.0)),
            40..55 => ("stop", Remedy::Wake(i), self.random.between(0.5, 25.0)),
            55..75 => ("kill", Remedy::Serve, self.random.between(0.0, 6.0)),
            75..85 => ("stop", Remedy::WakeServer, self.random.between(0.5, 6.0)),
            _ => ("cut off", Remedy::Mend(i), self.random.between(1.0, 30.0)),
        };
        match remedy {
            Remedy::Join(i) | Remedy::Wake(i) | Remedy::Mend(i) if self.down[i] => return,
            Remedy::Serve | Remedy::WakeServer if self.server_down => return,
            Remedy::Mend(_) if self.network.is_none() => return,
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
            Remedy::Serve => self.cluster.kill_server(),
            Remedy::WakeServer => signal(self.cluster.server().expect("it is up"), Signal::SIGSTOP),
        }
        let who = match remedy {
            Remedy::Join(i) | Remedy::Wake(i) | Remedy::Mend(i) => {
                self.down[i] = true;
                WORKERS[i]
            }
            Remedy::Serve | Remedy::WakeServer => {
                self.server_down = true;
                "the coordinator"
            }
        };
        if let Some(last) = self.kills.last_mut()
            && remedy != Remedy::Join(i)
        {
            // A recovery that is still under way is not a measurement of that kill alone.
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
                Remedy::Serve => self.cluster.serve(),
                Remedy::WakeServer => signal(self.cluster.server().expect("it is there"), Signal::SIGCONT),
            }
            match remedy {
                Remedy::Join(i) | Remedy::Wake(i) | Remedy::Mend(i) => self.down[i] = false,
                Remedy::Serve | Remedy::WakeServer => self.server_down = false,
            }
        }
    }

    /// Disturbs until the run is over.
    fn run(&mut self, sets: &[&str]) -> Result<Value, String> {
        let run = self.cluster.submit(&config(), sets);
        let mut next = Instant::now() + self.random.wait();
        let mut view = None;
        let (mut last, mut moved) = (Vec::new(), Instant::now());
        loop {
            let newest = if self.server_down { None } else { self.cluster.get(&format!("/v1/runs/{run}")) };
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
            if Instant::now() >= next {
                self.disturb(view.as_ref());
                next = Instant::now() + self.random.wait();
            }
            for (i, name) in WORKERS.iter().enumerate() {
                if !self.down[i] && !self.cluster.alive(name) {
                    return Err(format!("worker {name} ended by itself:\n{}", self.cluster.everything()));
                }
            }
            let now = view.as_ref().map(progress).unwrap_or_default();
            if now != last || self.server_down || self.down.iter().all(|down| *down) {
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

/// How far each stage is.
fn progress(view: &Value) -> Vec<(Value, Value)> {
    let stages = view["stages"].as_array().into_iter().flatten();
    stages.map(|stage| (stage["state"].clone(), stage["progress"]["done"].clone())).collect()
}

fn one(trainer: &str, sets: &[&str], seed: u64, expected: &Value) -> Result<(), String> {
    println!("seed {seed}");
    let mut chaos = Chaos::start(trainer, seed);
    let view = chaos.run(sets)?;
    let took = chaos.begun.elapsed();
    let (found, expected) = (digests(&view), digests(expected));
    let different: Vec<&String> = expected.keys().filter(|stage| found.get(*stage) != expected.get(*stage)).collect();
    if !different.is_empty() {
        return Err(format!("seed {seed}: other digests of {different:?}:\n{found:#?}\nexpected {expected:#?}"));
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

/// How long a worker takes to join a gang that trains about 20 M parameters: weights, both moments and a moving average come from a peer,
/// over loopback.
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
    let seeds: Result<Vec<u64>, _> = arguments.map(|seed| seed.parse()).collect();
    let (Some(trainer), Ok(seeds)) = (trainer, seeds) else {
        eprintln!("usage: chaos TRAINER [--full] SEED...; `tests/chaos.sh [--full] SEED...` builds the trainer first");
        return 2.into();
    };
    let sets = sets(full);
    let trainer = std::fs::canonicalize(&trainer).map_or(trainer, |path| path.display().to_string());
    join_large(&trainer);
    let expected = reference(&trainer, &sets);
    let mut failed = Vec::new();
    for seed in &seeds {
        if let Err(message) = one(&trainer, &sets, *seed, &expected) {
            eprintln!("{message}");
            failed.push(*seed);
        }
    }
    println!("{} of {} seeds passed", seeds.len() - failed.len(), seeds.len());
    if failed.is_empty() {
        return 0.into();
    }
    eprintln!("failed: {failed:?}");
    1.into()
}
