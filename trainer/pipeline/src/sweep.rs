//! Sweeps in a pipeline: reads `sweep:`. Its rules are in `sweep_rules`, the stages of a trial in `trial`.
//!
//! `space` has the stage's own keys, so that a setting is found, checked and corrected as in the stage itself.

use std::collections::BTreeMap;

use protocol::ArtifactKind;
use protocol::stage::{Mode, StageSettings};
use protocol::sweep::{Domain, EVALUATE, Rungs, SearchKind, Sweep, evaluated_field, setting};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::described::described as schema_of;
use crate::diagnostic::Position;
use crate::reader::Reader;
use crate::schema::{list_keys, overlay, unknown_key};
use crate::yaml::{Content, Entry, Node};

/// Kinds of domains.
const DOMAINS: [&str; 3] = ["choice", "uniform", "log_uniform"];

/// Search over some of the stage's settings for the values with the best result of `evaluate`.
#[derive(Debug, Serialize, Deserialize, JsonSchema)]
struct Head {
    /// Search method of the sweep.
    search: SearchKind,
    /// Value of `evaluate` that ranks the trials.
    metric: String,
    /// Direction of the metric.
    mode: Mode,
    /// Number of points of the space to try; a grid may leave it out.
    trials: usize,
    /// Largest number of concurrent trials.
    parallel: usize,
    /// Budgets of ASHA.
    rungs: Rungs,
}

impl Default for Head {
    fn default() -> Self {
        Self {
            search: SearchKind::Asha,
            metric: String::new(),
            mode: Mode::Min,
            trials: 0,
            parallel: 4,
            rungs: Rungs::default(),
        }
    }
}

/// Schema of the keys of a sweep.
pub(crate) fn described() -> Value {
    let mut schema = schema_of(&Head::default());
    let properties = &mut schema["properties"];
    properties["space"] = json!({
        "description": "Settings of the stage, each with `choice: [a, b]`, `uniform: [from, to]` or `log_uniform: \
            [from, to]`. Below `evaluate`: settings of the evaluation stage, such as `evaluate: {sampler: {guidance: \
            {choice: [2, 3]}}}`.",
        "type": "object",
    });
    properties["evaluate"] = json!({
        "description": "The stage that evaluates a trial: an `evaluate.*` kind and its keys, without the input that \
            it evaluates.",
        "type": "object",
        "required": ["kind"],
    });
    schema["required"] = json!(["metric", "space", "evaluate"]);
    schema
}

impl Reader {
    /// Reads `sweep:` of stage `name`, whose kind has the settings `default`.
    pub(crate) fn sweep(&mut self, entry: &Entry, name: &str, default: &StageSettings) -> Option<Sweep> {
        let path = format!("stages.{name}.sweep");
        let owner = format!("`sweep` of stage `{name}`");
        if default.training().is_none() {
            let message = format!(
                "stage `{name}` has kind `{}`, which does not train; only a training stage can have a sweep",
                default.kind()
            );
            self.mistake(entry.key_at, &path, message, None);
            return None;
        }
        let node = &entry.value;
        if node.map().is_none() {
            let message = format!("{owner} is {}; expected a mapping", node.describe());
            let help = "for example `{search: asha, metric: latent_fid, trials: 24, space: {lr: {log_uniform: [1e-4, \
                1e-3]}}, evaluate: {kind: evaluate.latent_fid}}`";
            self.mistake(node.at, &path, message, Some(help.into()));
            return None;
        }
        let head = self.typed::<Head>(node, &owner, &path, &["space", "evaluate"]);
        let Some(space_entry) = node.entry("space") else {
            let help = "for example `space: {lr: {log_uniform: [1e-4, 1e-3]}}`".to_owned();
            self.mistake(entry.key_at, &format!("{path}.space"), format!("{owner} has no `space`"), Some(help));
            return None;
        };
        let walk_owner = format!("stage `{name}`");
        let mut space = self.whole_space(default, walk_owner, true, &space_entry.value, &format!("{path}.space"))?;
        let path_of_evaluate = format!("{path}.evaluate");
        let Some(evaluate_entry) = node.entry(EVALUATE) else {
            let help = "write a stage without a name, such as `evaluate: {kind: evaluate.latent_fid, sampler: {steps: \
                1}}`";
            self.mistake(entry.key_at, &path_of_evaluate, format!("{owner} has no `evaluate`"), Some(help.into()));
            return None;
        };
        let evaluate = self.evaluation(evaluate_entry, name, default, &path_of_evaluate)?;
        if let Some(entry) = space_entry.value.entry(EVALUATE) {
            let owner = format!("`evaluate` of the sweep of stage `{name}`");
            let found = self.whole_space(&evaluate, owner, false, &entry.value, &format!("{path}.space.{EVALUATE}"))?;
            space.extend(found.into_iter().map(|(path, domain)| (format!("{EVALUATE}.{path}"), domain)));
        }
        let Head { search, metric, mode, trials, parallel, rungs } = head?;
        Some(Sweep { search, metric, mode, trials, parallel, rungs, space, evaluate: Box::new(evaluate) })
    }

    /// Reads the space of a stage whose kind has the settings `default`; `None` if it has a mistake.
    fn whole_space(
        &mut self,
        default: &StageSettings,
        owner: String,
        of_stage: bool,
        node: &Node,
        path: &str,
    ) -> Option<BTreeMap<String, Domain>> {
        let before = self.mistakes.len();
        let example = serde_json::to_value(default).ok()?;
        let walk = Space { default, example: &example, owner, of_stage };
        let mut space = BTreeMap::new();
        self.space(&walk, node, &mut Vec::new(), path, &mut space);
        (self.mistakes.len() == before).then_some(space)
    }

    /// Reads the stage that evaluates trials, and fills in its reference to the evaluated stage.
    fn evaluation(&mut self, entry: &Entry, name: &str, default: &StageSettings, path: &str) -> Option<StageSettings> {
        let owner = format!("`evaluate` of the sweep of stage `{name}`");
        let node = &entry.value;
        if node.map().is_none() {
            let message = format!("{owner} is {}; expected a mapping with `kind`", node.describe());
            self.mistake(node.at, path, message, Some("for example `{kind: evaluate.latent_fid}`".into()));
            return None;
        }
        let evaluation = self.kind(node, entry.key_at, &owner, path)?;
        let gives = default.output().kind;
        let field = evaluated_field(&evaluation, gives).filter(|_| evaluation.output().kind == ArtifactKind::Report);
        let Some(field) = field else {
            let evaluations = StageSettings::all();
            let evaluations = evaluations.iter().filter(|evaluation| {
                evaluation.output().kind == ArtifactKind::Report && evaluated_field(evaluation, gives).is_some()
            });
            let message = format!("`{}` does not measure {}, the output of `{name}`", evaluation.kind(), gives.noun());
            let at = node.entry("kind").map_or(node.at, |kind| kind.value.at);
            let help = format!("kinds that measure it: {}", list_keys(evaluations.map(StageSettings::kind)));
            self.mistake(at, &format!("{path}.kind"), message, Some(help));
            return None;
        };
        if let Some(written) = node.entry(&field)
            && written.value.as_text() != Some(name)
        {
            let message =
                format!("`{field}` of {owner} is {}, but a sweep evaluates its own trials", written.value.describe());
            self.mistake(written.value.at, &format!("{path}.{field}"), message, Some("remove it".into()));
            return None;
        }
        let mut base = serde_json::to_value(&evaluation).ok()?;
        base[field.as_str()] = Value::String(name.to_owned());
        self.overlaid(base, node, &owner, path, &[])
    }

    fn space(
        &mut self,
        walk: &Space<'_>,
        node: &Node,
        keys: &mut Vec<String>,
        path: &str,
        found: &mut BTreeMap<String, Domain>,
    ) {
        let place = if keys.is_empty() { "`space`".to_owned() } else { format!("`space.{}`", keys.join(".")) };
        let Some(entries) = node.map() else {
            let message =
                format!("{place} is {}; expected settings of {} with the values to try", node.describe(), walk.owner);
            self.mistake(node.at, path, message, Some("for example `lr: {log_uniform: [1e-4, 1e-3]}`".into()));
            return;
        };
        if entries.is_empty() {
            self.mistake(
                node.at,
                path,
                format!("{place} is empty; expected at least one setting of {}", walk.owner),
                None,
            );
        }
        let example = keys.iter().fold(walk.example, |value, key| &value[key.as_str()]);
        for entry in entries {
            // Read once the evaluating stage is known.
            if keys.is_empty() && walk.of_stage && entry.key == EVALUATE {
                continue;
            }
            let path = format!("{path}.{}", entry.key);
            if let Err((message, help)) = walk.searches(&entry.key, keys.is_empty(), example, &place) {
                self.mistake(entry.key_at, &path, message, Some(help));
                continue;
            }
            keys.push(entry.key.clone());
            if example[entry.key.as_str()].is_object() {
                self.space(walk, &entry.value, keys, &path, found);
            } else if let Some(domain) = self.domain(walk, &entry.value, keys, &path) {
                found.insert(keys.join("."), domain);
            }
            keys.pop();
        }
    }

    fn domain(&mut self, walk: &Space<'_>, node: &Node, keys: &[String], path: &str) -> Option<Domain> {
        let label = format!("`space.{}`", keys.join("."));
        let help =
            || Some("write `{choice: [a, b]}`, `{uniform: [from, to]}` or `{log_uniform: [from, to]}`".to_owned());
        let entry = match node.map() {
            Some([entry]) => entry,
            Some(entries) if entries.len() > 1 => {
                let message = format!("{label} has {} keys; expected one of {}", entries.len(), list_keys(DOMAINS));
                self.mistake(node.at, path, message, help());
                return None;
            }
            _ => {
                let message = format!("{label} is {}; expected the values to try", node.describe());
                self.mistake(node.at, path, message, help());
                return None;
            }
        };
        if !DOMAINS.contains(&entry.key.as_str()) {
            let (message, known) = unknown_key(&entry.key, &format!("in {label}"), &DOMAINS);
            self.mistake(entry.key_at, &format!("{path}.{}", entry.key), message, Some(known));
            return None;
        }
        let path = format!("{path}.{}", entry.key);
        let Content::List(items) = &entry.value.value else {
            let message = format!("`{}` of {label} is {}; expected a list", entry.key, entry.value.describe());
            self.mistake(entry.value.at, &path, message, None);
            return None;
        };
        let mut values = Vec::new();
        for item in items {
            let value = self.value(walk, item, keys, &path)?;
            if values.contains(&value) {
                self.mistake(item.at, &path, format!("{label} lists {value} twice"), None);
                return None;
            }
            values.push(value);
        }
        if entry.key != "choice" {
            return self.interval(entry, &values, &label, &path);
        }
        if values.is_empty() {
            let message = format!("`choice` of {label} is empty; expected at least one value");
            self.mistake(entry.value.at, &path, message, None);
            return None;
        }
        Some(Domain::Choice(values))
    }

    /// Makes a domain of `values`, the two ends of `uniform` or `log_uniform`.
    fn interval(&mut self, entry: &Entry, values: &[Value], label: &str, path: &str) -> Option<Domain> {
        let ends: Vec<f64> = values.iter().filter_map(Value::as_f64).collect();
        match ends[..] {
            [low, high] if low < high && values.len() == 2 => {
                if entry.key == "uniform" {
                    return Some(Domain::Uniform(low, high));
                }
                if low > 0.0 {
                    return Some(Domain::LogUniform(low, high));
                }
                let at = match &entry.value.value {
                    Content::List(items) => items[0].at,
                    _ => entry.value.at,
                };
                let message = format!("`log_uniform` of {label} starts at {low}; expected a number above 0");
                self.mistake(at, path, message, None);
            }
            _ => {
                let message =
                    format!("`{}` of {label} is not a range; expected two numbers, the smaller one first", entry.key);
                self.mistake(entry.value.at, path, message, Some("use `choice` for values without an order".into()));
            }
        }
        None
    }

    /// Reads a value of the setting, in the form in which the setting itself is written.
    fn value(&mut self, walk: &Space<'_>, item: &Node, keys: &[String], path: &str) -> Option<Value> {
        let before = self.mistakes.len();
        let mut base = walk.example.clone();
        overlay::<StageSettings>(&mut base, &nested(keys, item), &walk.owner, path, &[], &mut self.mistakes);
        for mistake in &mut self.mistakes[before..] {
            mistake.path = path.to_owned();
        }
        if self.mistakes.len() > before {
            return None;
        }
        let settings: StageSettings = serde_json::from_value(base).ok()?;
        setting(&settings, &keys.join("."))
    }
}

/// Schema for reading a space.
struct Space<'a> {
    default: &'a StageSettings,
    example: &'a Value,
    owner: String,
    /// True for the stage itself, false for the stage that evaluates.
    of_stage: bool,
}

impl Space<'_> {
    /// Returns an error's message and help if the key cannot be searched. `known` is the mapping that has the key,
    /// at the top of the settings or below.
    fn searches(&self, key: &str, is_top: bool, known: &Value, place: &str) -> Result<(), (String, String)> {
        let references: Vec<String> =
            self.default.clone().refs().into_iter().map(|reference| reference.field.into_owned()).collect();
        let names = |key: &str| references.iter().any(|field| field == key);
        if is_top && key == "steps" {
            let help = "`steps` of the stage is the budget of every trial; search another setting";
            return Err(("`steps` cannot be searched".to_owned(), help.to_owned()));
        }
        if is_top && names(key) {
            let message = format!("`{key}` names a stage or a folder, so it cannot be searched");
            return Err((message, "write one stage for each value instead".to_owned()));
        }
        let keys = known.as_object().into_iter().flat_map(|known| known.keys().map(String::as_str));
        let searched: Vec<&str> =
            keys.filter(|key| !is_top || !(["kind", "steps"].contains(key) || names(key))).collect();
        if searched.contains(&key) {
            return Ok(());
        }
        Err(unknown_key(key, &format!("in {place} of {}", self.owner), &searched))
    }
}

/// Builds `{a: {b: item}}` for the keys `a`, `b`.
fn nested(keys: &[String], item: &Node) -> Node {
    keys.iter().rev().fold(item.clone(), |value, key| {
        let at: Position = item.at;
        Node { at, value: Content::Map(vec![Entry { key: key.clone(), key_at: at, value }]) }
    })
}
