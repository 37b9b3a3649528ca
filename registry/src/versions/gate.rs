//! Promotion gates: `latent_fid <= 0.2`, `eval.r_precision_top1 >= staging - 0.005`.
//!
//! `fid.upper <= 0.05` checks the upper end of the metric's 95 % interval.
//!
//! The left side is a metric of the candidate. The right side is a number, or an alias of the same model with an
//! optional number added or subtracted. An alias means the same metric of the version it points at. A missing metric or
//! NaN never passes. If the alias being promoted to does not exist yet, the gate holds, because there is no version to
//! compare with; any other unknown alias is an error.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use protocol::Alias;
use protocol::spelling::question;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A comparison operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Op {
    Le,
    Lt,
    Ge,
    Gt,
}

impl Op {
    const ALL: [(&str, Self); 4] = [("<=", Self::Le), (">=", Self::Ge), ("<", Self::Lt), (">", Self::Gt)];

    fn holds(self, left: f64, right: f64) -> bool {
        match self {
            Self::Le => left <= right,
            Self::Lt => left < right,
            Self::Ge => left >= right,
            Self::Gt => left > right,
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
enum Bound {
    Number(f64),
    Alias { alias: Alias, plus: f64 },
}

/// A promotion gate.
#[derive(Debug, Clone, PartialEq)]
pub struct Gate {
    text: String,
    metric: String,
    op: Op,
    bound: Bound,
}

/// Error of a text that is not a gate.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is not a gate: {why}; expected for example `latent_fid <= 0.2` or `r_precision >= staging - 0.005`")]
pub struct ParseGateError {
    text: String,
    why: String,
}

/// Result of a gate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GateResult {
    /// The gate as written.
    pub gate: String,
    /// The candidate's value.
    pub value: Option<f64>,
    /// The bound it was compared with.
    pub bound: Option<f64>,
    /// True if the gate holds.
    pub holds: bool,
    /// Description of the result, with the distance from the bound.
    pub message: String,
}

impl FromStr for Gate {
    type Err = ParseGateError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bad = |why: String| ParseGateError { text: text.to_owned(), why };
        let (at, (sign, op)) = Op::ALL
            .iter()
            .filter_map(|op| text.find(op.0).map(|at| (at, *op)))
            .min_by_key(|(at, (sign, _))| (*at, std::cmp::Reverse(sign.len())))
            .ok_or_else(|| bad("it has none of `<=`, `<`, `>=`, `>`".into()))?;
        let metric = text[..at].trim();
        let right = text[at + sign.len()..].trim();
        if metric.is_empty() || !metric.bytes().all(|b| b.is_ascii_alphanumeric() || b"._-/@".contains(&b)) {
            return Err(bad(format!("`{metric}` is not the name of a metric")));
        }
        Ok(Self { text: text.trim().to_owned(), metric: metric.to_owned(), op, bound: bound(right).map_err(bad)? })
    }
}

fn bound(text: &str) -> Result<Bound, String> {
    if let Ok(number) = text.parse::<f64>() {
        return if number.is_finite() {
            Ok(Bound::Number(number))
        } else {
            Err(format!("`{text}` is not a finite number"))
        };
    }
    let mut parts = text.split_whitespace();
    let alias = parts.next().unwrap_or_default();
    let alias: Alias = alias.parse().map_err(|_| format!("`{alias}` is neither a number nor an alias"))?;
    let plus = match (parts.next(), parts.next(), parts.next()) {
        (None, ..) => 0.0,
        (Some(sign @ ("+" | "-")), Some(number), None) => {
            let number: f64 = number.parse().map_err(|_| format!("`{number}` is not a number"))?;
            if sign == "-" { -number } else { number }
        }
        _ => {
            return Err(format!(
                "`{text}` is neither a number, an alias, nor `ALIAS + NUMBER` with spaces around the sign"
            ));
        }
    };
    if plus.is_finite() { Ok(Bound::Alias { alias, plus }) } else { Err(format!("`{text}` has no finite number")) }
}

impl fmt::Display for Gate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl Gate {
    /// Returns the alias that the gate compares with, if it has one.
    pub fn alias(&self) -> Option<&Alias> {
        match &self.bound {
            Bound::Number(_) => None,
            Bound::Alias { alias, .. } => Some(alias),
        }
    }

    /// Checks the gate on the candidate's metrics. `other` has the metrics of the version at the gate's alias; `None`
    /// if that alias is the one being promoted to and does not exist yet.
    pub fn evaluate(&self, candidate: &BTreeMap<String, f64>, other: Option<&BTreeMap<String, f64>>) -> GateResult {
        let result =
            |value, bound, holds, message| GateResult { gate: self.text.clone(), value, bound, holds, message };
        let value = match find(candidate, &self.metric) {
            Ok(value) => value,
            Err(why) => return result(None, None, false, format!("the candidate has {why}")),
        };
        let bound = match (&self.bound, other) {
            (Bound::Number(number), _) => *number,
            (Bound::Alias { alias, plus }, Some(metrics)) => match find(metrics, &self.metric) {
                Ok(value) => value + plus,
                Err(why) => return result(Some(value), None, false, format!("the version at `{alias}` has {why}")),
            },
            (Bound::Alias { alias, .. }, None) => {
                let message = format!(
                    "{} is {}; nothing to compare with: `{alias}` does not exist yet",
                    self.metric,
                    digits(value)
                );
                return result(Some(value), None, value.is_finite(), message);
            }
        };
        // NaN compares as false with everything.
        let holds = self.op.holds(value, bound);
        let mut message = format!("{} is {}, bound {}", self.metric, digits(value), digits(bound));
        if !holds {
            message += &format!(": it misses by {}", short((value - bound).abs()));
        }
        result(Some(value), Some(bound), holds, message)
    }
}

/// Rounds to six digits for messages; JSON has the full number.
fn digits(number: f64) -> f64 {
    format!("{number:.5e}").parse().unwrap_or(number)
}

/// Rounds to four digits for messages.
fn short(number: f64) -> String {
    format!("{}", format!("{number:.3e}").parse::<f64>().unwrap_or(number))
}

/// Finds a metric by its full name, or by the last parts of it if they are unique: `fid` and `fid.upper` find
/// `eval.fid` and `eval.fid.upper`.
fn find(metrics: &BTreeMap<String, f64>, name: &str) -> Result<f64, String> {
    if let Some(value) = metrics.get(name) {
        return Ok(*value);
    }
    let ends: Vec<_> =
        metrics.iter().filter(|(key, _)| key.strip_suffix(name).is_some_and(|before| before.ends_with('.'))).collect();
    match ends[..] {
        [(_, value)] => Ok(*value),
        [] if metrics.is_empty() => Err(format!("no metric `{name}`; it has no metrics")),
        [] => {
            let meant = question(name, metrics.keys().map(String::as_str));
            Err(format!("no metric `{name}`{meant}; it has {}", list(metrics.keys())))
        }
        _ => Err(format!("several metrics `{name}`: name one of {}", list(ends.into_iter().map(|(key, _)| key)))),
    }
}

fn list<'a>(names: impl Iterator<Item = &'a String>) -> String {
    names.map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

/// Returns the finite value of the metric that a model declares.
pub(crate) fn metric(metrics: &BTreeMap<String, f64>, name: &str) -> Option<f64> {
    find(metrics, name).ok().filter(|value| value.is_finite())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    fn metrics(pairs: &[(&str, f64)]) -> BTreeMap<String, f64> {
        pairs.iter().map(|(key, value)| ((*key).to_owned(), *value)).collect()
    }

    fn evaluate(gate: &str, candidate: &[(&str, f64)], other: Option<&[(&str, f64)]>) -> GateResult {
        gate.parse::<Gate>().unwrap().evaluate(&metrics(candidate), other.map(metrics).as_ref())
    }

    #[test]
    fn gates_compare_with_numbers() {
        assert!(evaluate("latent_fid<=0.2", &[("latent_fid", 0.2)], None).holds);
        assert!(!evaluate("latent_fid<0.2", &[("latent_fid", 0.2)], None).holds);
        assert!(evaluate("r >= 1e-3", &[("r", 0.5)], None).holds);
        let missed = evaluate("latent_fid <= 0.2", &[("latent_fid", 0.25)], None);
        assert!(!missed.holds && missed.message.ends_with("misses by 0.05"), "{}", missed.message);
    }

    #[test]
    fn gates_compare_with_the_version_at_an_alias() {
        assert!(evaluate("r >= staging - 0.005", &[("r", 0.496)], Some(&[("r", 0.5)])).holds);
        assert!(!evaluate("r >= staging - 0.005", &[("r", 0.494)], Some(&[("r", 0.5)])).holds);
        assert!(evaluate("r >= my-alias", &[("r", 0.5)], Some(&[("r", 0.5)])).holds);
        assert!(evaluate("r >= staging", &[("r", 0.1)], None).holds, "nothing to be worse than");
    }

    #[test]
    fn what_is_missing_or_no_number_never_passes() {
        assert!(!evaluate("r <= 1", &[], None).holds);
        assert!(!evaluate("r <= 1", &[("r", f64::NAN)], None).holds);
        assert!(!evaluate("r >= 1", &[("r", f64::NAN)], None).holds);
        assert!(!evaluate("r >= staging", &[("r", 0.1)], Some(&[])).holds);
        assert!(!evaluate("r >= staging", &[("r", f64::NAN)], None).holds);
    }

    #[test]
    fn the_last_part_of_a_name_is_enough_if_it_is_unique() {
        assert!(evaluate("fid <= 1", &[("eval.fid", 0.1)], None).holds);
        let interval = [("eval.fid", 0.1), ("eval.fid.lower", 0.08), ("eval.fid.upper", 0.12)];
        assert!(evaluate("fid.upper <= 0.12", &interval, None).holds);
        let missed = evaluate("fid.upper <= 0.11", &interval, None);
        assert!(!missed.holds && missed.message.ends_with("misses by 0.01"), "{}", missed.message);
        assert!(evaluate("fid.upper <= staging", &interval, Some(&[("eval.fid.upper", 0.2)])).holds);
        let two = evaluate("fid <= 1", &[("a.fid", 0.1), ("b.fid", 0.1)], None);
        assert!(!two.holds && two.message.contains("`a.fid`, `b.fid`"), "{}", two.message);
    }

    #[test]
    fn what_is_no_gate_is_refused() {
        for text in [
            "",
            "fid",
            "fid = 1",
            "<= 1",
            "fid <=",
            "fid <= nan",
            "fid <= inf",
            "fid <= a b",
            "fid <= x - y",
            "f d <= 1",
        ] {
            assert!(text.parse::<Gate>().is_err(), "{text}");
        }
    }
}
