//! Reasons why a run's stages were computed: the difference to the previous run of the pipeline, in data and in words.
//!
//! The words are made here alone. The page, the command line and the Python client show them as they are.

use std::collections::{BTreeMap, BTreeSet};

use protocol::StageName;
use protocol::message::{RunView, StageState};
use serde_json::Value;

use super::run_settings::{ReasonKind, RunSettings, SettingChange, SettingsOfStage, StageReason};

/// Changed settings that the words name; the others are counted.
const NAMED: usize = 2;
/// Below this, a number is written with an exponent.
const SMALL: f64 = 0.01;

/// Adds a reason to each stage of `now`, a run whose view is `view`.
pub(super) fn explain(now: &mut RunSettings, view: &RunView, before: Option<&RunSettings>) {
    let earlier: BTreeMap<&StageName, &SettingsOfStage> =
        before.iter().flat_map(|before| &before.stages).map(|stage| (&stage.stage, stage)).collect();
    let is_same_seed = before.is_none_or(|before| before.seed == now.seed);
    let mut differ = BTreeSet::new();
    // The stages are in topological order.
    for stage in &mut now.stages {
        let Some(shown) = view.stages.iter().find(|shown| shown.name == stage.stage) else { continue };
        let inputs: Vec<StageName> = shown.needs.iter().filter(|name| differ.contains(*name)).cloned().collect();
        let old = earlier.get(&stage.stage).copied();
        let changes = old.map(|old| changes(&old.settings, &stage.settings)).unwrap_or_default();
        let kind = match old {
            None => ReasonKind::New,
            Some(_) if !changes.is_empty() => ReasonKind::Changed,
            Some(old) if old.code != stage.code => ReasonKind::Code,
            Some(_) if !is_same_seed => ReasonKind::Seed,
            Some(_) if !inputs.is_empty() => ReasonKind::Input,
            Some(old) => match (old.key, stage.key) {
                (Some(old), Some(new)) if old == new => ReasonKind::Same,
                (Some(_), Some(_)) => ReasonKind::Input,
                (None, _) | (_, None) => ReasonKind::Unknown,
            },
        };
        if !matches!(kind, ReasonKind::Same | ReasonKind::Unknown) {
            differ.insert(stage.stage.clone());
        }
        let mut reason = StageReason { kind, changes, inputs, text: String::new() };
        reason.text = in_words(&reason, stage, shown.state);
        stage.why = Some(reason);
    }
}

fn in_words(reason: &StageReason, stage: &SettingsOfStage, state: StageState) -> String {
    if state == StageState::Cached {
        return stage.from.as_ref().map_or("cached".to_owned(), |run| format!("cached from {run}"));
    }
    let has_begun = !matches!(state, StageState::Waiting | StageState::Skipped);
    match reason.kind {
        ReasonKind::New => "new".to_owned(),
        ReasonKind::Changed => changed(&reason.changes),
        ReasonKind::Code => "its code changed".to_owned(),
        ReasonKind::Seed => "another seed".to_owned(),
        ReasonKind::Input if has_begun && reason.inputs.is_empty() => "input changed".to_owned(),
        ReasonKind::Input if has_begun => {
            let names: Vec<&str> = reason.inputs.iter().map(StageName::as_str).collect();
            format!("input changed: {}", names.join(", "))
        }
        ReasonKind::Same if has_begun => "no result was kept".to_owned(),
        ReasonKind::Input | ReasonKind::Same | ReasonKind::Unknown => String::new(),
    }
}

/// Describes changed settings: `lr 2e-4 -> 1e-4, steps 100 -> 200, 3 more`.
fn changed(changes: &[SettingChange]) -> String {
    let mut parts = Vec::new();
    for SettingChange { path, from, to } in changes.iter().take(NAMED) {
        parts.push(format!("{path} {} -> {}", value_in_words(from), value_in_words(to)));
    }
    if changes.len() > NAMED {
        parts.push(format!("{} more", changes.len() - NAMED));
    }
    parts.join(", ")
}

/// Formats a setting: `2e-4`, `128`, `cosine`; a missing one is a dash.
fn value_in_words(value: &Value) -> String {
    match value {
        Value::Null => "–".to_owned(),
        Value::String(text) => text.clone(),
        Value::Number(number) => match number.as_f64() {
            Some(small) if small != 0.0 && small.abs() < SMALL => format!("{small:e}"),
            Some(float) if number.is_f64() => float.to_string(),
            _ => number.to_string(),
        },
        Value::Bool(_) | Value::Array(_) | Value::Object(_) => value.to_string(),
    }
}

/// Settings that differ, by path.
fn changes(before: &Value, after: &Value) -> Vec<SettingChange> {
    let mut old = BTreeMap::new();
    let mut new = BTreeMap::new();
    flatten(before, String::new(), &mut old);
    flatten(after, String::new(), &mut new);
    let paths: BTreeSet<&String> = old.keys().chain(new.keys()).collect();
    let mut changes = Vec::new();
    for path in paths {
        let value = |settings: &BTreeMap<String, &Value>| settings.get(path).copied().cloned().unwrap_or(Value::Null);
        let from = value(&old);
        let to = value(&new);
        // `1` and `1.0` are the same setting.
        if value_in_words(&from) != value_in_words(&to) {
            changes.push(SettingChange { path: path.clone(), from, to });
        }
    }
    changes
}

/// Adds settings by path, such as `network.width`. A list of plain values is one setting.
fn flatten<'a>(value: &'a Value, path: String, found: &mut BTreeMap<String, &'a Value>) {
    let below = |name: &str| if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
    match value {
        Value::Null => {}
        Value::Object(fields) => fields.iter().for_each(|(name, value)| flatten(value, below(name), found)),
        Value::Array(items) if items.iter().any(|item| item.is_object() || item.is_array()) => {
            items.iter().enumerate().for_each(|(i, item)| flatten(item, below(&i.to_string()), found));
        }
        Value::Bool(_) | Value::Number(_) | Value::String(_) | Value::Array(_) => {
            found.insert(path, value);
        }
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Digest, RunId, Seed};
    use serde_json::json;

    use super::*;

    fn stage(name: &str, settings: Value, key: &str) -> SettingsOfStage {
        let key = Some(Digest::of(key.as_bytes()));
        SettingsOfStage { stage: name.into(), settings, code: 1, key, from: None, why: None }
    }

    fn settings(run: &str, stages: Vec<SettingsOfStage>) -> RunSettings {
        let missing = Vec::new();
        RunSettings { run: run.into(), previous: None, missing, seed: Seed(1), source: String::new(), stages }
    }

    /// A view of the stages in `states`; each reads all before it.
    fn view(states: &[(&str, StageState)]) -> RunView {
        let mut before: Vec<&str> = Vec::new();
        let mut stages = Vec::new();
        for (name, state) in states {
            stages.push(json!({
                "name": name, "kind": "train.vae", "state": state, "key": null, "outputs": {}, "metrics": {},
                "progress": {"done": 0, "total": 0, "unit": "", "metrics": {}}, "wall_s": 0.0, "attempt": 1, "workers": [],
                "message": null, "needs": before.clone(),
            }));
            before.push(name);
        }
        let run = json!({"run": "r-2", "pipeline": "p", "owner": {"name": ""}, "state": "running", "interrupted": false, "stages": stages});
        serde_json::from_value(run).unwrap()
    }

    fn texts(now: RunSettings, shown: &RunView, before: Option<&RunSettings>) -> Vec<String> {
        let mut now = now;
        explain(&mut now, shown, before);
        now.stages.into_iter().map(|stage| stage.why.unwrap().text).collect()
    }

    #[test]
    fn a_change_is_said_where_it_is_and_below_as_an_input() {
        let before = settings("r-1", vec![stage("vae", json!({"lr": 2e-4}), "1"), stage("mld", json!({}), "2")]);
        let now = settings("r-2", vec![stage("vae", json!({"lr": 1e-4}), "3"), stage("mld", json!({}), "4")]);
        let shown = view(&[("vae", StageState::Ran), ("mld", StageState::Running)]);
        assert_eq!(texts(now.clone(), &shown, Some(&before)), ["lr 2e-4 -> 1e-4", "input changed: vae"]);
        assert_eq!(texts(now.clone(), &shown, None), ["new", "new"]);
        let waits = view(&[("vae", StageState::Ran), ("mld", StageState::Waiting)]);
        assert_eq!(texts(now, &waits, Some(&before)), ["lr 2e-4 -> 1e-4", ""]);
    }

    #[test]
    fn equal_stages_are_cached_or_were_not_kept() {
        let same = settings("r-2", vec![stage("vae", json!({"steps": 5}), "1"), stage("mld", json!({}), "2")]);
        let mut now = same.clone();
        now.stages[0].from = Some(RunId::from("r-1"));
        let shown = view(&[("vae", StageState::Cached), ("mld", StageState::Ran)]);
        assert_eq!(texts(now, &shown, Some(&same)), ["cached from r-1", "no result was kept"]);
        // A file outside the store changed: nothing else differs.
        let mut now = same.clone();
        now.stages[0].key = Some(Digest::of(b"other data"));
        assert_eq!(
            texts(now, &view(&[("vae", StageState::Ran), ("mld", StageState::Ran)]), Some(&same))[0],
            "input changed"
        );
        let mut now = same.clone();
        now.stages[0].code = 2;
        assert_eq!(texts(now, &shown, Some(&same))[0], "cached", "the run that made it is another owner's");
        let mut now = same.clone();
        now.seed = Seed(7);
        assert_eq!(texts(now, &shown, Some(&same))[1], "another seed");
    }

    #[test]
    fn many_changes_are_counted_and_equal_numbers_are_none() {
        let old =
            json!({"lr": 1, "network": {"width": 16, "heads": [1, 2]}, "decay": "cosine", "parts": [{"a": true}]});
        let new = json!({"lr": 1.0, "network": {"width": 32, "heads": [1, 3]}, "warmup": 0.5, "parts": [{"a": false}]});
        let changes = changes(&old, &new);
        let paths: Vec<&str> = changes.iter().map(|change| change.path.as_str()).collect();
        assert_eq!(paths, ["decay", "network.heads", "network.width", "parts.0.a", "warmup"]);
        assert_eq!(changed(&changes), "decay cosine -> –, network.heads [1,2] -> [1,3], 3 more");
        assert_eq!(value_in_words(&json!(0.005)), "5e-3");
        assert_eq!(value_in_words(&json!(18_446_744_073_709_551_615_u64)), "18446744073709551615");
    }
}
