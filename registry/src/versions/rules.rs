//! What follows from versions and moves alone, wherever they are stored.

use std::collections::BTreeMap;

use protocol::model_ref::is_number;
use protocol::stage::Mode;
use protocol::{Alias, ModelName};

use super::{
    Action, BEST, Expect, Gate, GateResult, LATEST, Model, ModelRef, ParseGateError, Pick, Promotion, Version, gate,
};
use crate::{QueryError, WriteError};

/// The best version: by the declared metric, the older one of two equals. What is no finite number is never best.
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

/// A model as a list shows it, from what it declares and its versions.
pub(crate) fn summary(model: ModelName, metric: Option<String>, mode: Option<Mode>, versions: &[Version]) -> Model {
    let aliases = versions.iter().flat_map(|v| v.aliases.iter().map(|alias| (alias.clone(), v.version))).collect();
    let best = metric.as_ref().zip(mode).and_then(|(metric, mode)| best(versions, metric, mode)).map(|v| v.version);
    Model { model, metric, mode, versions: versions.len() as u64, best, aliases }
}

/// What is said of a model that is none of the `known` ones.
pub(crate) fn unknown(model: &ModelName, known: &[Model]) -> QueryError {
    let known: Vec<_> = known.iter().map(|m| format!("`{}`", m.model)).collect();
    let known = match known.len() {
        0 => "the registry is empty".into(),
        _ => format!("there are {}", known.join(", ")),
    };
    QueryError::NotFound(format!("no model `{model}`: {known}"))
}

/// The version of a model that a reference points at.
pub(crate) fn pick(reference: &ModelRef, model: &Model, versions: &[Version]) -> Result<Version, QueryError> {
    let name = &reference.model;
    let found = match &reference.pick {
        None => {
            return Err(QueryError::Invalid(format!(
                "`{name}` has several versions: say `{name}@best`, `{name}@ALIAS` or `{name}:VERSION`"
            )));
        }
        Some(Pick::Latest) => versions.last(),
        Some(Pick::Number(number)) => versions.iter().find(|v| v.version == *number),
        Some(Pick::Alias(alias)) => versions.iter().find(|v| v.aliases.iter().any(|a| a == alias.as_str())),
        Some(Pick::Best) => {
            let (Some(metric), Some(_)) = (&model.metric, model.mode) else {
                return Err(QueryError::NotFound(format!(
                    "model `{name}` declares no metric, so none of its versions is the best: name one as `{name}:VERSION`, or \
                     set `metric` and `mode` in the `register` stage"
                )));
            };
            let best = model.best.and_then(|best| versions.iter().find(|v| v.version == best));
            if best.is_none() {
                return Err(QueryError::NotFound(format!(
                    "no version of `{name}` has a finite `{metric}`, so none is the best"
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

/// Refuses to move what is computed.
pub(crate) fn refuse_reserved(alias: &Alias) -> Result<(), WriteError> {
    if matches!(alias.as_str(), BEST | LATEST) {
        return Err(WriteError::Conflict(format!(
            "`{alias}` is computed from the versions and cannot be moved; choose another alias"
        )));
    }
    if is_number(alias.as_str()) {
        return Err(WriteError::Conflict(format!(
            "`@{alias}` names version {alias}, so no alias may be called that; choose another alias"
        )));
    }
    Ok(())
}

/// Whether an alias points where the caller believes.
pub(crate) fn compare(
    model: &ModelName,
    alias: &Alias,
    current: Option<u64>,
    expect: Option<Expect>,
) -> Result<(), WriteError> {
    let found = current.map_or(Expect::None, Expect::Version);
    match expect {
        Some(expected) if expected != found => Err(WriteError::Conflict(format!(
            "alias `{alias}` of `{model}` points at {found}, not at {expected} as expected: somebody moved it; look at \
             `registry history {model}` and decide again"
        ))),
        _ => Ok(()),
    }
}

/// Reads gates as written.
pub(crate) fn gates(texts: &[String]) -> Result<Vec<Gate>, WriteError> {
    let gate = |text: &String| text.parse().map_err(|e: ParseGateError| WriteError::Conflict(e.to_string()));
    texts.iter().map(gate).collect()
}

/// Judges the gates of a promotion of `candidate` to `alias`. `others` has the metrics of the versions at the aliases that gates
/// name; it lacks `alias` if the first promotion to it is being judged, which has nothing to be worse than.
pub(crate) fn judge(
    gates: &[Gate],
    candidate: &Version,
    alias: &Alias,
    others: &BTreeMap<Alias, BTreeMap<String, f64>>,
) -> Result<Vec<GateResult>, WriteError> {
    let result = |gate: &Gate| gate.judge(&candidate.metrics, gate.alias().and_then(|alias| others.get(alias)));
    let results: Vec<_> = gates.iter().map(result).collect();
    let failed: Vec<_> = results.iter().filter(|r| !r.holds).map(|r| format!("`{}`: {}", r.gate, r.message)).collect();
    if failed.is_empty() {
        return Ok(results);
    }
    Err(WriteError::Gate(format!(
        "{}:{} may not become `{alias}`: {}",
        candidate.model,
        candidate.version,
        failed.join("; ")
    )))
}

/// Where an alias goes that is rolled back: to where it pointed before its last move forward. Reads the log as a stack: a promotion
/// pushes, a rollback drops down to where it went. So two rollbacks in a row go back two promotions instead of swinging between
/// two versions.
pub(crate) fn previous(log: &[Promotion]) -> Option<u64> {
    let mut stack: Vec<u64> = Vec::new();
    for entry in log {
        if entry.action == Action::Rollback {
            match stack.iter().rposition(|version| *version == entry.to) {
                Some(at) => stack.truncate(at + 1),
                // `--to` went somewhere the alias had never been.
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
