//! Draws: motions of registered models for sentences.
//!
//! A draw is a run of the pipeline [`PIPELINE`] with a stage `draw.motions` for each model. So an idle worker claims it
//! like other work, and its result has a key: the same draw is answered from the store. The motions are in the stage's
//! artifact, in the viewer's form.

use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::{Extension, Json};
use protocol::message::Submit;
use protocol::stage::{Backend, StageSettings};
use protocol::{Owner, RunId, StageName, limits};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::actor_handle::ActorHandle;
use super::audit::Object;
use super::body::Message;
use super::failure::Failure;
use super::queries::{idempotency_key, place};
use crate::state::State as Decided;
use crate::state::run::Run;

/// Name of the pipeline of draws, and so the beginning of their runs' names.
const PIPELINE: &str = "draw";

/// `POST /v1/draws`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Draw {
    /// Model versions, such as `quickstart@prod` or `quickstart:3`.
    pub models: Vec<String>,
    /// Each model draws each sentence `count` times.
    pub sentences: Vec<String>,
    /// Motions of each sentence, with consecutive seeds.
    #[serde(default = "one")]
    pub count: usize,
    /// Length in seconds; each model has a default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Positions that the pelvis passes, as seconds and x, y, z in metres, for models with a control part. The motion
    /// starts at x = z = 0 and faces z.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub path: Vec<[f64; 4]>,
    /// Seed of the first motion's noise, the same for all models and sentences.
    #[serde(default)]
    pub seed: u64,
    /// Number of network evaluations; the default is that of the model's evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
    /// Guidance scale; the default is that of the model's evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guidance: Option<f64>,
}

fn one() -> usize {
    1
}

/// The answer to [`Draw`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Drawing {
    /// The run that draws. It has ended when all motions are stored.
    pub run: RunId,
    /// Its stages, in the order of the models. The artifact `report` of each has the file `motions.json`, and for motion
    /// `NN` the files `motion-NN.npy`, `motion-NN.bvh` and `motion-NN.glb`.
    pub stages: Vec<StageName>,
}

pub(crate) async fn draw(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    headers: HeaderMap,
    Message(draw, _): Message<Draw>,
) -> Result<(Extension<Object>, Json<Drawing>), Failure> {
    let owner = caller.owner();
    let idempotency_key = idempotency_key(&headers)?;
    let state = actor_handle.state();
    check_waiting(&state, &owner)?;
    let (source, stages) = written(&draw, backend(&state))?;
    drop(state);
    let pipeline = read(&source, &stages)?;
    let submit = Submit { pipeline, source, idempotency_key, until: None };
    let _place = place(&actor_handle)?;
    let run = actor_handle.submit(submit, owner, caller.sees()).await?;
    Ok((Extension(Object::Changed(run.to_string())), Json(Drawing { run, stages })))
}

/// Reads the pipeline of a draw, and leaves out its dataset.
fn read(source: &str, stages: &[StageName]) -> Result<Value, Failure> {
    let read = pipeline::read(PIPELINE, source, &[]);
    let mut pipeline = read.map_err(|mistakes| match mistakes.0.into_iter().next() {
        None => Failure::invalid("the draw is invalid".to_owned()),
        Some(mistake) => {
            let failure = Failure::invalid(mistake.message);
            mistake.help.iter().fold(failure, |failure, help| failure.hint(help))
        }
    })?;
    pipeline.stages.retain(|stage| stages.contains(&stage.name));
    serde_json::to_value(&pipeline).map_err(|error| Failure::invalid(error.to_string()))
}

/// Refuses a draw if too many are unfinished. Concurrent calls may exceed the limits by their number.
fn check_waiting(state: &Decided, owner: &Owner) -> Result<(), Failure> {
    let draws: Vec<&Run> = state.runs.values().map(AsRef::as_ref).filter(|run| is_draw(run)).collect();
    let own = draws.iter().filter(|run| run.owner.group() == owner.group()).count();
    if own >= limits::DRAWS_WAITING_EACH {
        let message = format!("{own} of your draws have not ended; expected fewer than {}", limits::DRAWS_WAITING_EACH);
        return Err(Failure::busy(message).hint("wait until one has ended, or cancel its run"));
    }
    if draws.len() >= limits::DRAWS_WAITING {
        return Err(Failure::busy(format!("{} draws have not ended", draws.len())).hint("wait until some have ended"));
    }
    Ok(())
}

fn is_draw(run: &Run) -> bool {
    let draws = |settings: &StageSettings| matches!(settings, StageSettings::DrawMotions(_));
    run.pipeline.name == PIPELINE && run.pipeline.stages.iter().all(|stage| draws(&stage.settings))
}

/// The backend of an idle worker, otherwise of a working one.
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
    if draw.count == 0 || draw.count > limits::DRAW_COUNT {
        return Err(Failure::invalid(format!("`count` is {}; expected 1 to {}", draw.count, limits::DRAW_COUNT)));
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
            json!({"kind": "draw.motions", "model": model, "sentences": draw.sentences, "count": draw.count, "path": draw.path, "seed": draw.seed});
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
    // JSON is YAML. A pipeline's dataset is required, but no draw reads it.
    let file = json!({"name": PIPELINE, "backend": backend, "dataset": {"format": "synthetic"}, "stages": stages});
    Ok((file.to_string(), names))
}

/// A stage's name for a version, the same in every draw, because it is part of the stage's key.
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
            count: 2,
            seconds: Some(2.5),
            path: vec![[1.0, 0.0, 0.9, 0.5]],
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
            assert_eq!((&settings["sentences"], &settings["path"]), (&json!(draw.sentences), &json!(draw.path)));
            assert_eq!((&settings["model"], &settings["seed"], &settings["count"]), (&json!(model), &json!(7), &json!(2)));
            assert_eq!(
                (&settings["seconds"], &settings["guidance"], &settings["steps"]),
                (&json!(2.5), &json!(0.0), &json!(0))
            );
        }
    }

    #[test]
    fn an_invalid_draw_is_refused() {
        for (change, says) in [
            (Draw { models: vec![], ..asked() }, "`models` is empty"),
            (Draw { models: vec!["walks@prod".into(); 5], ..asked() }, "5 `models`; expected 1 to 4"),
            (Draw { models: vec!["walks".into()], ..asked() }, "`models[0]` names no version"),
            (Draw { sentences: vec![], ..asked() }, "`sentences` is empty"),
            (Draw { count: 0, ..asked() }, "`count` is 0; expected 1 to 16"),
            (Draw { seconds: Some(0.0), ..asked() }, "`seconds` is not above 0"),
            (Draw { steps: Some(0), ..asked() }, "`steps` is 0"),
        ] {
            let refused = written(&change, Backend::Flex).err().map(|failure| format!("{failure:?}"));
            assert!(refused.as_ref().is_some_and(|refused| refused.contains(says)), "{refused:?}");
        }
    }
}
