//! Collection of the models that a `register` stage registers, with samplers and metrics, and choice of the best.
//!
//! The coordinator registers models itself, because this changes the registry. Versions, the move of the alias and the
//! stage's value are one transaction, so that a failed gate leaves no trace.

use std::collections::BTreeMap;

use checkpoint::model::Parts;
use pipeline::PipelineStage;
use protocol::stage::{Mode, Register, Sampler};
use protocol::{Alias, Digest, ModelName, StageName};
use registry::Write;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::state::run::{Run, Status, value};
use crate::value::{Candidate, Known};

/// The data of a register stage, complete once its inputs are available.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Registration {
    /// The models in the order of `from`.
    pub candidates: Vec<Candidate>,
    /// Metrics of each candidate.
    pub metrics: Vec<BTreeMap<String, f64>>,
    /// Keys of the stages that produced the candidates.
    pub keys: Vec<Digest>,
    /// Index of the best candidate.
    pub best: usize,
    pub model: ModelName,
    /// The metric that ranks versions, and its direction.
    pub by: (String, Mode),
    /// The alias to move, and its gates.
    pub promote: Option<(Alias, Vec<String>)>,
}

impl Registration {
    /// Collects candidates and their metrics from the stages of `run`, which are all done.
    ///
    /// # Errors
    /// The reason as text for the user, without the stage's name, which is shown beside it.
    pub fn gather(run: &Run, settings: &Register) -> Result<Self, String> {
        let model = settings.model.parse::<ModelName>().map_err(|e| format!("`model`: {e}"))?;
        let promote = match settings.promote.to.as_str() {
            "" => None,
            alias => {
                let alias = alias.parse::<Alias>().map_err(|e| format!("`promote.to`: {e}"))?;
                if !run.owner.promotes {
                    return Err(format!("`promote.to`: the token of `{}` may not promote", run.owner));
                }
                Some((alias, settings.promote.require.clone()))
            }
        };
        let mut parts = Parts::new();
        for (role, stage) in settings.parts() {
            let part = output(run, &StageName::new(stage));
            parts.insert(role, part.ok_or_else(|| format!("stage `{stage}` has no output"))?);
        }
        let mut candidates = Vec::new();
        let mut metrics = Vec::new();
        let mut keys = Vec::new();
        for from in &settings.from {
            let stage = StageName::new(from.as_str());
            let model = output(run, &stage).ok_or_else(|| format!("`from`: stage `{from}` has no output"))?;
            let samplers = evaluations_of(run, from)
                .filter_map(|(stage, _)| Some((stage.name.as_str(), stage.settings.sampler()?)));
            let sampler = settings.sampler_of(from, samplers).map_err(|why| format!("`from`: {why}"))?.cloned();
            keys.extend(run.status(&stage).and_then(|status| status.key()));
            metrics.push(metrics_of(run, from, sampler.as_ref()));
            candidates.push(Candidate { stage, model, sampler, parts: parts.clone() });
        }
        let best = best(&settings.from, &metrics, settings)?;
        let by = (settings.metric.clone(), settings.mode);
        Ok(Self { candidates, metrics, keys, best, model, by, promote })
    }

    /// The stage's value and the writes that register it for `run`, given the stored bundle of each candidate.
    pub fn writes(&self, run: &Run, stage: &StageName, bundles: &[Digest]) -> (Known, Vec<Write>) {
        let mut writes = vec![Write::ModelOwner { model: self.model.clone(), owner: run.owner.clone() }];
        let (metric, mode) = &self.by;
        for (i, artifact) in bundles.iter().enumerate() {
            writes.push(Write::Version {
                model: self.model.clone(),
                artifact: *artifact,
                metrics: self.metrics[i].clone(),
                source: json!({
                    "run": run.id, "stage": self.candidates[i].stage, "key": self.keys[i], "metric": metric, "mode": mode,
                }),
            });
        }
        if let Some((alias, require)) = &self.promote {
            writes.push(Write::Promote {
                model: self.model.clone(),
                alias: alias.clone(),
                artifact: bundles[self.best],
                require: require.clone(),
                reason: format!("best of stage `{stage}`"),
                actor: format!("{}, run {}", run.owner, run.id),
            });
        }
        let outputs = BTreeMap::from([("model".to_owned(), bundles[self.best])]);
        (Known { outputs, metrics: self.metrics[self.best].clone() }, writes)
    }
}

fn output(run: &Run, stage: &StageName) -> Option<Digest> {
    value(run.status(stage)?.known()?).copied()
}

/// The evaluations of `model`.
fn evaluations_of<'a>(run: &'a Run, model: &'a str) -> impl Iterator<Item = (&'a PipelineStage, &'a Status)> {
    let stages = run.pipeline.stages.iter().zip(&run.stages);
    stages.filter(move |(stage, _)| stage.settings.evaluated_model().as_deref() == Some(model))
}

/// The metrics of all evaluations of `model`. If there are several (such as a student at one and at four steps), each
/// also has its own metrics as `stage.metric`. The plain name, with its interval, belongs to the first evaluation that
/// has the metric. Evaluations with the version's own sampler precede others.
fn metrics_of(run: &Run, model: &str, sampler: Option<&Sampler>) -> BTreeMap<String, f64> {
    let mut looking: Vec<_> = evaluations_of(run, model).collect();
    looking.sort_by_key(|(stage, _)| stage.settings.sampler() != sampler);
    let known: Vec<_> =
        looking.into_iter().filter_map(|(stage, status)| Some((&stage.name, &status.known()?.metrics))).collect();
    together(&known)
}

fn together(known: &[(&StageName, &BTreeMap<String, f64>)]) -> BTreeMap<String, f64> {
    let mut all = BTreeMap::new();
    let mut first = BTreeMap::new();
    for (stage, metrics) in known {
        for (metric, value) in *metrics {
            if known.len() > 1 {
                all.insert(format!("{stage}.{metric}"), *value);
            }
            let measured = metric.split_once('.').map_or(metric.as_str(), |(measured, _)| measured);
            if *first.entry(measured).or_insert(*stage) == *stage {
                all.insert(metric.clone(), *value);
            }
        }
    }
    all
}

/// The candidate with the best value; the first one in a tie. A single candidate needs no evaluation.
fn best(from: &[String], metrics: &[BTreeMap<String, f64>], settings: &Register) -> Result<usize, String> {
    if from.len() == 1 && metrics[0].is_empty() {
        return Ok(0);
    }
    let metric = &settings.metric;
    let mut best: Option<(usize, f64)> = None;
    for (i, stage) in from.iter().enumerate() {
        let value = match metrics[i].get(metric) {
            Some(value) if value.is_finite() => *value,
            Some(value) => {
                return Err(format!("`metric`: `{metric}` of `{stage}` is {value}, which cannot be ranked"));
            }
            None if metrics[i].is_empty() => {
                return Err(format!(
                    "`metric`: no stage evaluates `{stage}`; add an `evaluate.latent_fid` stage with `model: {stage}`"
                ));
            }
            None => {
                let known: Vec<&str> = metrics[i].keys().map(String::as_str).collect();
                return Err(format!(
                    "`metric`: no evaluation of `{stage}` has `{metric}`; expected one of: {}",
                    known.join(", ")
                ));
            }
        };
        let better = best.is_none_or(|(_, other)| match settings.mode {
            Mode::Min => value < other,
            Mode::Max => value > other,
        });
        if better {
            best = Some((i, value));
        }
    }
    best.map(|(i, _)| i).ok_or_else(|| "`from`: names no stage".to_owned())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use pipeline::Pipeline;
    use protocol::Owner;

    use super::*;

    fn pipeline() -> Pipeline {
        let text = "name: p\nseed: 1\ndataset: {format: synthetic}\nstages:\n  vae: {kind: train.vae}\n  latents: {kind: encode.latents}\n  \
                    mld: {kind: train.mld}\n  fid: {kind: evaluate.latent_fid, model: mld}\n  release: {kind: register, model: m, from: mld, promote: {to: prod}}\n";
        pipeline::read("p.yaml", text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"))
    }

    #[test]
    fn a_promotion_is_its_submitters_and_bears_token_and_run() {
        let run = |promotes| {
            let owner = Owner { name: "alice".into(), project: Some("motion".into()), promotes, admin: false };
            Run::new(3, owner, Arc::new(pipeline()), None, None)
        };
        let release = pipeline().stages.into_iter().next_back().expect("a stage");
        let settings = release.settings.get::<Register>().expect("`register`").clone();
        let refused = Registration::gather(&run(false), &settings).unwrap_err();
        assert_eq!(refused, "`promote.to`: the token of `alice (motion)` may not promote");
        let without = Register { promote: Default::default(), ..settings.clone() };
        let other = Registration::gather(&run(false), &without).unwrap_err();
        assert!(!other.contains("promote"), "without an alias it needs no scope: {other}");

        let candidate = Candidate { stage: "mld".into(), model: Digest::of(b"m"), sampler: None, parts: Parts::new() };
        let registration = Registration {
            candidates: vec![candidate],
            metrics: vec![BTreeMap::new()],
            keys: vec![Digest::of(b"key")],
            best: 0,
            model: "m".into(),
            by: ("fid".into(), Mode::Min),
            promote: Some(("prod".into(), Vec::new())),
        };
        let run = run(true);
        let (_, writes) = registration.writes(&run, &"release".into(), &[Digest::of(b"bundle")]);
        let [Write::ModelOwner { owner, .. }, Write::Version { source, .. }, Write::Promote { actor, .. }] =
            &writes[..]
        else {
            panic!("{writes:?}");
        };
        assert_eq!(*owner, run.owner);
        assert_eq!(source["run"], run.id.as_str());
        assert_eq!(*actor, format!("alice (motion), run {}", run.id));
    }

    #[test]
    fn a_plain_name_and_its_interval_are_of_one_evaluation() {
        let metrics = |pairs: &[(&str, f64)]| -> BTreeMap<String, f64> {
            pairs.iter().map(|(key, value)| ((*key).to_owned(), *value)).collect()
        };
        let one = StageName::new("one");
        let four = StageName::new("four");
        let first = metrics(&[("fid", 0.3), ("latent_fid", 0.1)]);
        let second =
            metrics(&[("fid", 0.2), ("fid.lower", 0.1), ("fid.upper", 0.3), ("top1", 0.5), ("top1.upper", 0.6)]);
        let all = together(&[(&one, &first), (&four, &second)]);
        let plain: BTreeMap<_, _> =
            all.iter().filter(|(key, _)| !key.starts_with("one.") && !key.starts_with("four.")).collect();
        let expected = metrics(&[("fid", 0.3), ("latent_fid", 0.1), ("top1", 0.5), ("top1.upper", 0.6)]);
        assert_eq!(plain, expected.iter().collect());
        assert_eq!(all["four.fid.upper"], 0.3);
        assert_eq!(together(&[(&four, &second)]), second);
    }

    fn pick(settings: &Register, candidates: &[&[(&str, f64)]]) -> Result<usize, String> {
        let from: Vec<String> = (0..candidates.len()).map(|i| format!("s{i}")).collect();
        let metrics = |all: &&[(&str, f64)]| all.iter().map(|(key, value)| ((*key).to_owned(), *value)).collect();
        best(&from, &candidates.iter().map(metrics).collect::<Vec<_>>(), settings)
    }

    #[test]
    fn the_best_is_picked_by_metric_and_direction() {
        let by = |metric: &str, mode| Register { metric: metric.into(), mode, ..Register::default() };
        let three: [&[(&str, f64)]; 3] =
            [&[("fid", 0.3), ("r", 0.5)], &[("fid", 0.2), ("r", 0.9)], &[("fid", 0.2), ("r", 0.1)]];
        assert_eq!(pick(&by("fid", Mode::Min), &three), Ok(1), "the first of equals");
        assert_eq!(pick(&by("fid", Mode::Max), &three), Ok(0));
        assert_eq!(pick(&by("r", Mode::Max), &three), Ok(1));
        assert_eq!(pick(&by("fid", Mode::Min), &[&[]]), Ok(0), "the only one needs no judge");
        // An unknown metric, with several candidates and with one.
        for candidates in [&three[..], &three[..1]] {
            let refused = pick(&by("fdi", Mode::Min), candidates).unwrap_err();
            assert!(refused.contains("`fdi`") && refused.contains("fid, r") && refused.contains("`s0`"), "{refused}");
        }
        let refused = pick(&by("fid", Mode::Min), &[&[("fid", 1.0)], &[("fid", f64::NAN)]]).unwrap_err();
        assert!(refused.contains("`s1` is NaN"), "{refused}");
        let refused = pick(&by("fid", Mode::Min), &[&[("fid", 1.0)], &[]]).unwrap_err();
        assert!(refused.contains("no stage evaluates `s1`"), "{refused}");
    }
}
