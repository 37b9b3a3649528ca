//! Random points, all different. A value depends only on the seed, the stage, the trial and the setting, so that
//! another setting or trial changes no existing value.
//!
//! Points of a space of choices are drawn without replacement. Drawn numbers are rounded to five digits: they are
//! easier to read, and the last bits of a logarithm differ between machines.

use std::collections::BTreeSet;

use protocol::stage::StageSettings;
use protocol::sweep::{Domain, MAX_TRIALS, Sweep, Values};
use protocol::{Digest, Seed, StageName, canonical};
use serde_json::Value;

/// Maximum number of draws for a trial that would repeat an earlier one.
const AGAIN: u64 = 100;

/// The points of all trials; fewer than requested if the space is smaller.
pub(super) fn points(sweep: &Sweep, settings: &StageSettings, name: &StageName, seed: Seed) -> Vec<Values> {
    let count = sweep.trials();
    if let Some(all) = sweep.points().filter(|all| *all <= MAX_TRIALS) {
        let mut points = super::grid::points(sweep);
        points.sort_by_cached_key(|point| bits(seed, name, 0, 0, &canonical::digest(point).hex()));
        points.truncate(count.min(all));
        return points;
    }
    let mut points = Vec::new();
    let mut seen = BTreeSet::new();
    for trial in 0..count as u64 {
        let point = (0..AGAIN).find_map(|again| {
            let draw = |(path, domain): (&String, &Domain)| {
                let whole = sweep.setting(settings, path).is_some_and(|value| value.is_number() && !value.is_f64());
                (path.clone(), value(domain, uniform(bits(seed, name, trial, again, path)), whole))
            };
            let point: Values = sweep.space.iter().map(draw).collect();
            seen.insert(canonical::digest(&point)).then_some(point)
        });
        points.extend(point);
    }
    points
}

/// Hashes the key to 64 bits.
fn bits(seed: Seed, name: &StageName, trial: u64, again: u64, path: &str) -> u64 {
    let digest = Digest::of(format!("stride/sweep/1 {seed} {name} {trial} {again} {path}").as_bytes());
    digest.as_bytes()[..8].iter().fold(0, |number, byte| number << 8 | u64::from(*byte))
}

/// Maps 64 bits to a uniform number in [0, 1).
fn uniform(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

/// The value at quantile `share` of a domain.
fn value(domain: &Domain, share: f64, whole: bool) -> Value {
    let number = |value: f64, low: f64, high: f64| {
        if whole {
            return Value::from(value.floor().clamp(low, high) as u64);
        }
        let short: f64 = format!("{value:.4e}").parse().unwrap_or(value);
        Value::from(short.clamp(low, high))
    };
    match domain {
        Domain::Choice(values) => values[((share * values.len() as f64) as usize).min(values.len() - 1)].clone(),
        // The upper bound of whole numbers is inclusive.
        Domain::Uniform(low, high) => {
            let width = high - low + if whole { 1.0 } else { 0.0 };
            number(low + share * width, *low, *high)
        }
        Domain::LogUniform(low, high) => {
            let top = if whole { high + 1.0 } else { *high };
            number((low.ln() + share * (top.ln() - low.ln())).exp(), *low, *high)
        }
    }
}
