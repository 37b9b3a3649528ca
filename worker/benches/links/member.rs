//! A member's process. Orders come as lines by its standard input, and answers go out as lines.
//!
//! - `probe ADDRESS...` asks if the members of the gang answer, before this one joins. The answer is `ready`.
//! - `gang GENERATION NAME=ADDRESS...` names the members of the next generation.
//! - `run N` asks for N exchanges. The answer is `done MICROSECONDS,... DIGEST` of the last sum.
//! - `go` asks for exchanges without end. Each one gives a line `step MICROSECONDS GENERATION`, since 1970.
//! - `end` takes the orders back.

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::sync::Arc;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use stages::context::{Adopted, ContextError, Exchange, Rendezvous};
use worker::testing::{Context, Seat};

use crate::Result;

/// Writes a line at once. An error means that the reader has ended.
fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// A pseudorandom gradient of a slice, equal at every step.
fn gradient(slice: usize, length: usize) -> Vec<f32> {
    let mut x = (slice as u64 + 1).wrapping_mul(0xD1B5_4A32_D192_ED03);
    let next = |_| {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x >> 40) as f32 / 1e4 - 800.0
    };
    (0..length).map(next).collect()
}

/// The training loop of a stage that computes nothing.
struct Trainee {
    context: Context,
    parameters: usize,
    slices: usize,
    state: Vec<f32>,
    applied: Option<u64>,
    has_met: bool,
    parts: BTreeMap<usize, Vec<f32>>,
}

impl Trainee {
    fn meet(&mut self) -> std::result::Result<(), ContextError> {
        while !self.has_met {
            let mut at = self.applied.unwrap_or(0).to_le_bytes();
            let pieces = [&at[..], bytemuck::cast_slice(&self.state)];
            if self.context.gang().rendezvous(self.applied, &pieces)? == Rendezvous::Keep {
                self.has_met = true;
                continue;
            }
            let room = &mut [&mut at[..], bytemuck::cast_slice_mut(&mut self.state)];
            if self.context.gang().adopt(room)? == Adopted::Whole {
                self.applied = Some(u64::from_le_bytes(at));
                self.has_met = true;
            }
        }
        Ok(())
    }

    /// Makes the next step, however often the members change before its end.
    fn step(&mut self) -> std::result::Result<Vec<f32>, ContextError> {
        loop {
            self.meet()?;
            let step = self.applied.unwrap_or(0);
            let share = self.context.gang().share(self.slices);
            self.parts.retain(|slice, _| share.contains(slice));
            let length = self.parameters;
            let parts = share
                .map(|slice| (slice..slice + 1, self.parts.remove(&slice).unwrap_or_else(|| gradient(slice, length))));
            let mut parts: Vec<_> = parts.collect();
            let exchanged = self.context.gang().exchange(step..step + 1, self.slices, &mut parts)?;
            self.parts.extend(parts.into_iter().map(|(node, part)| (node.start, part)));
            match exchanged {
                Exchange::Regroup => self.has_met = false,
                Exchange::Sum { sum, .. } => {
                    self.state.iter_mut().zip(&sum).for_each(|(state, sum)| *state = *state * 0.99 + sum);
                    self.applied = Some(step + 1);
                    return Ok(sum);
                }
            }
        }
    }

    fn train(&mut self, orders: &mpsc::Receiver<String>) -> std::result::Result<(), ContextError> {
        for order in orders {
            if let Some(count) = order.strip_prefix("run ").and_then(|count| count.parse::<usize>().ok()) {
                self.meet()?;
                let mut sum = Vec::new();
                let mut took = Vec::new();
                for _ in 0..count {
                    let begun = Instant::now();
                    sum = self.step()?;
                    took.push(begun.elapsed().as_micros().to_string());
                }
                let digest = blake3::hash(bytemuck::cast_slice(&sum)).to_hex();
                say(&format!("done {} {digest}", took.join(",")));
            } else if order == "go" {
                loop {
                    self.step()?;
                    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
                    say(&format!("step {} {}", now.as_micros(), self.context.generation()));
                }
            }
        }
        Ok(())
    }
}

/// Passes the orders on: those of membership to the seat, the others to the returned queue.
fn follow(seat: &Arc<Seat>) -> mpsc::Receiver<String> {
    let (sender, receiver) = mpsc::channel();
    let seat = seat.clone();
    thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(std::io::Result::ok) {
            let mut words = line.split(' ');
            match words.next() {
                Some("gang") => {
                    let generation = words.next().and_then(|number| number.parse().ok()).unwrap_or(0);
                    let members: Vec<_> = words.filter_map(|word| word.split_once('=')).collect();
                    seat.order(generation, &members);
                }
                Some("probe") => match words.try_for_each(|address| seat.probe(address)) {
                    Ok(()) => say("ready"),
                    Err(error) => say(&format!("failed {error}")),
                },
                Some("end") => seat.dismiss(),
                _ => {
                    let _ = sender.send(line);
                }
            }
        }
        // The process that measures has ended.
        std::process::exit(0);
    });
    receiver
}

/// Runs a member: name, address, numbers of its gradient, numbers of its state for each of them, slices.
pub(crate) fn run(words: &[String]) -> Result {
    let [name, address, parameters, copies, slices] = words else { return Err("five words describe a member".into()) };
    let parameters: usize = parameters.parse()?;
    let copies: usize = copies.parse()?;
    let seat = Arc::new(Seat::listen(name, address.parse()?)?);
    let orders = follow(&seat);
    say("listens");
    let context = loop {
        match seat.context() {
            Some(context) => break context,
            None => thread::sleep(Duration::from_millis(1)),
        }
    };
    let reporter = seat.clone();
    thread::spawn(move || {
        loop {
            for lost in reporter.lost(Duration::from_secs(1)) {
                say(&format!("lost {lost}"));
            }
        }
    });
    let mut trainee = Trainee {
        context,
        parameters,
        slices: slices.parse()?,
        state: vec![0.0; parameters * copies],
        applied: None,
        has_met: false,
        parts: BTreeMap::new(),
    };
    match trainee.train(&orders) {
        Ok(()) | Err(ContextError::GrantEnded(_)) => say("ended"),
        Err(error) => say(&format!("failed {name}: {error}")),
    }
    Ok(())
}
