//! Measures the interruption of a gang after a member is killed, from the times in the workers' logs.

use std::time::{Duration, SystemTime};

use serde_json::Value;

/// A worker that was killed.
#[derive(Debug)]
pub(crate) struct Kill {
    pub(crate) at: SystemTime,
    pub(crate) worker: &'static str,
    /// Members of its gang, including itself; empty if it was in none.
    pub(crate) members: Vec<String>,
    /// True if no other process was down.
    pub(crate) calm: bool,
    /// Time of the next disturbance of another process.
    pub(crate) disturbed: Option<SystemTime>,
}

/// The members of the training gang that includes `worker`.
pub(crate) fn gang_of(view: &Value, worker: &str) -> Vec<String> {
    let stages = view["stages"].as_array().into_iter().flatten();
    let training = stages.filter(|stage| stage["progress"]["unit"] == "steps");
    let members = training.map(|stage| {
        let names = stage["workers"].as_array().into_iter().flatten();
        names.filter_map(|name| name.as_str().map(str::to_owned)).collect::<Vec<_>>()
    });
    members.into_iter().find(|names| names.iter().any(|name| name == worker)).unwrap_or_default()
}

/// A log line that reports that a member met its gang.
#[derive(Debug)]
struct Meeting {
    at: SystemTime,
    adopted: Option<Transfer>,
}

/// A transfer of a peer's state to a member.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Transfer {
    pub(crate) bytes: f64,
    pub(crate) seconds: f64,
}

fn meetings(log: &str) -> Vec<Meeting> {
    let lines = log.lines().filter(|line| line.contains("met the gang"));
    lines
        .filter_map(|line| Some(Meeting { at: time(line.split_whitespace().next()?)?, adopted: transfer(line) }))
        .collect()
}

fn transfer(line: &str) -> Option<Transfer> {
    let number = |field: &str| line.split_whitespace().find_map(|word| word.strip_prefix(field))?.parse().ok();
    Some(Transfer { bytes: number("bytes=")?, seconds: number("seconds=")? })
}

/// The transfers of states to a worker, from its log.
pub(crate) fn transfers(log: &str) -> Vec<Transfer> {
    meetings(log).into_iter().filter_map(|meeting| meeting.adopted).collect()
}

/// Parses `2026-01-31T23:59:59.123456Z`.
fn time(text: &str) -> Option<SystemTime> {
    let (date, clock) = text.strip_suffix('Z')?.split_once('T')?;
    let mut date = date.split('-').map(|part| part.parse::<i64>().ok());
    let (year, month, day) = (date.next()??, date.next()??, date.next()??);
    let mut clock = clock.split(':');
    let (hour, minute) = (clock.next()?.parse::<i64>().ok()?, clock.next()?.parse::<i64>().ok()?);
    let second: f64 = clock.next()?.parse().ok()?;
    // Days since 1970 in the proleptic Gregorian calendar, with the year starting in March.
    let (year, month) = if month <= 2 { (year - 1, month + 9) } else { (year, month - 3) };
    let days = 365 * year + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400);
    let days = days + (153 * month + 2) / 5 + day - 1 - 719_468;
    let seconds = (days * 86_400 + hour * 3600 + minute * 60) as f64 + second;
    Some(SystemTime::UNIX_EPOCH + Duration::from_secs_f64(seconds))
}

fn spread(name: &str, mut all: Vec<f64>) {
    if all.is_empty() {
        return;
    }
    all.sort_by(f64::total_cmp);
    println!("  {name}: {} times, median {:.2} s, longest {:.2} s", all.len(), all[all.len() / 2], all[all.len() - 1]);
}

/// Prints the measured recoveries.
pub(crate) fn print(kills: &[Kill], logs: &[(&str, String)]) {
    let met: Vec<_> = logs.iter().map(|(name, log)| (*name, meetings(log))).collect();
    let mut recoveries = Vec::new();
    for kill in kills.iter().filter(|kill| kill.calm && kill.members.len() > 1) {
        let survivors = met.iter().filter(|(name, _)| *name != kill.worker && kill.members.iter().any(|m| m == name));
        let first = survivors.flat_map(|(_, all)| all).map(|met| met.at).filter(|at| *at > kill.at).min();
        if let Some(first) = first
            && kill.disturbed.is_none_or(|disturbed| disturbed > first)
        {
            recoveries.extend(first.duration_since(kill.at).map(|time| time.as_secs_f64()));
        }
    }
    spread("survivors of a kill met again", recoveries);
    let joins: Vec<Transfer> = met.iter().flat_map(|(_, all)| all).filter_map(|met| met.adopted).collect();
    let largest = joins.iter().map(|join| join.bytes).fold(0.0, f64::max) / 1e6;
    let seconds = joins.iter().map(|join| join.seconds).collect();
    spread(&format!("a joiner took over a peer's state, of {largest:.1} MB at most"), seconds);
}
