//! Rules about versions and moves that are independent of the database.

use std::collections::BTreeMap;

use protocol::model_ref::is_number;
use protocol::stage::Mode;
use protocol::{Alias, ModelName};

use super::{
    Action, BEST, Expect, Gate, GateResult, LATEST, Model, ModelRef, ParseGateError, Pick, Promotion, Version, gate,
};
use crate::{QueryError, WriteError};

/// Returns the best version by the declared metric, the older one of two equals. Skips values that are not finite.
pub(crate) fn best<'a>(versions: &'a [Version], metric: &str, mode: Mode) -> Option<&'a Version> {
    let mut best: Option<(&Version, f64)> = None;
    for version in versions {
        let Some(value) = gate::metric(&version.metrics, metric) else { continue };
        let better = best.is_none_or(|(_, old)| match mode {
            Mode::Min => value < old,
            Mode::Max => value > old,
        });
        if better {
            best = Some((version, value));
        }
    }
    best.map(|(version, _)| version)
}

/// Summarises a model from its declared metric and its versions.
pub(crate) fn summary(model: ModelName, metric: Option<String>, mode: Option<Mode>, versions: &[Version]) -> Model {
    let aliases = versions.iter().flat_map(|v| v.aliases.iter().map(|alias| (alias.clone(), v.version))).collect();
    let best = metric.as_ref().zip(mode).and_then(|(metric, mode)| best(versions, metric, mode)).map(|v| v.version);
    Model { model, metric, mode, versions: versions.len() as u64, best, aliases }
}

/// Error for a model that is not among the `known` ones.
pub(crate) fn unknown(model: &ModelName, known: &[Model]) -> QueryError {
    let known: Vec<_> = known.iter().map(|m| format!("`{}`", m.model)).collect();
    let known = match known.len() {
        0 => "the registry is empty".into(),
        _ => format!("there are {}", known.join(", ")),
    };
    QueryError::NotFound(format!("no model `{model}`: {known}"))
}

/// Returns the version of a model that a reference points at.
pub(crate) fn pick(reference: &ModelRef, model: &Model, versions: &[Version]) -> Result<Version, QueryError> {
    let name = &reference.model;
    let found = match &reference.pick {
        None => {
            return Err(QueryError::Invalid(format!(
                "`{name}` has several versions; write `{name}@best`, `{name}@ALIAS` or `{name}:VERSION`"
            )));
        }
        Some(Pick::Latest) => versions.last(),
        Some(Pick::Number(number)) => versions.iter().find(|v| v.version == *number),
        Some(Pick::Alias(alias)) => versions.iter().find(|v| v.aliases.iter().any(|a| a == alias.as_str())),
        Some(Pick::Best) => {
            let (Some(metric), Some(_)) = (&model.metric, model.mode) else {
                return Err(QueryError::NotFound(format!(
                    "model `{name}` has no metric, so it has no best version; use `{name}:VERSION`, or set `metric` \
                     and `mode` in the `register` stage"
                )));
            };
            let best = model.best.and_then(|best| versions.iter().find(|v| v.version == best));
            if best.is_none() {
                return Err(QueryError::NotFound(format!(
                    "no version of `{name}` has a finite `{metric}`, so there is no best version"
                )));
            }
            best
        }
    };
    found.cloned().ok_or_else(|| {
        let mut known: Vec<_> =
            versions.iter().flat_map(|v| v.aliases.iter().map(|a| format!("`{name}@{a}`"))).collect();
        known.push(format!("`{name}:1` to `{name}:{}`", versions.len()));
        QueryError::NotFound(format!("no `{reference}`: there are {}", known.join(", ")))
    })
}

/// Refuses to move a computed alias.
pub(crate) fn refuse_reserved(alias: &Alias) -> Result<(), WriteError> {
    if matches!(alias.as_str(), BEST | LATEST) {
        return Err(WriteError::Conflict(format!(
            "`{alias}` is computed from the versions and cannot be moved; choose another alias"
        )));
    }
    if is_number(alias.as_str()) {
        return Err(WriteError::Conflict(format!(
            "`@{alias}` means version {alias} and cannot be an alias; choose another name"
        )));
    }
    Ok(())
}

/// Checks that an alias points at the version that the caller expects.
pub(crate) fn compare(
    model: &ModelName,
    alias: &Alias,
    current: Option<u64>,
    expect: Option<Expect>,
) -> Result<(), WriteError> {
    let found = current.map_or(Expect::None, Expect::Version);
    match expect {
        Some(expected) if expected != found => Err(WriteError::Conflict(format!(
            "alias `{alias}` of `{model}` points at {found}, expected {expected}: it was moved meanwhile; see \
             `registry history {model}`"
        ))),
        _ => Ok(()),
    }
}

/// Parses gates; an invalid one is a conflict.
pub(crate) fn gates(texts: &[String]) -> Result<Vec<Gate>, WriteError> {
    let gate = |text: &String| text.parse().map_err(|e: ParseGateError| WriteError::Conflict(e.to_string()));
    texts.iter().map(gate).collect()
}

/// Checks the gates of a promotion of `candidate` to `alias`. `others` has the metrics of the versions at the gates'
/// aliases. It lacks `alias` at the first promotion to it, which has no version to compare with.
pub(crate) fn evaluate(
    gates: &[Gate],
    candidate: &Version,
    alias: &Alias,
    others: &BTreeMap<Alias, BTreeMap<String, f64>>,
) -> Result<Vec<GateResult>, WriteError> {
    let result = |gate: &Gate| gate.evaluate(&candidate.metrics, gate.alias().and_then(|alias| others.get(alias)));
    let results: Vec<_> = gates.iter().map(result).collect();
    let failed: Vec<_> = results.iter().filter(|r| !r.holds).map(|r| format!("`{}`: {}", r.gate, r.message)).collect();
    if failed.is_empty() {
        return Ok(results);
    }
    Err(WriteError::Gate(format!(
        "{}:{} cannot be promoted to `{alias}`: {}",
        candidate.model,
        candidate.version,
        failed.join("; ")
    )))
}

/// Returns the version to which a rollback moves an alias: the one before its last promotion. Reads the log as a stack:
/// a promotion pushes, a rollback pops down to its target. Two rollbacks thus go back two promotions instead of
/// alternating between two versions.
pub(crate) fn previous(log: &[Promotion]) -> Option<u64> {
    let mut stack: Vec<u64> = Vec::new();
    for entry in log {
        if entry.action == Action::Rollback {
            match stack.iter().rposition(|version| *version == entry.to) {
                Some(at) => stack.truncate(at + 1),
                // `--to` named a version that the alias never had.
                None => {
                    stack.pop();
                    stack.push(entry.to);
                }
            }
        } else {
            stack.push(entry.to);
        }
    }
    stack.pop();
    stack.pop()
}
