//! Rules for a pipeline that was not read from a file.

use std::collections::BTreeSet;

use protocol::stage::{DataFold, Register, StageSettings};
use protocol::{StageName, limits};

use crate::definition::{Pipeline, PipelineStage, StageInput};
use crate::{graph, rules, sweep_rules, trial, yaml};

impl Pipeline {
    /// Applies the rules that need no text, for a pipeline that arrived as JSON.
    ///
    /// # Errors
    /// The violated rules, one per line.
    pub fn check(&self) -> Result<(), String> {
        self.check_size()?;
        let mut wrong = Vec::new();
        let computed = StageSettings::all();
        for (kind, version) in &self.code_versions {
            match computed.iter().find(|settings| settings.kind() == kind).map(StageSettings::code_version) {
                Some(known) if *version <= known => {}
                Some(known) => wrong.push(format!(
                    "the pipeline has `{kind}` at code version {version}, but this program has version {known}; use \
                     the same build for both"
                )),
                None => wrong.push(format!("unknown stage kind `{}`", kind.escape_debug())),
            }
        }
        let mut found = graph::ByStage::new();
        let mut before: BTreeSet<&StageName> = BTreeSet::new();
        for stage in &self.stages {
            for input in stage.inputs.iter().filter(|input| !before.contains(&input.stage)) {
                let read = shown(input.stage.as_str());
                wrong.push(format!("stage `{}` reads `{read}`, which is not an earlier stage", stage.name));
            }
            if !before.insert(&stage.name) {
                wrong.push(format!("two stages are called `{}`", stage.name));
            }
            wrong.extend(stage.unfit_for_submission());
            let problems = &mut found.entry(stage.name.clone()).or_default().0;
            problems.extend(rules::stage(&stage.settings, &stage.placement));
            problems.extend(sweep_rules::rules(stage));
        }
        if wrong.is_empty() {
            graph::check_references(&self.stages, &mut found);
        }
        if wrong.is_empty() && found.values().all(|problems| problems.0.is_empty()) {
            graph::check_agreement(&self.stages, &mut found);
            sweep_rules::check_agreement(&self.stages, &mut found);
        }
        for (stage, problems) in &found {
            wrong.extend(problems.0.iter().map(|problem| format!("stage `{stage}`: {}", problem.message)));
        }
        wrong.truncate(limits::MISTAKES);
        if wrong.is_empty() { Ok(()) } else { Err(wrong.join("\n")) }
    }

    /// Checks names and counts before any check whose time grows with them.
    fn check_size(&self) -> Result<(), String> {
        if !protocol::id::is_name(&self.name) {
            return Err(format!("`{}` is not a valid pipeline name", shown(&self.name)));
        }
        if !(1..=limits::STAGES).contains(&self.stages.len()) {
            return Err(format!("the pipeline has {} stages; expected 1 to {}", self.stages.len(), limits::STAGES));
        }
        if let Some(message) = broken_priority(self.priority) {
            return Err(message);
        }
        for stage in &self.stages {
            let names = std::iter::once(&stage.name).chain(&stage.copy_of);
            if let Some(name) = names.into_iter().find(|name| !protocol::id::is_stage_name(name.as_str())) {
                return Err(format!(
                    "`{}` is not a valid stage name; expected a lowercase letter, then lowercase letters, digits, `_` \
                     or `-`, at most 64 characters",
                    shown(name.as_str())
                ));
            }
            if stage.inputs.len() > 2 * limits::LIST {
                return Err(format!("stage `{}` has {} inputs", stage.name, stage.inputs.len()));
            }
        }
        let mut found = graph::ByStage::new();
        graph::check_totals(&self.stages, &mut found);
        match found.values().flat_map(|problems| &problems.0).next() {
            Some(problem) => Err(problem.message.clone()),
            None => Ok(()),
        }
    }
}

/// Says why a priority is refused; `None` if it is not.
pub(crate) fn broken_priority(priority: i32) -> Option<String> {
    let most = limits::PRIORITY;
    let is_fine = (-most..=most).contains(&priority);
    (!is_fine).then(|| format!("`priority` is {priority}; expected -{most} to {most}"))
}

impl PipelineStage {
    /// Violated rules of a stage that was not read from a file, besides those of its settings.
    fn unfit_for_submission(&self) -> Vec<String> {
        let mut wrong = Vec::new();
        let name = &self.name;
        if self.derived.is_some() || self.settings.training().is_some_and(|training| training.stop.is_some()) {
            wrong.push(format!(
                "stage `{name}` is marked as created by a sweep; only a running sweep creates such stages"
            ));
        }
        if self.settings.get::<DataFold>().is_some_and(|data| data.fold == 0) {
            wrong.push(format!("stage `{name}` holds out fold 0; a pipeline as submitted has one stage for each fold"));
        }
        let own = graph::references(&self.settings);
        let swept = trial::references(self);
        if own.iter().any(|reference| !self.inputs.contains(reference)) {
            wrong.push(format!("the inputs of stage `{name}` do not match its settings"));
        }
        if swept.iter().any(|reference| !self.inputs.contains(reference)) {
            wrong.push(format!("the inputs of stage `{name}` do not match its sweep"));
        }
        let added = |input: &StageInput| {
            self.settings.get::<Register>().is_some() && input.field == format!("evaluations.{}", input.stage)
        };
        for input in self.inputs.iter().filter(|input| !own.contains(input) && !swept.contains(input) && !added(input))
        {
            let field = shown(&input.field);
            let stage = shown(input.stage.as_str());
            wrong.push(format!("stage `{name}` reads `{stage}` as `{field}`, but its settings have no such input"));
        }
        let folders = self.settings.folders().into_iter().map(|folder| folder.field);
        let known: BTreeSet<String> = folders.chain(self.versions().into_iter().map(|input| input.field)).collect();
        for field in self.external.keys().filter(|field| !known.contains(*field)) {
            let field = shown(field);
            wrong.push(format!("stage `{name}` has a digest of `{field}`, but it does not read `{field}`"));
        }
        wrong
    }
}

/// The start of an untrusted text for a message, without control characters.
fn shown(text: &str) -> String {
    yaml::shortened(text).escape_debug().to_string()
}
