//! The pause of a gang under a real coordinator, when a worker is asked to end or is killed: until all others have met
//! again, by their logs. The training is the VAE of `configs/smoke.yaml`.

use std::ffi::OsStr;
use std::time::{Duration, Instant};

use cluster_tests::Bench;
use cluster_tests::cluster::Cluster;
use cluster_tests::network::{Line, Network};
use nix::sys::signal::Signal;
use serde::Serialize;

use crate::{Plan, Result, load};

const MEMBERS: [usize; 3] = [2, 4, 8];
const ROUNDS: usize = 3;
/// More steps than the measurement lasts.
const SETS: [&str; 8] = [
    "--set",
    "stages.vae.steps=1000000",
    "--set",
    "stages.vae.windows.until=1",
    "--set",
    "stages.vae.checkpoint.every=0",
    "--until",
    "vae",
];
const PATIENCE: Duration = Duration::from_secs(120);

/// One way to lose a member.
#[derive(Debug, Serialize)]
pub(crate) struct Row {
    line: &'static str,
    /// `leaves` or `dies`.
    change: &'static str,
    /// Number of members before the change.
    members: usize,
    /// Times from the signal until all others have met in the next generation.
    pauses_ms: Vec<f64>,
    load: String,
}

fn name(who: usize) -> String {
    format!("w{who}")
}

/// Number of meetings of a worker with a gang of `members`.
fn meetings(cluster: &Cluster, who: usize, members: usize) -> usize {
    let size = format!("members={members} ");
    cluster.said(&name(who)).lines().filter(|line| line.contains("met the gang") && line.contains(&size)).count()
}

/// Waits until every one of `all` has met a gang of `members` once more than `before`.
fn await_meeting(cluster: &Cluster, all: &[usize], members: usize, before: &[usize]) -> Result {
    let begun = Instant::now();
    while all.iter().zip(before).any(|(who, before)| meetings(cluster, *who, members) <= *before) {
        if begun.elapsed() > PATIENCE {
            return Err(format!("no gang of {members} met").into());
        }
        std::thread::sleep(Duration::from_millis(4));
    }
    Ok(())
}

fn rows(trainer: &str, line: &'static str, of: Line, members: usize) -> Result<[Row; 2]> {
    let network = Network::with_lines(members, of)?;
    let mut cluster = Cluster::listen(trainer, network.coordinator());
    let config = Bench::repository().join("configs/smoke.yaml");
    let all: Vec<usize> = (0..members).collect();
    let (last, stay) = all.split_last().ok_or("no member")?;
    for who in stay {
        cluster.join_by(&name(*who), &network.inside(*who), &[]);
    }
    cluster.submit(&config, &SETS);
    await_meeting(&cluster, stay, stay.len(), &vec![0; stay.len()])?;
    let row = |change| Row { line, change, members, pauses_ms: Vec::new(), load: load() };
    let mut found = ["leaves", "dies"].map(row);
    for round in 0..2 * ROUNDS {
        let which = round % 2;
        let before: Vec<usize> = stay.iter().map(|who| meetings(&cluster, *who, members)).collect();
        cluster.join_by(&name(*last), &network.inside(*last), &[]);
        await_meeting(&cluster, stay, members, &before)?;
        // Long enough for steps and for the coordinator's work after a meeting.
        std::thread::sleep(Duration::from_secs(2));
        let before: Vec<usize> = stay.iter().map(|who| meetings(&cluster, *who, stay.len())).collect();
        let begun = Instant::now();
        cluster.signal(&name(*last), if which == 0 { Signal::SIGTERM } else { Signal::SIGKILL });
        await_meeting(&cluster, stay, stay.len(), &before)?;
        found[which].pauses_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        cluster.ended(&name(*last));
    }
    Ok(found)
}

pub(crate) fn measure(plan: &Plan, trainer: &OsStr) -> Result<Vec<Row>> {
    let trainer = trainer.to_str().ok_or("TRAINER is no text")?;
    println!("| line | members | change under a coordinator | pauses, ms | load |");
    println!("|---|---|---|---|---|");
    let mut all = Vec::new();
    for (name, line) in plan.lines() {
        for members in plan.numbers("members", &MEMBERS)?.into_iter().filter(|members| *members > 1) {
            for row in rows(trainer, name, line, members)? {
                let pauses: Vec<String> = row.pauses_ms.iter().map(|pause| format!("{pause:.0}")).collect();
                println!("| {name} | {members} | {} | {} | {} |", row.change, pauses.join(" "), row.load);
                all.push(row);
            }
        }
    }
    Ok(all)
}
