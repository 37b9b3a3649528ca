//! Pipelines with the stages of the quickstart.

use std::collections::BTreeMap;

use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::stage::{
    Backend, CheckpointPolicy, DataSynthetic, DistillLcm, DistillPcm, EncodeLatents, EvaluateLatentFid, Keep,
    Placement, Promote, Register, StageSettings, TextEmbed, TextEncoder, TrainMld, TrainVae, WorkerRange,
};
use protocol::{ArtifactKind, Seed, Steps};

/// All stages from clips to a promoted student.
pub(crate) fn quickstart(seed: u64, workers: WorkerRange, require: &[&str]) -> Pipeline {
    let evaluate = |model: &str| {
        StageSettings::EvaluateLatentFid(EvaluateLatentFid { model: model.into(), shards: 3, ..Default::default() })
    };
    let register = StageSettings::Register(Register {
        model: "quickstart".into(),
        from: vec!["lcm".into(), "pcm".into()],
        promote: Promote { to: "staging".into(), require: require.iter().map(|gate| (*gate).to_owned()).collect() },
        ..Default::default()
    });
    let stages = [
        ("dataset", StageSettings::DataSynthetic(DataSynthetic::default())),
        ("text", StageSettings::TextEmbed(TextEmbed::default())),
        ("vae", StageSettings::TrainVae(TrainVae::default())),
        ("latents", StageSettings::EncodeLatents(EncodeLatents { shards: 4, ..Default::default() })),
        ("mld", StageSettings::TrainMld(TrainMld::default())),
        ("lcm", StageSettings::DistillLcm(DistillLcm::default())),
        ("pcm", StageSettings::DistillPcm(DistillPcm::default())),
        ("fid-lcm", evaluate("lcm")),
        ("fid-pcm", evaluate("pcm")),
        ("release", register),
    ];
    let placement = Placement {
        workers,
        requires: Default::default(),
        checkpoint: CheckpointPolicy { every: Steps(3), keep: Keep { best: 1, ..Keep::default() } },
    };
    let stages = stages.map(|(name, settings)| {
        let mut inputs: Vec<StageInput> = settings
            .inputs()
            .into_iter()
            .map(|(field, stage, kind)| StageInput { field, stage: stage.as_str().into(), kind })
            .collect();
        if name == "release" {
            for stage in ["fid-lcm", "fid-pcm"] {
                let field = format!("evaluations.{stage}");
                inputs.push(StageInput { field, stage: stage.into(), kind: ArtifactKind::Report });
            }
        }
        PipelineStage {
            name: name.into(),
            settings,
            placement: placement.clone(),
            inputs,
            external: BTreeMap::new(),
            sweep: None,
            derived: None,
            copy_of: None,
        }
    });
    let (name, stages) = ("quickstart".into(), stages.to_vec());
    Pipeline { name, seed: Seed(seed), backend: Backend::Flex, priority: 0, stages, code_versions: BTreeMap::new() }
}

/// The same pipeline with a text encoder in a folder without a known digest.
#[allow(dead_code, reason = "not every test that shares this file reads files")]
pub(crate) fn reading_files(mut pipeline: Pipeline) -> Pipeline {
    let text = pipeline.stages.iter_mut().find(|stage| stage.name.as_str() == "text").expect("a stage `text`");
    let encoder = TextEmbed { encoder: TextEncoder::Clip, path: "models/clip".into(), ..TextEmbed::default() };
    text.settings = encoder.into();
    pipeline
}

/// A sweep of `trials` trials with three rungs, and stages that read its best trial.
#[allow(dead_code, reason = "not every test that shares this file sweeps")]
pub(crate) fn swept(seed: u64, trials: u64) -> Pipeline {
    let text = format!(
        "name: swept
seed: {seed}
dataset: {{format: synthetic}}
stages:
  vae: {{kind: train.vae}}
  latents: {{kind: encode.latents, shards: 2}}
  mld: {{kind: train.mld}}
  pcm:
    kind: distill.pcm
    steps: 18
    checkpoint: {{every: 3}}
    sweep:
      metric: latent_fid
      trials: {trials}
      parallel: 6
      rungs: {{first: 2, factor: 3}}
      space: {{adversarial: {{choice: [0, 0.1, 1]}}, skip: {{choice: [50, 100]}}, ema: {{uniform: [0.9, 0.99]}}}}
      evaluate: {{kind: evaluate.latent_fid, shards: 2}}
  fid: {{kind: evaluate.latent_fid, model: pcm@best, shards: 2}}
  release: {{kind: register, model: m, from: pcm}}
"
    );
    pipeline::read("swept.yaml", &text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"))
}
