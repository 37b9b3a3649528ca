//! Draws: motions of registered models for sentences.
//!
//! A draw is a run of the pipeline [`PIPELINE`] with a stage `draw.motions` for each model. So an idle worker claims it like other work,
//! its result has a key, and the same draw is answered from the store. The motions are in the stage's artifact, in the viewer's form.

use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::{Extension, Json};
use protocol::message::Submit;
use protocol::stage::Backend;
use protocol::{Owner, RunId, StageName, limits};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::actor_handle::ActorHandle;
use super::audit::Object;
use super::body::Message;
use super::failure::Failure;
use super::queries::place;
use crate::state::State as Decided;

/// Name of the pipeline of draws, and so the beginning of their runs' names.
const PIPELINE: &str = "draw";

/// `POST /v1/draws`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Draw {
    /// Model versions, such as `quickstart@prod` or `quickstart:3`.
    pub models: Vec<String>,
    /// Each model draws each sentence once.
    pub sentences: Vec<String>,
    /// Length in seconds; each model has a default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Seed of the noise, the same for all models and sentences.
    #[serde(default)]
    pub seed: u64,
    /// Number of network evaluations; the default is that of the model's evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
    /// Guidance scale; the default is that of the model's evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guidance: Option<f64>,
}

/// The answer to [`Draw`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Drawing {
    /// The run whose end is waited for.
    pub run: RunId,
    /// Its stages, in the order of the models. The artifact `report` of each has the file `motions.json`.
    pub stages: Vec<StageName>,
}

pub(crate) async fn draw(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Message(draw, _): Message<Draw>,
) -> Result<(Extension<Object>, Json<Drawing>), Failure> {
    let owner = caller.owner();
    let state = actor_handle.state();
    check_waiting(&state, &owner)?;
    let (source, stages) = written(&draw, backend(&state))?;
    drop(state);
    let mut read = pipeline::read(PIPELINE, &source, &[]).map_err(|mistakes| {
        let first = mistakes.0.into_iter().next();
        let failure = Failure::invalid(first.as_ref().map_or("no draw".to_owned(), |mistake| mistake.message.clone()));
        match first.and_then(|mistake| mistake.help) {
            Some(help) => failure.hint(&help),
            None => failure,
        }
    })?;
    read.stages.retain(|stage| stages.contains(&stage.name));
    let pipeline = serde_json::to_value(&read).map_err(|error| Failure::invalid(error.to_string()))?;
    let submit = Submit { pipeline, source, idempotency_key: None, until: None };
    let _place = place(&actor_handle)?;
    let run = actor_handle.submit(submit, owner, caller.sees()).await?;
    Ok((Extension(Object::Changed(run.to_string())), Json(Drawing { run, stages })))
}

/// Refuses a draw where too many are under way. Calls that are decided at the same moment may exceed the limit by their number.
fn check_waiting(state: &Decided, owner: &Owner) -> Result<(), Failure> {
    let waiting = || state.runs.values().filter(|run| run.pipeline.name == PIPELINE);
    let own = waiting().filter(|run| run.owner.group() == owner.group()).count();
    if own >= limits::DRAWS_WAITING_EACH || waiting().count() >= limits::DRAWS_WAITING {
        let message = format!("{own} of your draws are under way; at most {} are", limits::DRAWS_WAITING_EACH);
        return Err(Failure::busy(message).hint("wait until one has ended, or cancel its run"));
    }
    Ok(())
}

/// The backend of an idle worker, or of any worker that is here.
fn backend(state: &Decided) -> Backend {
    let workers = state.worker_views();
    let of = |wanted: &str| workers.iter().find(|worker| worker.state == wanted).map(|worker| worker.backend);
    of("idle").or_else(|| of("working")).unwrap_or_default()
}

/// The pipeline of a draw as its file, and the stage of each model.
fn written(draw: &Draw, backend: Backend) -> Result<(String, Vec<StageName>), Failure> {
    let counted = |what: &str, count: usize, most: usize| match count {
        0 => Err(Failure::invalid(format!("`{what}` is empty; expected 1 to {most}"))),
        count if count > most => Err(Failure::invalid(format!("{count} `{what}`; expected 1 to {most}"))),
        _ => Ok(()),
    };
    counted("models", draw.models.len(), limits::DRAW_MODELS)?;
    counted("sentences", draw.sentences.len(), limits::DRAW_SENTENCES)?;
    if draw.seconds.is_some_and(|seconds| seconds <= 0.0) {
        return Err(Failure::invalid("`seconds` is not above 0".to_owned()));
    }
    if draw.steps == Some(0) || draw.guidance.is_some_and(|guidance| guidance < 0.0) {
        return Err(Failure::invalid("`steps` is 0, or `guidance` is below 0".to_owned()));
    }
    let (mut stages, mut names) = (Map::new(), Vec::new());
    for (i, model) in draw.models.iter().enumerate() {
        if !protocol::model_ref::names_version(model) {
            return Err(Failure::invalid(format!("`models[{i}]` names no version"))
                .hint("expected `MODEL@ALIAS`, `MODEL@best` or `MODEL:VERSION`"));
        }
        let mut settings =
            json!({"kind": "draw.motions", "model": model, "sentences": draw.sentences, "seed": draw.seed});
        let mut set = |key: &str, value: Option<Value>| {
            if let Some(value) = value {
                settings[key] = value;
            }
        };
        set("seconds", draw.seconds.map(Value::from));
        set("steps", draw.steps.map(Value::from));
        set("guidance", draw.guidance.map(Value::from));
        let mut name = stage_name(model);
        if stages.contains_key(&name) {
            name = format!("{name}-{i}");
        }
        stages.insert(name.clone(), settings);
        names.push(StageName::new(name));
    }
    // JSON is YAML. A pipeline has a dataset, which no draw reads.
    let file = json!({"name": PIPELINE, "backend": backend, "dataset": {"format": "synthetic"}, "stages": stages});
    Ok((file.to_string(), names))
}

/// A stage's name for a version. The name is part of the key, so that the same version has the same one in every draw.
fn stage_name(model: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' };
    format!("m-{}", model.chars().take(40).map(plain).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked() -> Draw {
        Draw {
            models: vec!["walks@prod".into(), "walks:3".into()],
            sentences: vec!["a person \"walks\"\n: {oddly}".into()],
            seconds: Some(2.5),
            seed: 7,
            steps: None,
            guidance: Some(0.0),
        }
    }

    #[test]
    fn a_draw_is_a_pipeline_with_a_stage_for_each_model() {
        let draw = asked();
        let (text, names) = written(&draw, Backend::Flex).unwrap_or_default();
        assert_eq!(names, ["m-walks-prod", "m-walks-3"].map(StageName::new));
        let read = pipeline::read("draw", &text, &[]).map_err(|mistakes| mistakes.to_string());
        let settings: Vec<Value> =
            read.into_iter().flat_map(|read| read.stages).map(|stage| json!(stage.settings)).collect();
        let settings = &settings[settings.len() - 2..];
        for (settings, model) in settings.iter().zip(&draw.models) {
            assert_eq!(settings["sentences"], json!(draw.sentences));
            assert_eq!((&settings["model"], &settings["seed"]), (&json!(model), &json!(7)));
            assert_eq!(
                (&settings["seconds"], &settings["guidance"], &settings["steps"]),
                (&json!(2.5), &json!(0.0), &json!(0))
            );
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        for (change, says) in [
            (Draw { models: vec![], ..asked() }, "`models` is empty"),
            (Draw { models: vec!["walks@prod".into(); 5], ..asked() }, "5 `models`; expected 1 to 4"),
            (Draw { models: vec!["walks".into()], ..asked() }, "`models[0]` names no version"),
            (Draw { sentences: vec![], ..asked() }, "`sentences` is empty"),
            (Draw { seconds: Some(0.0), ..asked() }, "`seconds` is not above 0"),
            (Draw { steps: Some(0), ..asked() }, "`steps` is 0"),
        ] {
            let refused = written(&change, Backend::Flex).err().map(|failure| format!("{failure:?}"));
            assert!(refused.as_ref().is_some_and(|refused| refused.contains(says)), "{refused:?}");
        }
    }
}
