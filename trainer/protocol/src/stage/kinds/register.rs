//! `register`: registers model versions and promotes the best. The coordinator runs it, because it changes the
//! registry. Source: ours.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::artifact::Role;
use crate::id::is_name;
use crate::spelling::nearest;
use crate::stage::{Mode, Neighbours, Output, Problems, Ref, Sampler, Shape, StageSpec, measured_with};

/// `register`: registers model versions and promotes the best of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Register {
    /// Name of the model.
    pub model: String,
    /// Stages whose models become versions. The metrics of every `evaluate.*` stage of the pipeline that measures one
    /// of them are registered with it.
    pub from: Vec<String>,
    /// Metric that ranks the versions.
    pub metric: String,
    /// Direction of the metric.
    pub mode: Mode,
    /// Default sampler of the versions. Without it, that of their evaluations; required if those differ.
    #[schemars(with = "Sampler")]
    pub sampler: Option<Sampler>,
    /// Stage that gives a length estimator, which becomes a part of every version; empty adds none.
    pub length: String,
    /// Promotion of the best version; without it none is promoted.
    pub promote: Promote,
}

impl Default for Register {
    fn default() -> Self {
        Self {
            model: String::new(),
            from: Vec::new(),
            metric: "latent_fid".into(),
            mode: Mode::Min,
            sampler: None,
            length: String::new(),
            promote: Promote::default(),
        }
    }
}

/// The promotion at the end of a `register` stage.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Promote {
    /// Alias of the promoted version; empty promotes nothing.
    pub to: String,
    /// Conditions of the promotion, such as `latent_fid <= 0.3`.
    pub require: Vec<String>,
}

impl StageSpec for Register {
    const KIND: &'static str = "register";
    // Version 2 registers the sampler of the evaluations.
    const VERSION: u32 = 2;
    const SHAPE: Shape = Shape::Registry;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    /// The pipeline adds the evaluations of the candidates.
    fn refs(&mut self) -> Vec<Ref<'_>> {
        let field = |i| format!("from[{i}]");
        let stages = self.from.iter_mut().enumerate();
        let models = stages.map(|(i, stage)| Ref::stage(field(i), stage, ArtifactKind::Model));
        models.chain([Ref::stage("length", &mut self.length, ArtifactKind::Length).optional()]).collect()
    }

    fn check(&self, p: &mut Problems) {
        if self.model.is_empty() {
            p.add("model", "`model` is missing; set it to the name of the registered model", "");
        } else if !is_name(&self.model) {
            let message = format!(
                "`{}` is not a valid model name; expected letters, digits, `.`, `_` or `-`, at most 64 characters",
                self.model
            );
            p.add("model", message, "");
        }
        if self.from.is_empty() {
            p.add(
                "from",
                "`from` is missing; set it to the stages whose models are registered",
                "for example `from: [lcm, pcm]`",
            );
        }
        for (i, stage) in self.from.iter().enumerate() {
            if self.from[..i].contains(stage) {
                p.add("from", format!("`from` lists `{stage}` twice"), "");
            }
        }
        if self.metric.trim().is_empty() {
            p.add("metric", "`metric` is empty; expected the metric that ranks versions", "");
        }
        if let Some(sampler) = &self.sampler {
            sampler.check(p);
        }
        self.promote.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        for (i, from) in self.from.iter().enumerate() {
            if !stages.measures(from) && (self.from.len() > 1 || !self.promote.to.is_empty()) {
                let message = format!("no `evaluate.*` stage evaluates `{from}`, so its `{}` is unknown", self.metric);
                let help = format!("add a stage such as `{{kind: evaluate.latent_fid, model: {from}}}`");
                p.add(&format!("from[{i}]"), message, &help);
            }
            if let Some(given) = stages.metrics_of(from)
                && !given.contains(&self.metric)
            {
                let message = format!("no evaluation of `{from}` reports `{}`, the value of `metric`", self.metric);
                p.add("metric", message, &one_of(&self.metric, &given));
            }
            match &self.sampler {
                Some(sampler) => stages.check_sampler(p, from, sampler),
                None => {
                    if let Err(differ) = measured_with(stages.samplers_of(from)) {
                        p.add(&format!("from[{i}]"), undecided(from, &differ), SAY_WHICH);
                    }
                }
            }
        }
        self.check_gates(stages, p);
    }
}

/// Lists `one of ...`, with those most similar to `wanted` first: at most a few, without the ends of intervals.
fn one_of(wanted: &str, given: &BTreeSet<String>) -> String {
    if given.is_empty() {
        return "add an `evaluate.*` stage".to_owned();
    }
    let plain = |name: &&String| !name.ends_with(".lower") && !name.ends_with(".upper");
    let mut names: Vec<&String> = given.iter().filter(plain).collect();
    names.sort_by_key(|name| (name.contains('.') != wanted.contains('.'), std::cmp::Reverse(alike(wanted, name))));
    let more = names.len().saturating_sub(LISTED);
    let listed = names.iter().take(LISTED).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
    let near = nearest(wanted, names.iter().map(|name| name.as_str()));
    let meant = near.map(|near| format!("did you mean `{near}`? ")).unwrap_or_default();
    let listed = format!("{meant}use one of {listed}");
    if more > 0 { format!("{listed} and {more} more") } else { listed }
}

/// Number of equal letters at equal places.
fn alike(a: &str, b: &str) -> usize {
    a.bytes().zip(b.bytes()).filter(|(a, b)| a == b).count()
}

/// Largest number of metrics that a message lists.
const LISTED: usize = 12;

/// Advice for evaluations that differ.
const SAY_WHICH: &str = "set the sampler of the version, for example `sampler: {steps: 1, guidance: 2}`";

/// Message for evaluations of `from` with different samplers, without an explicit one.
fn undecided(from: &str, differ: &str) -> String {
    format!("the evaluations of `{from}` use different samplers ({differ}), but a version has one sampler")
}

impl Register {
    /// Refuses gates on metrics that no candidate has.
    fn check_gates(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let all: Option<Vec<BTreeSet<String>>> = self.from.iter().map(|from| stages.metrics_of(from)).collect();
        // Without candidates, that is the mistake.
        let all = all.filter(|all| !all.is_empty());
        let Some(given) = all.map(|all| all.into_iter().flatten().collect::<BTreeSet<String>>()) else { return };
        for (i, gate) in self.promote.require.iter().enumerate().filter(|(_, gate)| is_gate(gate)) {
            let metric = gate.split(['<', '>']).next().unwrap_or_default().trim();
            if !given.contains(metric) {
                let message =
                    format!("the gate `{gate}` needs `{metric}`, but no evaluation of a candidate reports it");
                p.add(&format!("promote.require[{i}]"), message, &one_of(metric, &given));
            }
        }
    }

    /// Parts that are added to every version: role, and the stage that gives it.
    pub fn parts(&self) -> impl Iterator<Item = (Role, &str)> {
        [(Role::LENGTH, self.length.as_str())].into_iter().filter(|(_, stage)| !stage.is_empty())
    }

    /// Default sampler of a version of `from`: the one in these settings, or that of its evaluations. `None` without
    /// evaluations.
    ///
    /// # Errors
    /// The evaluations that differ, and the setting to add.
    pub fn sampler_of<'a>(
        &'a self,
        from: &str,
        evaluations: impl IntoIterator<Item = (&'a str, &'a Sampler)>,
    ) -> Result<Option<&'a Sampler>, String> {
        match &self.sampler {
            Some(sampler) => Ok(Some(sampler)),
            None => measured_with(evaluations).map_err(|differ| format!("{}; {SAY_WHICH}", undecided(from, &differ))),
        }
    }
}

impl Promote {
    fn check(&self, p: &mut Problems) {
        if !self.to.is_empty() && !is_name(&self.to) {
            let message = format!(
                "`{}` is not a valid alias; expected letters, digits, `.`, `_` or `-`, at most 64 characters",
                self.to
            );
            p.add("promote.to", message, "");
        }
        if self.to.is_empty() && !self.require.is_empty() {
            p.add(
                "promote.require",
                "`promote.require` has gates, but `promote.to` is missing; set it to an alias",
                "",
            );
        }
        for gate in self.require.iter().filter(|gate| !is_gate(gate)) {
            let message =
                format!("`{gate}` is not a gate; expected a metric, one of <= >= < >, and a number or an alias");
            p.add("promote.require", message, "for example \"latent_fid <= 0.3\"");
        }
    }
}

/// Checks for `metric <= number`, or with `alias`, `alias + number`, `alias - number` on the right.
fn is_gate(gate: &str) -> bool {
    let Some(at) = gate.find(['<', '>']) else { return false };
    let (metric, rest) = gate.split_at(at);
    let metric = metric.trim();
    let Some(right) = ["<=", ">=", "<", ">"].iter().find_map(|operator| rest.strip_prefix(operator)) else {
        return false;
    };
    let metric_fits = !metric.is_empty()
        && metric.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-' | b'@' | b'/'));
    let number = |text: &str| text.parse::<f64>().is_ok_and(f64::is_finite);
    let words: Vec<&str> = right.split_whitespace().collect();
    let right_fits = match words[..] {
        [bound] => number(bound) || (is_name(bound) && bound.parse::<f64>().is_err()),
        [alias, "+" | "-", offset] => is_name(alias) && number(offset),
        _ => false,
    };
    metric_fits && right_fits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gates_are_comparisons() {
        for good in [
            "latent_fid <= 0.3",
            "fid<=0.05",
            "fid.upper <= 0.05",
            "eval.r_precision_top1 >= staging - 0.005",
            "a > 1",
            "a < prod",
            "fid.upper <= 0.05",
        ] {
            assert!(is_gate(good), "{good}");
        }
        for bad in ["", "latent_fid", "<= 1", "a <= ", "a => 1", "a == 1", "a <= b c", "a b <= 1", "a <= nan"] {
            assert!(!is_gate(bad), "{bad}");
        }
    }
}
