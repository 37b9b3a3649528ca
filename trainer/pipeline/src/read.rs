//! Converts YAML to a validated [`Pipeline`], reporting all mistakes of the file at once.

use std::collections::BTreeMap;

use protocol::id::{is_name, is_stage_name};
use protocol::limits;
use protocol::spelling::{nearest, question};
use protocol::stage::{Backend, DataOpen, DataSynthetic, Placement, StageSettings, TextEmbed};
use protocol::sweep::Sweep;
use protocol::{Seed, StageName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::check;
use crate::definition::{Pipeline, PipelineStage};
use crate::described::described;
use crate::diagnostic::{Diagnostic, Diagnostics, Position, window};
use crate::overrides::{self, TOP_KEYS};
use crate::reader::Reader;
use crate::rules::{self, Problem};
use crate::schema::{Mistake, list_keys, overlay};
use crate::yaml::{self, Budget, Content, Entry, Node};
use crate::{copies, graph, sweep_rules, trial};

/// Reads a pipeline. `file` is its name in messages, `sets` are overrides such as `stages.vae.lr=1e-4`.
///
/// # Errors
/// All mistakes, in the order of the file.
pub fn read(file: &str, text: &str, sets: &[String]) -> Result<Pipeline, Diagnostics> {
    let mut reader = Reader { mistakes: Vec::new() };
    let pipeline = reader.pipeline(text, sets);
    if reader.mistakes.is_empty()
        && let Some(pipeline) = pipeline
    {
        return Ok(pipeline);
    }
    reader.mistakes.sort_by_key(|mistake| mistake.at);
    reader.mistakes.truncate(limits::MISTAKES);
    let lines: Vec<&str> = text.lines().collect();
    let render = |mistake: Mistake| {
        let Position { source, line, column } = mistake.at;
        let (source, text) = match source.checked_sub(1).and_then(|i| sets.get(i)) {
            Some(set) => (format!("--set {}", window(set, 1).0), set.as_str()),
            None => (file.to_owned(), lines.get(line - 1).copied().unwrap_or_default()),
        };
        let (excerpt, caret) = window(text, column);
        let Mistake { path, message, help, .. } = mistake;
        Diagnostic { source, line, column, path, message, help, excerpt, caret }
    };
    Err(Diagnostics(reader.mistakes.into_iter().map(render).collect()))
}

/// Settings of a pipeline itself.
#[derive(Debug, Serialize, Deserialize, JsonSchema)]
struct Head {
    /// Name of the pipeline and prefix of its runs: a letter or digit, then letters, digits, `.`, `_`, `-`.
    name: String,
    /// Seed that keys all randomness.
    seed: Seed,
    backend: Backend,
    /// Order among the runs of one project or token: work of a higher priority is served first, and takes workers from
    /// trainings of a lower one. Results do not depend on it. `--priority` of `trainer submit` overrides it.
    #[schemars(range(min = -100, max = 100))]
    priority: i32,
}

impl Default for Head {
    fn default() -> Self {
        Self { name: String::new(), seed: Seed(0), backend: Backend::default(), priority: 0 }
    }
}

/// Schema of the pipeline's keys that have a type of their own.
pub(crate) fn described_head() -> Value {
    described(&Head::default())
}

/// Removes the keys that the file gives `dataset` and that its format does not have, after an override of the format: another
/// format has no use for `path`.
fn forget_keys_of_another_format(root: &mut Node) {
    let Content::Map(entries) = &mut root.value else { return };
    let dataset = entries.iter_mut().find(|entry| entry.key == "dataset");
    let Some(Entry { value: Node { value: Content::Map(keys), .. }, .. }) = dataset else { return };
    let format = keys.iter().find(|entry| entry.key == "format").and_then(|entry| entry.value.as_text());
    let settings = match format {
        Some("synthetic") => StageSettings::DataSynthetic(DataSynthetic::default()),
        Some("humanml3d" | "kit") => StageSettings::DataOpen(DataOpen::default()),
        _ => return,
    };
    let known = settings.example();
    let known = |key: &str| key == "format" || known.get(key).is_some();
    // Overrides stay: an unknown key that a user has just typed is a mistake to report.
    keys.retain(|entry| known(&entry.key) || entry.key_at.source != 0 || entry.value.at.source != 0);
}

/// A stage as written in the file.
struct Written {
    name: StageName,
    key_at: Position,
    /// Mapping with its settings; `None` for an implicit stage.
    node: Option<Node>,
    /// Path of the mapping.
    path: String,
}

/// Stages of a file: all of them, and the readable ones with their settings.
#[derive(Default)]
struct Found {
    written: Vec<Written>,
    stages: Vec<PipelineStage>,
    /// Number of copies of those with the key `seeds`.
    seeds: copies::Counts,
}

/// Place of the key of a stage under `stages`.
fn declared(root: &Node, name: &str) -> Option<Position> {
    root.entry("stages").and_then(|stages| stages.value.entry(name)).map(|stage| stage.key_at)
}

impl Reader {
    fn pipeline(&mut self, text: &str, sets: &[String]) -> Option<Pipeline> {
        let mut budget = Budget::default();
        let mut root = match yaml::parse(text, 0, &mut budget) {
            Ok(root) => root,
            Err(mistakes) => {
                for mistake in mistakes {
                    self.mistake(mistake.at, "", mistake.message, mistake.help);
                }
                return None;
            }
        };
        if root.map().is_none() {
            let found = root.describe();
            let help = format!("its keys are {}", list_keys(TOP_KEYS));
            self.mistake(root.at, "", format!("the document is {found}; expected a mapping"), Some(help));
            return None;
        }
        if sets.len() > limits::OVERRIDES {
            let message = format!("there are {} overrides; at most {} are read", sets.len(), limits::OVERRIDES);
            self.mistake(root.at, "", message, Some("write the overrides into the pipeline file".into()));
            return None;
        }
        for (i, set) in sets.iter().enumerate() {
            if let Err(message) = overrides::apply(&mut root, set, i + 1, &mut budget) {
                self.mistake(Position { source: i + 1, line: 1, column: 1 }, "", message, None);
            }
        }
        if sets.iter().any(|set| set.split('=').next().is_some_and(|key| key.trim() == "dataset.format")) {
            forget_keys_of_another_format(&mut root);
        }
        let head = self.head(&root);
        let Found { written, mut stages, seeds } = self.stages(&root);
        let names = written.iter().map(|written| written.name.clone()).collect();
        let pins = copies::pin(&mut stages, &names, &seeds);
        let stages = self.connect(&root, &written, stages);
        let stages = self.copy(&written, stages, &seeds, &pins);
        let head = head?;
        let stages = stages?;
        let Head { name, seed, backend, priority } = head;
        let mut pipeline = Pipeline { name, seed, backend, priority, stages, code_versions: BTreeMap::new() };
        pipeline.note_code_versions();
        Some(pipeline)
    }

    fn head(&mut self, root: &Node) -> Option<Head> {
        let mut base = serde_json::to_value(Head::default()).ok()?;
        overlay::<Head>(&mut base, root, "the pipeline", "", &["dataset", "text", "stages"], &mut self.mistakes);
        match root.entry("name") {
            None => {
                let help = Some("start with a line such as `name: my-first-pipeline`".to_owned());
                self.mistake(root.at, "name", "the pipeline has no `name`", help);
            }
            Some(entry) => {
                if let Some(name) = entry.value.as_text()
                    && !is_name(name)
                {
                    let message = format!(
                        "`{name}` is not a valid pipeline name; expected a letter or digit, then letters, digits, `.`, \
                         `_` or `-`, at most 64 characters"
                    );
                    self.mistake(entry.value.at, "name", message, None);
                }
            }
        }
        let head: Head = serde_json::from_value(base).ok()?;
        if let (Some(message), Some(entry)) = (check::broken_priority(head.priority), root.entry("priority")) {
            self.mistake(entry.value.at, "priority", message, None);
        }
        Some(head)
    }

    /// All stages of the file, and the readable ones with their settings. A stage with mistakes is only in the first
    /// list.
    fn stages(&mut self, root: &Node) -> Found {
        let mut found = Found::default();
        self.dataset_stage(root, &mut found);
        self.text_stage(root, &mut found);
        self.named_stages(root, &mut found);
        found
    }

    /// The stage of the top-level key `dataset`.
    fn dataset_stage(&mut self, root: &Node, found: &mut Found) {
        if let Some(entry) = root.entry("dataset") {
            if let Some(at) = declared(root, "dataset") {
                self.mistake(
                    at,
                    "stages.dataset",
                    "the top-level key `dataset` already defines a stage with this name",
                    None,
                );
            }
            found.written.push(Written::implicit("dataset", entry));
            if let Some(settings) = self.dataset(entry) {
                found.stages.push(stage("dataset", settings, Placement::default()));
            }
        } else if declared(root, "dataset").is_none() {
            let help =
                "for example `dataset: {format: synthetic}` or `dataset: {format: humanml3d, path: data/HumanML3D}`";
            self.mistake(root.at, "dataset", "the pipeline has no `dataset`", Some(help.into()));
            // Readers of the stage need not report it again.
            found.written.push(Written { name: "dataset".into(), key_at: root.at, node: None, path: "dataset".into() });
        }
    }

    /// The stage of the top-level key `text`, or its default.
    fn text_stage(&mut self, root: &Node, found: &mut Found) {
        match root.entry("text") {
            Some(entry) => {
                if let Some(at) = declared(root, "text") {
                    self.mistake(
                        at,
                        "stages.text",
                        "the top-level key `text` already defines a stage with this name",
                        None,
                    );
                }
                found.written.push(Written::implicit("text", entry));
                if let Some(settings) = self.typed::<TextEmbed>(&entry.value, "`text`", "text", &[]) {
                    found.stages.push(stage("text", StageSettings::TextEmbed(settings), Placement::default()));
                }
            }
            None if declared(root, "text").is_none() => {
                found.written.push(Written { name: "text".into(), key_at: root.at, node: None, path: "text".into() });
                found.stages.push(stage("text", StageSettings::TextEmbed(TextEmbed::default()), Placement::default()));
            }
            None => {}
        }
    }

    /// The stages of the top-level key `stages`.
    fn named_stages(&mut self, root: &Node, found: &mut Found) {
        match root.entry("stages") {
            None => self.mistake(
                root.at,
                "stages",
                "the pipeline has no `stages`",
                Some("for example `stages: {vae: {kind: train.vae}}`".into()),
            ),
            Some(entry) => match entry.value.map() {
                Some([]) => {
                    self.mistake(entry.key_at, "stages", "`stages` is empty; expected at least one stage", None)
                }
                Some(entries) if entries.len() > limits::STAGES => {
                    let message = format!("`stages` has {}; expected at most {}", entries.len(), limits::STAGES);
                    self.mistake(entry.key_at, "stages", message, Some("split it into several pipelines".into()));
                }
                Some(entries) => {
                    for entry in entries {
                        if entry.key_at.source > 0 && entry.value.entry("kind").is_none() {
                            self.unwritten(entry, entries);
                            continue;
                        }
                        found.written.push(Written {
                            name: StageName::new(&*entry.key),
                            key_at: entry.key_at,
                            node: Some(entry.value.clone()),
                            path: format!("stages.{}", entry.key),
                        });
                        if let Some(seeds) = self.seeds(entry) {
                            found.seeds.insert(StageName::new(&*entry.key), seeds);
                        }
                        if let Some((settings, placement, sweep)) = self.stage(entry) {
                            let mut stage = stage(&entry.key, settings, placement);
                            stage.sweep = sweep;
                            stage.inputs.extend(trial::references(&stage));
                            found.stages.push(stage);
                        }
                    }
                }
                None => {
                    let shown = entry.value.describe();
                    let message = format!("`stages` is {shown}; expected a mapping from names to stages");
                    self.mistake(
                        entry.value.at,
                        "stages",
                        message,
                        Some("for example `vae: {kind: train.vae}`".into()),
                    );
                }
            },
        }
    }

    fn dataset(&mut self, entry: &Entry) -> Option<StageSettings> {
        let formats = ["synthetic", "humanml3d", "kit"];
        let node = &entry.value;
        if node.map().is_none() {
            let message = format!("`dataset` is {}; expected a mapping with `format`", node.describe());
            self.mistake(
                node.at,
                "dataset",
                message,
                Some("for example `{format: humanml3d, path: data/HumanML3D}`".into()),
            );
            return None;
        }
        let Some(format) = node.entry("format") else {
            let message = format!("`dataset` has no `format`; expected one of {}", list_keys(formats));
            self.mistake(entry.key_at, "dataset.format", message, None);
            return None;
        };
        match format.value.as_text() {
            Some("synthetic") => {
                self.typed::<DataSynthetic>(node, "`dataset`", "dataset", &["format"]).map(StageSettings::DataSynthetic)
            }
            Some("humanml3d" | "kit") => {
                self.typed::<DataOpen>(node, "`dataset`", "dataset", &[]).map(StageSettings::DataOpen)
            }
            other => {
                let near = other.and_then(|text| nearest(text, formats)).map(|near| format!("did you mean `{near}`?"));
                let message = format!(
                    "`format` of `dataset` is {}; expected one of {}",
                    format.value.describe(),
                    list_keys(formats)
                );
                self.mistake(format.value.at, "dataset.format", message, near);
                None
            }
        }
    }

    /// Reports settings from the command line for a stage that the file does not have.
    fn unwritten(&mut self, entry: &Entry, entries: &[Entry]) {
        let written = || entries.iter().filter(|other| other.key_at.source == 0).map(|other| other.key.as_str());
        let meant = question(&entry.key, written());
        let message = format!("the file has no stage `{}`{meant}", entry.key);
        let help = format!("its stages are {}", list_keys(written()));
        self.mistake(entry.key_at, &format!("stages.{}", entry.key), message, Some(help));
    }

    fn stage(&mut self, entry: &Entry) -> Option<(StageSettings, Placement, Option<Sweep>)> {
        let name = &entry.key;
        let node = &entry.value;
        let path = format!("stages.{name}");
        let owner = format!("stage `{name}`");
        if !is_stage_name(name) {
            let message = format!(
                "`{name}` is not a valid stage name; expected a lowercase letter, then lowercase letters, digits, `_` \
                 or `-`, at most 64 characters"
            );
            self.mistake(entry.key_at, &path, message, None);
        }
        if node.map().is_none() {
            let message = format!("{owner} is {}; expected a mapping with `kind`", node.describe());
            self.mistake(node.at, &path, message, Some(format!("for example `{name}: {{kind: train.vae}}`")));
            return None;
        }
        let default = self.kind(node, entry.key_at, &owner, &path)?;
        let placed = Node {
            at: node.at,
            value: Content::Map(
                node.map()
                    .unwrap_or(&[])
                    .iter()
                    .filter(|e| matches!(&*e.key, "workers" | "requires" | "checkpoint"))
                    .cloned()
                    .collect(),
            ),
        };
        let placement = self.overlaid::<Placement>(Placement::example(), &placed, &owner, &path, &[]);
        let skip = ["workers", "requires", "checkpoint", "sweep", copies::KEY];
        let sweep = match node.entry("sweep") {
            Some(entry) => self.sweep(entry, name, &default).map(Some),
            None => Some(None),
        };
        let settings = self.overlaid(default.example(), node, &owner, &path, &skip);
        Some((settings?, placement?, sweep?))
    }

    /// Reads the number of copies of a stage.
    fn seeds(&mut self, entry: &Entry) -> Option<usize> {
        let found = &entry.value.entry(copies::KEY)?.value;
        let number = found.to_json().as_ref().and_then(Value::as_u64).and_then(|number| usize::try_from(number).ok());
        let number = number.filter(|number| (1..=limits::SEEDS).contains(number));
        if number.is_none() {
            let (name, key) = (&entry.key, copies::KEY);
            let shown = found.describe();
            let message =
                format!("`{key}` of stage `{name}` is {shown}; expected a whole number, 1 to {}", limits::SEEDS);
            self.mistake(found.at, &format!("stages.{name}.{key}"), message, None);
        }
        number
    }

    /// Makes the copies of a pipeline without mistakes.
    fn copy(
        &mut self,
        written: &[Written],
        stages: Option<Vec<PipelineStage>>,
        seeds: &copies::Counts,
        pins: &copies::Pins,
    ) -> Option<Vec<PipelineStage>> {
        if !self.mistakes.is_empty() {
            return stages;
        }
        match copies::expand(stages?, seeds, pins) {
            Ok(stages) => Some(stages),
            Err((stage, problem)) => {
                self.problem(written, &stage, problem);
                None
            }
        }
    }

    /// Adds edges, applies rules, sorts. Rules between stages wait until every stage could be read.
    fn connect(
        &mut self,
        root: &Node,
        written: &[Written],
        mut stages: Vec<PipelineStage>,
    ) -> Option<Vec<PipelineStage>> {
        for stage in &mut stages {
            for problem in trial::resolve_best(stage, written.iter().map(|w| (&w.name, w.swept()))) {
                self.problem(written, &stage.name, problem);
            }
            let problems = rules::stage(&stage.settings, &stage.placement).into_iter().chain(sweep_rules::rules(stage));
            for problem in problems.collect::<Vec<_>>() {
                self.problem(written, &stage.name, problem);
            }
        }
        graph::add_evaluations(&mut stages);
        // The captions are embedded only if a stage needs them, or the file has the key.
        let text = StageName::new("text");
        let all_read = stages.len() == written.len();
        let asked = |stages: &[PipelineStage]| stages.iter().any(|s| s.inputs.iter().any(|input| input.stage == text));
        if all_read && root.entry("text").is_none() && !asked(&stages) {
            stages.retain(|stage| stage.name != text || !is_implicit(written, &stage.name));
        }

        let mut found = BTreeMap::new();
        graph::check_totals(&stages, &mut found);
        graph::check_references(&stages, &mut found);
        if !all_read {
            forgive_references(written, &stages, &mut found);
        }
        let sound = all_read && found.values().all(|problems| problems.0.is_empty());
        let sorted = match graph::sort(stages) {
            Ok(stages) => {
                if sound {
                    graph::check_agreement(&stages, &mut found);
                    sweep_rules::check_agreement(&stages, &mut found);
                }
                Some(stages)
            }
            Err(cycle) => {
                self.refuse_cycle(root, written, &cycle);
                None
            }
        };
        for (name, problems) in found {
            for problem in problems.0 {
                self.problem(written, &name, problem);
            }
        }
        sorted
    }

    fn refuse_cycle(&mut self, root: &Node, written: &[Written], cycle: &[StageName]) {
        let path = cycle.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(" -> ");
        let at = written.iter().find(|w| Some(&w.name) == cycle.first()).map_or(root.at, |w| w.key_at);
        let help = "each stage of the cycle reads the next one; change an input of one of them";
        self.mistake(at, "stages", format!("stages form a cycle: {path}"), Some(help.into()));
    }

    /// Reports a problem at the position of its field, or of the field's nearest parent.
    fn problem(&mut self, written: &[Written], stage: &StageName, problem: Problem) {
        let Some(written) = written.iter().find(|w| &w.name == stage) else { return };
        let mut at = written.key_at;
        let mut node = written.node.as_ref();
        for part in problem.field.split(['.', '[', ']']).filter(|part| !part.is_empty()) {
            let next = match node.map(|node| &node.value) {
                Some(Content::Map(entries)) => entries.iter().find(|entry| entry.key == part).map(|entry| &entry.value),
                Some(Content::List(items)) => part.parse::<usize>().ok().and_then(|i| items.get(i)),
                _ => None,
            };
            let Some(next) = next else { break };
            at = next.at;
            node = Some(next);
        }
        let path =
            if problem.field.is_empty() { written.path.clone() } else { format!("{}.{}", written.path, problem.field) };
        let owner =
            if written.path.starts_with("stages.") { format!("stage `{stage}`: ") } else { format!("`{stage}`: ") };
        self.mistake(at, &path, format!("{owner}{}", problem.message), problem.help);
    }
}

impl Written {
    fn swept(&self) -> bool {
        self.node.as_ref().is_some_and(|node| node.entry("sweep").is_some())
    }

    fn implicit(name: &str, entry: &Entry) -> Self {
        Self { name: name.into(), key_at: entry.key_at, node: Some(entry.value.clone()), path: name.into() }
    }
}

/// Removes problems of references to stages that could not be read: they have their own mistakes.
fn forgive_references(written: &[Written], stages: &[PipelineStage], found: &mut graph::ByStage) {
    let is_unread = |name: &StageName| {
        written.iter().any(|w| w.name.as_str() == name.as_str()) && !stages.iter().any(|s| &s.name == name)
    };
    for stage in stages {
        let broken: Vec<&str> = stage.inputs.iter().filter(|i| is_unread(&i.stage)).map(|i| i.field.as_str()).collect();
        if let Some(problems) = found.get_mut(&stage.name) {
            problems.0.retain(|problem| !broken.contains(&problem.field.as_str()));
        }
    }
}

fn is_implicit(written: &[Written], name: &StageName) -> bool {
    written.iter().any(|w| &w.name == name && w.node.is_none())
}

fn stage(name: &str, settings: StageSettings, placement: Placement) -> PipelineStage {
    let inputs = graph::references(&settings);
    let external = BTreeMap::new();
    PipelineStage {
        name: name.into(),
        settings,
        placement,
        inputs,
        external,
        sweep: None,
        derived: None,
        copy_of: None,
    }
}
