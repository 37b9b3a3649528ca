//! Draws: motions of registered models, or of checkpoints, for sentences.
//!
//! A draw is a run of the pipeline [`PIPELINE`] with a stage `draw.motions` for each model. So an idle worker claims it
//! like other work, or one that is kept for draws, and its result has a key: the same draw is answered from the store. The motions are in the stage's
//! artifact, in the viewer's form. A checkpoint has one more stage, which makes a model of it.

use std::collections::BTreeMap;
use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::{Extension, Json};
use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::message::Submit;
use protocol::stage::{Backend, DrawMotions, Placement, StageSettings};
use protocol::{ArtifactKind, Labels, Owner, RunId, Seed, StageName, labels, limits};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::actor_handle::ActorHandle;
use super::audit::Object;
use super::body::Message;
use super::checkpoints::{CheckpointName, stage_at};
use super::failure::Failure;
use super::queries::{idempotency_key, place};
use crate::state::State as Decided;
use crate::state::run::Run;
use crate::view::WorkerView;

/// Name of the pipeline of draws, and so the beginning of their runs' names.
const PIPELINE: &str = "draw";

/// `POST /v1/draws`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Draw {
    /// Model versions, such as `quickstart@prod` or `quickstart:3`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub models: Vec<String>,
    /// Checkpoints of trainings, in the place of models.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub checkpoints: Vec<CheckpointName>,
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
    /// Its drawing stages, in the order of the models or checkpoints. The artifact `report` of each has the file `motions.json`, and for motion
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
    let mut pipeline = drawing(&draw)?;
    let source = file(&pipeline);
    let stages = pipeline.stages.iter().map(|stage| stage.name.clone()).collect();
    let state = actor_handle.state();
    check_waiting(&state, &owner)?;
    let (backend, requires) = drawers(&state);
    pipeline.backend = backend;
    drop(state);
    let _place = place(&actor_handle)?;
    let submit = |pipeline: &Pipeline| Submit { pipeline: json!(pipeline), source, idempotency_key, until: None };
    let run = if draw.checkpoints.is_empty() {
        require(&mut pipeline, &requires);
        actor_handle.submit(submit(&pipeline), owner, caller.sees()).await?
    } else {
        let records = actor_handle.records_for(caller.sees());
        let draws = std::mem::take(&mut pipeline.stages);
        for (mut draw, checkpoint) in draws.into_iter().zip(&draw.checkpoints) {
            let name = StageName::new(format!("c{}", draw.name.as_str().trim_start_matches('m')));
            let model = stage_at(&records, checkpoint, name.clone()).await?;
            draw.settings.refs().into_iter().for_each(|reference| name.as_str().clone_into(reference.name));
            draw.inputs = vec![StageInput { field: "model".into(), stage: name, kind: ArtifactKind::Model }];
            pipeline.stages.extend([model, draw]);
        }
        pipeline.note_code_versions();
        require(&mut pipeline, &requires);
        let submit = submit(&pipeline);
        actor_handle.submit_own(pipeline, submit, owner).await?
    };
    Ok((Extension(Object::Changed(run.to_string())), Json(Drawing { run, stages })))
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
    let draws = |settings: &StageSettings| settings.get::<DrawMotions>().is_some();
    run.pipeline.name == PIPELINE && run.pipeline.stages.iter().any(|stage| draws(&stage.settings))
}

/// Backend and labels of the workers that draw. A worker that is kept for draws comes first. Without one, the labels are
/// empty, and the backend is that of an idle worker, otherwise of a working one.
fn drawers(state: &Decided) -> (Backend, Labels) {
    let kept = Labels::from_iter([labels::ONLY_DRAWS.to_owned()]);
    let workers = state.worker_views();
    let of = |wanted: &str, required: &Labels| {
        let fits = |worker: &&WorkerView| worker.state == wanted && worker.labels.have(required);
        workers.iter().find(fits).map(|worker| worker.backend)
    };
    if let Some(backend) = of("idle", &kept).or_else(|| of("working", &kept)) {
        return (backend, kept);
    }
    let any = Labels::default();
    (of("idle", &any).or_else(|| of("working", &any)).unwrap_or_default(), any)
}

/// Lets all stages require labels of their workers.
fn require(pipeline: &mut Pipeline, labels: &Labels) {
    for stage in &mut pipeline.stages {
        stage.placement.requires = labels.clone();
    }
}

/// The name that a checkpoint has as a model until the stage that makes one of it has a name.
const CHECKPOINT: &str = "checkpoint:1";

/// The pipeline of a draw: a drawing stage for each model or checkpoint.
fn drawing(draw: &Draw) -> Result<Pipeline, Failure> {
    let most = limits::DRAW_MODELS;
    let models = match (draw.models.len(), draw.checkpoints.len()) {
        (0, 0) => return Err(Failure::invalid(format!("`models` is empty; expected 1 to {most}"))),
        (1.., 1..) => return Err(Failure::invalid("the draw has `models` and `checkpoints`; expected one".to_owned())),
        (models, checkpoints) if models.max(checkpoints) > most => {
            let message = format!("{} `models` or `checkpoints`; expected 1 to {most}", models.max(checkpoints));
            return Err(Failure::invalid(message));
        }
        (0, _) => draw.checkpoints.iter().map(|at| (CHECKPOINT, format!("{}-{}", at.stage, at.step))).collect(),
        _ => draw.models.iter().map(|model| (model.as_str(), model.clone())).collect::<Vec<_>>(),
    };
    if !(1..=limits::DRAW_SENTENCES).contains(&draw.sentences.len()) {
        let count = draw.sentences.len();
        let most = limits::DRAW_SENTENCES;
        return Err(Failure::invalid(format!("{count} `sentences`; expected 1 to {most}")));
    }
    if !(1..=limits::DRAW_COUNT).contains(&draw.count) {
        return Err(Failure::invalid(format!("`count` is {}; expected 1 to {}", draw.count, limits::DRAW_COUNT)));
    }
    if draw.seconds.is_some_and(|seconds| seconds <= 0.0) {
        return Err(Failure::invalid("`seconds` is not above 0".to_owned()));
    }
    if draw.steps == Some(0) || draw.guidance.is_some_and(|guidance| guidance < 0.0) {
        return Err(Failure::invalid("`steps` is 0, or `guidance` is below 0".to_owned()));
    }
    let mut stages: Vec<PipelineStage> = Vec::with_capacity(models.len());
    for (i, (model, word)) in models.into_iter().enumerate() {
        if !protocol::model_ref::names_version(model) {
            return Err(Failure::invalid(format!("`models[{i}]` names no version"))
                .hint("expected `MODEL@ALIAS`, `MODEL@best` or `MODEL:VERSION`"));
        }
        let mut name = stage_name(&word);
        if stages.iter().any(|stage| stage.name == name) {
            name = StageName::new(format!("{name}-{i}"));
        }
        stages.push(PipelineStage {
            name,
            settings: settings(draw, model).into(),
            placement: Placement::default(),
            inputs: Vec::new(),
            external: BTreeMap::new(),
            sweep: None,
            derived: None,
            copy_of: None,
        });
    }
    let backend = Backend::default();
    let pipeline =
        Pipeline { name: PIPELINE.into(), seed: Seed(0), backend, priority: 0, stages, code_versions: BTreeMap::new() };
    pipeline.check().map_err(Failure::invalid)?;
    Ok(pipeline)
}

fn settings(draw: &Draw, model: &str) -> DrawMotions {
    DrawMotions {
        model: model.to_owned(),
        sentences: draw.sentences.clone(),
        count: draw.count,
        seconds: draw.seconds.unwrap_or(0.0),
        path: draw.path.clone(),
        seed: Seed(draw.seed),
        steps: draw.steps.unwrap_or(0),
        guidance: draw.guidance.unwrap_or(-1.0),
    }
}

/// The file of a pipeline. JSON is YAML; a file has a dataset, which no draw reads.
fn file(pipeline: &Pipeline) -> String {
    let settings = |stage: &PipelineStage| (stage.name.to_string(), json!(stage.settings));
    let stages: Map<String, Value> = pipeline.stages.iter().map(settings).collect();
    json!({"name": pipeline.name, "dataset": {"format": "synthetic"}, "stages": stages}).to_string()
}

/// A stage's name for a version or a checkpoint, the same in every draw, because it is part of the stage's key.
fn stage_name(word: &str) -> StageName {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' };
    StageName::new(format!("m-{}", word.chars().take(40).map(plain).collect::<String>()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked() -> Draw {
        Draw {
            models: vec!["walks@prod".into(), "walks:3".into()],
            checkpoints: Vec::new(),
            sentences: vec!["a person \"walks\": {oddly}".into()],
            count: 2,
            seconds: Some(2.5),
            path: vec![[1.0, 0.0, 0.9, 0.5]],
            seed: 7,
            steps: None,
            guidance: Some(0.0),
        }
    }

    #[test]
    fn a_draw_is_a_pipeline_whose_file_reads() {
        let drawn = drawing(&asked()).expect("a valid draw");
        let names: Vec<&str> = drawn.stages.iter().map(|stage| stage.name.as_str()).collect();
        assert_eq!(names, ["m-walks-prod", "m-walks-3"]);
        let read = pipeline::read("draw", &file(&drawn), &[]).expect("a valid file");
        for stage in &drawn.stages {
            assert_eq!(read.stage(&stage.name), Some(stage));
        }
        let settings = drawn.stages[1].settings.get::<DrawMotions>().expect("`draw.motions`");
        assert_eq!((settings.model.as_str(), settings.seconds, settings.steps), ("walks:3", 2.5, 0));
        assert_eq!((settings.seed, settings.count, settings.guidance), (Seed(7), 2, 0.0));
    }

    #[test]
    fn an_invalid_draw_is_refused() {
        let checkpoint = CheckpointName { run: "r".into(), stage: "mld".into(), step: 3 };
        for (change, says) in [
            (Draw { models: vec![], ..asked() }, "`models` is empty"),
            (Draw { models: vec!["walks@prod".into(); 5], ..asked() }, "5 `models` or `checkpoints`; expected 1 to 4"),
            (Draw { models: vec!["walks".into()], ..asked() }, "`models[0]` names no version"),
            (Draw { checkpoints: vec![checkpoint], ..asked() }, "has `models` and `checkpoints`"),
            (Draw { sentences: vec![], ..asked() }, "0 `sentences`; expected 1 to 8"),
            (Draw { sentences: vec!["x".repeat(2000)], ..asked() }, "longer than 1000 bytes"),
            (Draw { count: 0, ..asked() }, "`count` is 0; expected 1 to 16"),
            (Draw { seconds: Some(0.0), ..asked() }, "`seconds` is not above 0"),
            (Draw { seconds: Some(1e9), ..asked() }, "seconds"),
            (Draw { steps: Some(0), ..asked() }, "`steps` is 0"),
        ] {
            let refused = drawing(&change).err().map(|failure| format!("{failure:?}"));
            assert!(refused.as_ref().is_some_and(|refused| refused.contains(says)), "{refused:?}");
        }
    }
}
