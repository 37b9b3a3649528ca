//! The time of a step and the bytes that it sends, by members, numbers and lines.

use cluster_tests::network::{Line, Network, Sent};
use serde::Serialize;

use crate::process::{Processes, Program};
use crate::{Plan, Result, load};

/// The members of a gang: powers of two, whose shares are nodes of the tree, and others.
const MEMBERS: [usize; 7] = [1, 2, 3, 4, 5, 8, 16];
/// Numbers of the gradient.
const PARAMETERS: [usize; 3] = [250_000, 2_000_000, 10_000_000];
/// Most members of gloo.
const BESIDE: usize = 4;
/// Time for the steps of a row, and how many they are.
const SECONDS: f64 = 8.0;
const STEPS: (f64, f64) = (3.0, 40.0);

/// One measured gang.
#[derive(Debug, Serialize)]
pub(crate) struct Row {
    program: &'static str,
    line: &'static str,
    members: usize,
    parameters: usize,
    steps: usize,
    /// Median over all members and steps.
    milliseconds: f64,
    formula_ms: f64,
    /// Sent by a member in a step, by the counters of its line: the mean of all.
    line_bytes: f64,
    /// Without the headers of packets: the mean, and the most.
    bytes: f64,
    most_bytes: f64,
    /// Those of a ring, without any header.
    ring_bytes: f64,
    digest: String,
    load: String,
}

/// Seconds of a step by the formula of the book, without computation.
fn formula(line: Line, members: usize, parameters: usize) -> f64 {
    if members == 1 {
        return 0.0;
    }
    ring(members, parameters) * 8.0 / (f64::from(line.megabits) * 1e6) + 2.0 * line.late.as_secs_f64()
}

/// Bytes that each member of a ring sends.
fn ring(members: usize, parameters: usize) -> f64 {
    8.0 * parameters as f64 * (members - 1) as f64 / members as f64
}

fn row(program: Program<'_>, name: &'static str, line: Line, members: usize, parameters: usize) -> Result<Row> {
    let network = Network::with_lines(members, line)?;
    let mut gang = Processes::new(&network, program, (parameters, 1));
    let all: Vec<usize> = (0..members).collect();
    all.iter().try_for_each(|who| gang.start(*who))?;
    gang.regroup(&all);
    let mut run = |steps: usize| -> Result<(Vec<f64>, String)> {
        all.iter().for_each(|who| gang.tell(*who, &format!("run {steps}")));
        let done = gang.await_from("done", &all)?;
        let digest = done[0].words[2].clone();
        if done.iter().any(|said| said.words[2] != digest) {
            return Err(format!("the sums of {members} members differ").into());
        }
        let times = done.iter().flat_map(|said| said.words[1].split(','));
        let mut times = times.map(|time| Ok(time.parse::<f64>()? / 1e6)).collect::<Result<Vec<f64>>>()?;
        times.sort_by(f64::total_cmp);
        Ok((times, digest))
    };
    let (warm, _) = run(2)?;
    let steps = (SECONDS / warm[warm.len() / 2]).clamp(STEPS.0, STEPS.1) as usize;
    let before: Vec<Sent> = all.iter().map(|who| network.sent(*who)).collect();
    let (times, digest) = run(steps)?;
    let after: Vec<Sent> = all.iter().map(|who| network.sent(*who)).collect();
    let of = |count: fn(Sent) -> u64| -> Vec<f64> {
        after
            .iter()
            .zip(&before)
            .map(|(after, before)| (count(*after) - count(*before)) as f64 / steps as f64)
            .collect()
    };
    let mean = |counts: &[f64]| counts.iter().sum::<f64>() / members as f64;
    let bytes = of(Sent::payload);
    Ok(Row {
        program: program.name(),
        line: name,
        members,
        parameters,
        steps,
        milliseconds: times[times.len() / 2] * 1e3,
        formula_ms: formula(line, members, parameters) * 1e3,
        line_bytes: mean(&of(|sent| sent.bytes)),
        bytes: mean(&bytes),
        most_bytes: bytes.iter().copied().fold(0.0, f64::max),
        ring_bytes: ring(members, parameters),
        digest,
        load: load(),
    })
}

fn print(row: &Row) {
    let over = |bytes: f64| if row.members == 1 { String::new() } else { format!("{:.3}", bytes / row.ring_bytes) };
    println!(
        "| {} | {} | {} | {} | {:.1} | {:.1} | {:.0} | {} | {} | {} | {} | {} |",
        row.program,
        row.line,
        row.members,
        row.parameters,
        row.milliseconds,
        row.formula_ms,
        row.bytes,
        over(row.line_bytes),
        over(row.bytes),
        over(row.most_bytes),
        &row.digest[..8],
        row.load
    );
}

pub(crate) fn measure(plan: &Plan) -> Result<Vec<Row>> {
    println!(
        "| program | line | members | parameters | ms | formula, ms | bytes | on the line | of a ring | most | sum | load |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|");
    let mut rows: Vec<Row> = Vec::new();
    for (name, line) in plan.lines() {
        for parameters in plan.numbers("parameters", &PARAMETERS)? {
            for members in plan.numbers("members", &MEMBERS)? {
                let made = row(Program::Stride, name, line, members, parameters)?;
                print(&made);
                let same = rows.iter().find(|one| one.program == "stride" && one.parameters == parameters);
                if same.is_some_and(|one| one.digest != made.digest) {
                    return Err(format!("{members} members have another sum").into());
                }
                rows.push(made);
                if let Some(python) = plan.settings.get("python").filter(|_| (2..=BESIDE).contains(&members)) {
                    let beside = row(Program::Gloo(python), name, line, members, parameters)?;
                    print(&beside);
                    rows.push(beside);
                }
            }
        }
    }
    Ok(rows)
}
