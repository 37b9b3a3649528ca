//! Sweeps in a pipeline: reading `sweep:`, and its rules. The stages that a trial is made of are in `trial`.
//!
//! `space` mirrors the stage's own keys, so that a setting is found, checked and misspelt there as it would be in the stage itself. Every
//! value of a choice and both ends of a range are checked as if they stood in the stage.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::PipelineStage;
use super::diagnostic::Position;
use super::graph::{self, ByStage};
use super::read::Reader;
use super::rules::{self, Problem, Problems};
use super::schema::{list_keys, overlay, unknown_key};
use super::yaml::{Content, Entry, Node};
use crate::limits;
use crate::stage::{Mode, Placement, StageSettings};
use crate::sweep::{Domain, MAX_TRIALS, Rungs, SearchKind, Sweep, Values, judged_field, setting, with_values};
use crate::{ArtifactKind, StageName};

/// What a domain may be.
const DOMAINS: [&str; 3] = ["choice", "uniform", "log_uniform"];
/// Searches some of the stage's settings for the values with which `evaluate` measures best.
#[derive(Debug, Serialize, Deserialize, JsonSchema)]
struct Head {
    /// How.
    search: SearchKind,
    /// The value of `evaluate` that decides which trial is best.
    metric: String,
    /// Its direction.
    mode: Mode,
    /// How many points of the space are tried; a grid may leave it out.
    trials: usize,
    /// Trials that may be under way at a time.
    parallel: usize,
    /// ASHA's budgets.
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

/// The keys of a sweep.
pub(super) fn described() -> Value {
    let mut schema = super::reference::described(&Head::default());
    let properties = &mut schema["properties"];
    properties["space"] = json!({
        "description": "Settings of the stage, each with `choice: [a, b]`, `uniform: [from, to]` or `log_uniform: [from, to]`.",
        "type": "object",
    });
    properties["evaluate"] = json!({
        "description": "The stage that judges a trial, without what it judges: an `evaluate.*` kind and its keys.",
        "type": "object",
        "required": ["kind"],
    });
    schema["required"] = json!(["metric", "space", "evaluate"]);
    schema
}

impl Reader {
    /// `sweep:` of stage `name`, whose kind has the settings `default`.
    pub(super) fn sweep(&mut self, entry: &Entry, name: &str, default: &StageSettings) -> Option<Sweep> {
        let path = format!("stages.{name}.sweep");
        let owner = format!("`sweep` of stage `{name}`");
        if default.training().is_none() {
            let message = format!(
                "stage `{name}` is of kind `{}`, which does not train; only training stages are swept",
                default.kind()
            );
            self.mistake(entry.key_at, &path, message, None);
            return None;
        }
        let node = &entry.value;
        if node.map().is_none() {
            let message = format!("{owner} is {}; expected a mapping", node.describe());
            let help = "such as `{search: asha, metric: latent_fid, trials: 24, space: {lr: {log_uniform: [1e-4, 1e-3]}}, evaluate: {kind: evaluate.latent_fid}}`";
            self.mistake(node.at, &path, message, Some(help.into()));
            return None;
        }
        let head = self.typed::<Head>(node, &owner, &path, &["space", "evaluate"]);
        let mut space = BTreeMap::new();
        match node.entry("space") {
            None => {
                let help = "such as `space: {lr: {log_uniform: [1e-4, 1e-3]}}`";
                self.mistake(
                    entry.key_at,
                    &format!("{path}.space"),
                    format!("{owner} has no `space`"),
                    Some(help.into()),
                );
                return None;
            }
            Some(entry) => {
                let before = self.mistakes.len();
                let example = serde_json::to_value(default).ok()?;
                let walk = Space { default, example: &example, owner: format!("stage `{name}`") };
                self.space(&walk, &entry.value, &mut Vec::new(), &format!("{path}.space"), &mut space);
                if self.mistakes.len() > before {
                    return None;
                }
            }
        }
        let evaluate = match node.entry("evaluate") {
            None => {
                let help = "a stage without its own name, such as `evaluate: {kind: evaluate.latent_fid, sampler: {steps: 1}}`";
                self.mistake(
                    entry.key_at,
                    &format!("{path}.evaluate"),
                    format!("{owner} has no `evaluate`"),
                    Some(help.into()),
                );
                return None;
            }
            Some(entry) => self.judge(entry, name, default, &format!("{path}.evaluate"))?,
        };
        let Head { search, metric, mode, trials, parallel, rungs } = head?;
        Some(Sweep { search, metric, mode, trials, parallel, rungs, space, evaluate: Box::new(evaluate) })
    }

    /// The stage that judges trials, with its reference to the judged stage filled in.
    fn judge(&mut self, entry: &Entry, name: &str, default: &StageSettings, path: &str) -> Option<StageSettings> {
        let owner = format!("`evaluate` of the sweep of stage `{name}`");
        let node = &entry.value;
        if node.map().is_none() {
            let message = format!("{owner} is {}; expected a mapping with `kind`", node.describe());
            self.mistake(node.at, path, message, Some("such as `{kind: evaluate.latent_fid}`".into()));
            return None;
        }
        let judge = self.kind(node, entry.key_at, &owner, path)?;
        let gives = default.output().kind;
        let field = judged_field(&judge, gives).filter(|_| judge.output().kind == ArtifactKind::Report);
        let Some(field) = field else {
            let judges = StageSettings::all();
            let judges = judges
                .iter()
                .filter(|judge| judge.output().kind == ArtifactKind::Report && judged_field(judge, gives).is_some());
            let message = format!("`{}` does not measure {}, which `{name}` gives", judge.kind(), gives.noun());
            let at = node.entry("kind").map_or(node.at, |kind| kind.value.at);
            let help = format!("kinds that do: {}", list_keys(judges.map(StageSettings::kind)));
            self.mistake(at, &format!("{path}.kind"), message, Some(help));
            return None;
        };
        if let Some(written) = node.entry(&field)
            && written.value.as_text() != Some(name)
        {
            let message =
                format!("`{field}` of {owner} is {}; a sweep judges its own trials", written.value.describe());
            self.mistake(written.value.at, &format!("{path}.{field}"), message, Some("leave it out".into()));
            return None;
        }
        let mut base = serde_json::to_value(&judge).ok()?;
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
            let message = format!(
                "{place} is {}; expected settings of {} with the values that they may take",
                node.describe(),
                walk.owner
            );
            self.mistake(node.at, path, message, Some("such as `lr: {log_uniform: [1e-4, 1e-3]}`".into()));
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
            let path = format!("{path}.{}", entry.key);
            let references: Vec<String> =
                walk.default.clone().refs().into_iter().map(|reference| reference.field.into_owned()).collect();
            if keys.is_empty() && entry.key == "steps" {
                let help = "the stage's `steps` are the budget of every trial; search something else";
                self.mistake(entry.key_at, &path, "`steps` cannot be searched", Some(help.into()));
                continue;
            }
            if keys.is_empty() && references.contains(&entry.key) {
                let message = format!("`{}` names a stage or a folder, which cannot be searched", entry.key);
                self.mistake(entry.key_at, &path, message, Some("write a stage for each of them instead".into()));
                continue;
            }
            let known = example.as_object().into_iter().flat_map(|known| known.keys().map(String::as_str));
            let known: Vec<&str> = known
                .filter(|key| {
                    !keys.is_empty()
                        || !(["kind", "steps"].contains(key) || references.iter().any(|field| field == key))
                })
                .collect();
            if !known.contains(&entry.key.as_str()) {
                let (message, help) = unknown_key(&entry.key, &format!("in {place} of {}", walk.owner), &known);
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
                let message = format!("{label} is {}; expected the values that it may take", node.describe());
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
        if entry.key == "choice" {
            if values.is_empty() {
                self.mistake(
                    entry.value.at,
                    &path,
                    format!("`choice` of {label} is empty; expected at least one value"),
                    None,
                );
                return None;
            }
            return Some(Domain::Choice(values));
        }
        let ends: Vec<f64> = values.iter().filter_map(Value::as_f64).collect();
        match ends[..] {
            [low, high] if low < high && values.len() == 2 => {
                if entry.key == "uniform" {
                    return Some(Domain::Uniform(low, high));
                }
                if low > 0.0 {
                    return Some(Domain::LogUniform(low, high));
                }
                let message = format!("`log_uniform` of {label} begins at {low}; expected a number above 0");
                self.mistake(items[0].at, &path, message, None);
            }
            _ => {
                let message =
                    format!("`{}` of {label} is not a range; expected two numbers, the smaller first", entry.key);
                self.mistake(entry.value.at, &path, message, Some("values without an order go into `choice`".into()));
            }
        }
        None
    }

    /// A value that the setting may take, as the setting itself would be written out.
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

/// What a space is read against.
struct Space<'a> {
    default: &'a StageSettings,
    example: &'a Value,
    owner: String,
}

/// `{a: {b: item}}` for the keys `a`, `b`.
fn nested(keys: &[String], item: &Node) -> Node {
    keys.iter().rev().fold(item.clone(), |value, key| {
        let at: Position = item.at;
        Node { at, value: Content::Map(vec![Entry { key: key.clone(), key_at: at, value }]) }
    })
}

/// Everything that can be said of a stage's sweep without looking at other stages.
pub(super) fn rules(stage: &PipelineStage) -> Vec<Problem> {
    let mut problems = Problems::default();
    let (p, Some(sweep)) = (&mut problems, &stage.sweep) else { return problems.0 };
    let Some(training) = stage.settings.training() else {
        p.add("sweep", format!("`{}` does not train; only training stages are swept", stage.settings.kind()), "");
        return problems.0;
    };
    space_rules(p, stage, sweep);
    if judged_field(&sweep.evaluate, stage.settings.output().kind).is_none()
        || sweep.evaluate.output().kind != ArtifactKind::Report
    {
        let (judge, gives) = (sweep.evaluate.kind(), stage.settings.output().kind.noun());
        p.add("sweep.evaluate", format!("`{judge}` does not measure {gives}"), "");
    }
    if !p.0.is_empty() {
        return problems.0;
    }
    if sweep.metric.trim().is_empty() {
        p.add("sweep.metric", "`metric` is missing: the value of `evaluate` that decides which trial is best", "");
    }
    if !(1..=1000).contains(&sweep.parallel) {
        p.add("sweep.parallel", format!("`parallel` is {}; expected 1 to 1000", sweep.parallel), "");
    }
    match (sweep.search, sweep.points()) {
        (SearchKind::Grid, None) => {
            let ranges = sweep.space.iter().filter(|(_, domain)| !matches!(domain, Domain::Choice(_)));
            for (path, _) in ranges {
                let message = format!("`{path}` is a range, which has no grid");
                p.add(
                    &format!("sweep.space.{path}"),
                    message,
                    "list values with `choice`, or search with `random` or `asha`",
                );
            }
        }
        (SearchKind::Grid, Some(points)) => {
            if sweep.trials != 0 && sweep.trials != points {
                let message = format!("`trials` is {}, but the grid has {points} points", sweep.trials);
                p.add("sweep.trials", message, "leave it out, or search with `random`");
            }
            if points > MAX_TRIALS {
                p.add("sweep.space", format!("the grid has {points} points; expected at most {MAX_TRIALS}"), "");
            }
        }
        (SearchKind::Random | SearchKind::Asha, _) => {
            if !(1..=MAX_TRIALS).contains(&sweep.trials) {
                let message = format!("`trials` is {}; expected 1 to {MAX_TRIALS}", sweep.trials);
                p.add("sweep.trials", message, "how many points of the space are tried");
            }
        }
    }
    if sweep.search == SearchKind::Asha {
        let (Rungs { first, factor }, steps) = (sweep.rungs, training.steps);
        if first.0 == 0 || first >= steps {
            let message =
                format!("`rungs.first` is {first}; expected fewer steps than the stage's {steps}, and at least 1");
            p.add("sweep.rungs.first", message, "the steps after which trials are compared for the first time");
        }
        if !(2..=1000).contains(&factor) {
            p.add("sweep.rungs.factor", format!("`rungs.factor` is {factor}; expected 2 to 1000"), "");
        }
    } else if sweep.rungs != Rungs::default() {
        let message = format!("`rungs` are for `asha`; with `{}` every trial trains to the end", sweep.search.name());
        p.add("sweep.rungs", message, "leave them out");
    }
    for (path, domain) in &sweep.space {
        let field = format!("sweep.space.{path}");
        let whole = setting(&stage.settings, path).is_some_and(|value| value.is_number() && !value.is_f64());
        for (at, value) in tried(domain, whole) {
            let at = format!("{field}{at}");
            let problem = match with_values(&stage.settings, &Values::from([(path.clone(), value.clone())])) {
                Ok(_) => None,
                // What is wrong with the stage itself is said there.
                Err(_) if !rules::stage(&stage.settings, &stage.placement).is_empty() => None,
                Err(problem) => Some(problem),
            };
            if let Some(problem) = problem {
                p.add(&at, format!("with `{path}` at {value}: {problem}"), "");
            }
        }
    }
    // What is wrong with the stage's placement is said there.
    p.0.extend(rules::stage(&sweep.evaluate, &Placement::default()).into_iter().map(in_judge));
    problems.0
}

/// What the reader makes sure of, for a sweep that came as JSON: each path is a setting that may be searched, each domain has values.
fn space_rules(p: &mut Problems, stage: &PipelineStage, sweep: &Sweep) {
    let settings = sweep.space.len();
    if !(1..=limits::SWEPT_SETTINGS).contains(&settings) {
        let message = format!("`space` has {settings} settings; expected 1 to {}", limits::SWEPT_SETTINGS);
        p.add("sweep.space", message, "");
    }
    if sweep.metric.len() > limits::KEY_BYTES || sweep.metric.contains(char::is_control) {
        p.add("sweep.metric", "`metric` is not the name of a value", "such as `latent_fid`");
    }
    let mut settings = stage.settings.clone();
    let references: Vec<String> = settings.refs().into_iter().map(|reference| reference.field.into_owned()).collect();
    for (path, domain) in &sweep.space {
        let field = format!("sweep.space.{path}");
        let found = setting(&stage.settings, path).filter(|value| !value.is_object());
        if found.is_none() || path == "kind" || path == "steps" || references.contains(path) {
            p.add(&field, format!("`{}` is not a setting that can be searched", path.escape_debug()), "");
            continue;
        }
        let sound = match domain {
            Domain::Choice(values) => (1..=limits::SWEPT_VALUES).contains(&values.len()),
            Domain::Uniform(low, high) => low < high && low.is_finite() && high.is_finite(),
            Domain::LogUniform(low, high) => 0.0 < *low && low < high && high.is_finite(),
        };
        if !sound {
            p.add(&field, format!("`{path}` has no values to try, or more than {}", limits::SWEPT_VALUES), "");
        }
    }
}

/// The values of a domain that are tried before anything runs, with their places below it.
fn tried(domain: &Domain, whole: bool) -> Vec<(String, Value)> {
    let end = |value: f64| if whole { Value::from(value as u64) } else { Value::from(value) };
    match domain {
        Domain::Choice(values) => {
            values.iter().enumerate().map(|(i, value)| (format!(".choice[{i}]"), value.clone())).collect()
        }
        Domain::Uniform(low, high) => vec![(".uniform[0]".into(), end(*low)), (".uniform[1]".into(), end(*high))],
        Domain::LogUniform(low, high) => {
            vec![(".log_uniform[0]".into(), end(*low)), (".log_uniform[1]".into(), end(*high))]
        }
    }
}

fn in_judge(problem: Problem) -> Problem {
    Problem { field: format!("sweep.evaluate.{}", problem.field), ..problem }
}

/// Whether trials and their evaluations agree with the other stages, value by value. Call when the stages themselves do.
pub(super) fn check_agreement(stages: &[PipelineStage], found: &mut ByStage) {
    for (i, stage) in stages.iter().enumerate() {
        let Some(sweep) = &stage.sweep else { continue };
        let judge_name = StageName::new(format!("{}.eval", stage.name));
        let judge = PipelineStage {
            name: judge_name.clone(),
            settings: (*sweep.evaluate).clone(),
            inputs: graph::references(&sweep.evaluate),
            sweep: None,
            ..stage.clone()
        };
        let mut all = stages.to_vec();
        all.push(judge);
        let mut problems = ByStage::new();
        graph::check_agreement(&all, &mut problems);
        if let Some(wrong) = problems.remove(&judge_name).filter(|wrong| !wrong.0.is_empty()) {
            found.entry(stage.name.clone()).or_default().0.extend(wrong.0.into_iter().map(in_judge));
            continue;
        }
        for (path, domain) in &sweep.space {
            let Domain::Choice(values) = domain else { continue };
            for (at, value) in values.iter().enumerate() {
                let values = Values::from([(path.clone(), value.clone())]);
                let Ok(settings) = with_values(&stage.settings, &values) else { continue };
                all[i].settings = settings;
                let mut problems = ByStage::new();
                graph::check_agreement(&all, &mut problems);
                if let Some((other, problem)) =
                    problems.into_iter().find_map(|(name, wrong)| Some((name, wrong.0.into_iter().next()?)))
                {
                    let field = format!("sweep.space.{path}.choice[{at}]");
                    let message = format!("with `{path}` at {value} stage `{other}` does not fit: {}", problem.message);
                    found.entry(stage.name.clone()).or_default().add(&field, message, "");
                }
            }
        }
        all[i] = stage.clone();
    }
}
