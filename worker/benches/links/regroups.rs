//! The pause of a gang when a member joins, leaves or dies, with orders that come at once.

use std::time::{Duration, SystemTime};

use cluster_tests::network::{Line, Network};
use serde::Serialize;

use crate::process::Processes;
use crate::process::Program::Stride;
use crate::{Plan, Result, load};

const MEMBERS: [usize; 4] = [2, 4, 8, 16];
const PARAMETERS: [usize; 1] = [250_000];
/// Numbers of the state for each parameter: itself and two moments.
const COPIES: usize = 3;
const ROUNDS: usize = 3;
/// Steps before each change.
const STEPS: usize = 10;

/// One change of the members.
#[derive(Debug, Serialize)]
pub(crate) struct Row {
    line: &'static str,
    /// `joins`, `leaves` or `dies`.
    change: &'static str,
    /// Members of the larger gang.
    members: usize,
    parameters: usize,
    /// Median of a step before the change and after it.
    before_ms: f64,
    after_ms: f64,
    /// From the last step before the change, or from the kill, to the first step after it: of each round, the longest of
    /// all members that stay. It includes that step.
    pauses_ms: Vec<f64>,
    load: String,
}

/// Steps of the members: the time in seconds since 1970 and the generation.
#[derive(Debug, Default)]
struct Steps(Vec<Vec<(f64, u64)>>);

impl Steps {
    fn hear(&mut self, who: usize, words: &[String]) -> Result {
        if let [word, time, generation] = words
            && word == "step"
        {
            self.0.resize_with(self.0.len().max(who + 1), Vec::new);
            self.0[who].push((time.parse::<f64>()? / 1e6, generation.parse()?));
        }
        Ok(())
    }

    /// Steps of a member in a generation.
    fn of(&self, who: usize, generation: u64) -> impl Iterator<Item = f64> {
        let steps = self.0.get(who).into_iter().flatten();
        steps.filter(move |(_, of)| *of == generation).map(|(time, _)| *time)
    }

    fn have(&self, members: &[usize], generation: u64, count: usize) -> bool {
        members.iter().all(|who| self.of(*who, generation).count() >= count)
    }
}

struct Gang<'a> {
    processes: Processes<'a>,
    steps: Steps,
}

impl Gang<'_> {
    /// Listens until all `members` have made `count` steps of a generation.
    fn await_steps(&mut self, members: &[usize], generation: u64, count: usize) -> Result {
        while !self.steps.have(members, generation, count) {
            self.listen()?;
        }
        Ok(())
    }

    /// Listens until all `members` have made another step of a generation. Steps during the start of a process are not
    /// heard.
    fn await_another_step(&mut self, members: &[usize], generation: u64) -> Result {
        let heard = |steps: &Steps| members.iter().map(|who| steps.of(*who, generation).count()).collect::<Vec<_>>();
        let before = heard(&self.steps);
        while heard(&self.steps).iter().zip(&before).any(|(now, before)| now <= before) {
            self.listen()?;
        }
        Ok(())
    }

    fn listen(&mut self) -> Result {
        let said = self.processes.next()?;
        if said.words[0] == "failed" {
            return Err(said.words.join(" ").into());
        }
        self.steps.hear(said.who, &said.words)
    }

    /// Seconds from the last step of a generation to the first one of the next: the longest of these members.
    fn pause(&self, members: &[usize], from: u64, to: u64) -> f64 {
        let of = |who: usize| Some(self.steps.of(who, to).next()? - self.steps.of(who, from).last()?);
        members.iter().filter_map(|who| of(*who)).fold(0.0, f64::max)
    }

    /// The median step of a generation.
    fn usual(&self, who: usize, generation: u64) -> f64 {
        let times: Vec<f64> = self.steps.of(who, generation).collect();
        let mut took: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        took.sort_by(f64::total_cmp);
        took.get(took.len() / 2).copied().unwrap_or_default()
    }
}

fn rows(name: &'static str, line: Line, members: usize, parameters: usize) -> Result<[Row; 3]> {
    let network = Network::with_lines(members, line)?;
    let processes = Processes::new(&network, Stride, (parameters, COPIES));
    let mut gang = Gang { processes, steps: Steps::default() };
    let stay: Vec<usize> = (0..members - 1).collect();
    let all: Vec<usize> = (0..members).collect();
    let last = members - 1;
    stay.iter().try_for_each(|who| gang.processes.start(*who))?;
    let mut few = gang.processes.regroup(&stay);
    stay.iter().for_each(|who| gang.processes.tell(*who, "go"));
    gang.await_steps(&stay, few, STEPS)?;
    let row = |change| Row {
        line: name,
        change,
        members,
        parameters,
        before_ms: 0.0,
        after_ms: 0.0,
        pauses_ms: Vec::new(),
        load: load(),
    };
    let mut found = ["joins", "leaves", "dies"].map(row);
    for round in 0..2 * ROUNDS {
        let dies = round % 2 == 1;
        gang.processes.start(last)?;
        gang.processes.prepare(last, &stay)?;
        gang.await_another_step(&stay, few)?;
        let many = gang.processes.regroup(&all);
        gang.processes.tell(last, "go");
        gang.await_steps(&all, many, STEPS)?;
        found[0].before_ms = gang.usual(0, few) * 1e3;
        found[0].after_ms = gang.usual(0, many) * 1e3;
        found[0].pauses_ms.push(gang.pause(&stay, few, many) * 1e3);
        let at = if dies {
            let killed = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?;
            gang.processes.kill(last);
            while gang.processes.next()?.words[0] != "lost" {}
            few = gang.processes.regroup(&stay);
            Some(killed)
        } else {
            few = gang.processes.regroup(&stay);
            gang.processes.tell(last, "end");
            None
        };
        gang.await_steps(&stay, few, STEPS)?;
        let row = &mut found[1 + usize::from(dies)];
        row.before_ms = gang.usual(0, many) * 1e3;
        row.after_ms = gang.usual(0, few) * 1e3;
        let pause = match at {
            // Lines that were passed over while waiting for the report are steps of before.
            Some(killed) => {
                let first = |who: &usize| gang.steps.of(*who, few).next().unwrap_or_default();
                stay.iter().map(first).fold(0.0, f64::max) - killed.as_secs_f64()
            }
            None => gang.pause(&stay, many, few),
        };
        row.pauses_ms.push(pause * 1e3);
        gang.processes.kill(last);
        // Its last lines may still be on their way, and the next process has the same number.
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(found)
}

pub(crate) fn measure(plan: &Plan) -> Result<Vec<Row>> {
    println!("| line | members | parameters | change | step before, ms | after | pauses, ms | load |");
    println!("|---|---|---|---|---|---|---|---|");
    let mut all = Vec::new();
    for (name, line) in plan.lines() {
        for parameters in plan.numbers("parameters", &PARAMETERS)? {
            for members in plan.numbers("members", &MEMBERS)?.into_iter().filter(|members| *members > 1) {
                for row in rows(name, line, members, parameters)? {
                    let pauses: Vec<String> = row.pauses_ms.iter().map(|pause| format!("{pause:.0}")).collect();
                    let Row { change, before_ms, after_ms, load, .. } = &row;
                    let pauses = pauses.join(" ");
                    println!(
                        "| {name} | {members} | {parameters} | {change} | {before_ms:.1} | {after_ms:.1} | {pauses} | {load} |"
                    );
                    all.push(row);
                }
            }
        }
    }
    Ok(all)
}
