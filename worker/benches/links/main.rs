//! Gangs on lines of a chosen bandwidth and latency. The bench prints the time of a step beside the formula of the book,
//! and the bytes that members send. It compares the bits of the sums, and times the pause when a member joins, leaves or
//! dies.
//!
//! `cargo bench -p worker --bench links`, as root. Each member is a process in a network namespace of its own. Lines are
//! shaped by `tbf` in both directions. A cable in user space delays them (`cluster_tests::cable`), below TCP, because a
//! relay of TCP streams would hide the windows and the slow start of a long line.
//!
//! Members compute nothing: a step is one exchange. Their orders come by their standard input at once, so that a pause is
//! that of the mesh alone. With `TRAINER=path`, the part `cluster` measures pauses under a real coordinator.
//!
//! Words after `--` choose parts (`exchange`, `regroups`, `cluster`), and settings narrow them:
//! `-- exchange lines=gigabit,late,slow members=2,4 parameters=250000 python=PATH json=FILE`. A Python with PyTorch adds gloo's
//! all-reduce of as many numbers, with up to four members.
#![expect(clippy::print_stdout, reason = "a bench prints what it measured")]

mod cluster;
mod exchange;
mod member;
mod process;
mod regroups;

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Duration;

use cluster_tests::network::Line;
use serde_json::{Value, json};

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Slices of a step: as many as the largest gang has members.
const SLICES: usize = 16;

/// The lines by name.
const LINES: [(&str, Line); 3] = [
    ("gigabit", Line { megabits: 1000, late: Duration::ZERO }),
    ("late", Line { megabits: 1000, late: Duration::from_millis(20) }),
    ("slow", Line { megabits: 50, late: Duration::ZERO }),
];

/// What to measure.
struct Plan {
    parts: Vec<String>,
    settings: BTreeMap<String, String>,
}

impl Plan {
    fn read(words: impl Iterator<Item = String>) -> Self {
        let (settings, parts): (Vec<_>, Vec<_>) = words.partition(|word| word.contains('='));
        let settings = settings.iter().filter_map(|word| word.split_once('='));
        let settings = settings.map(|(key, value)| (key.to_owned(), value.to_owned())).collect();
        Self { parts, settings }
    }

    fn has(&self, part: &str) -> bool {
        self.parts.is_empty() || self.parts.iter().any(|one| one == part)
    }

    fn numbers(&self, key: &str, default: &[usize]) -> Result<Vec<usize>> {
        let Some(list) = self.settings.get(key) else { return Ok(default.to_vec()) };
        list.split(',').map(|number| Ok(number.parse()?)).collect()
    }

    fn lines(&self) -> Vec<(&'static str, Line)> {
        let wanted = |name: &str| self.settings.get("lines").is_none_or(|list| list.split(',').any(|one| one == name));
        LINES.into_iter().filter(|(name, _)| wanted(name)).collect()
    }
}

/// The load of the last minute.
fn load() -> String {
    std::fs::read_to_string("/proc/loadavg").unwrap_or_default().split(' ').next().unwrap_or_default().to_owned()
}

fn measure(plan: &Plan) -> Result {
    let mut found: BTreeMap<&str, Value> = BTreeMap::new();
    if plan.has("exchange") {
        found.insert("exchange", json!(exchange::measure(plan)?));
    }
    if plan.has("regroups") {
        found.insert("regroups", json!(regroups::measure(plan)?));
    }
    if let Some(trainer) = std::env::var_os("TRAINER").filter(|_| plan.has("cluster")) {
        found.insert("cluster", json!(cluster::measure(plan, &trainer)?));
    }
    if let Some(file) = plan.settings.get("json") {
        std::fs::write(file, serde_json::to_string_pretty(&found)? + "\n")?;
    }
    Ok(())
}

fn main() -> ExitCode {
    let mut words = std::env::args().skip(1).filter(|word| word != "--bench").peekable();
    let done = if words.next_if(|word| word == "member").is_some() {
        member::run(&words.collect::<Vec<_>>())
    } else {
        measure(&Plan::read(words))
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
