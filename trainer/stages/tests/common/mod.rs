//! Every kind of stage, with sizes for which a step takes a few milliseconds.

use std::collections::BTreeMap;

use protocol::stage::{
    Batch, DataSynthetic, Decay, DistillLcm, DistillPcm, Distillation, EncodeLatents, EvaluateLatentFid,
    EvaluateReconstruction, LatentShape, Network, Optimizer, Replicas, Sampler, StageSettings, TextEmbed, TrainControl,
    TrainLength, TrainMld, TrainVae, Training,
};
use protocol::{Digest, Steps};
use stage_lab::Bench;

fn network() -> Network {
    Network { width: 16, layers: 3, heads: 2, feed_forward: 32, ..Network::default() }
}

fn training(steps: u64) -> Training {
    Training {
        steps: Steps(steps),
        batch: Batch { global: 6, slices: 6 },
        lr: 1e-3,
        warmup: Steps(2),
        decay: Decay::Cosine,
        optimizer: Optimizer::default(),
        max_grad_norm: 1.0,
        sync: Replicas::default(),
        stop: None,
    }
}

fn distillation(steps: u64) -> Distillation {
    Distillation {
        training: training(steps),
        guidance_dim: 16,
        guidance: (0.5, 5.0),
        ..DistillLcm::default().distillation
    }
}

/// Name, settings and inputs (field, stage).
pub(crate) type Link = (&'static str, StageSettings, Vec<(&'static str, &'static str)>);

/// Steps of the training stages, in order: vae, mld, lcm, pcm. The length estimator makes as many as the VAE, the
/// control part as many as the LCM.
pub(crate) type Steps4 = [u64; 4];

/// The stages in order.
pub(crate) fn chain(shards: usize, steps: Steps4) -> Vec<Link> {
    let data = DataSynthetic { clips: 24, val: 0.1, test: 0.25, mirror: false };
    let vae = TrainVae {
        latent: LatentShape { tokens: 2, dim: 8 },
        network: network(),
        training: training(steps[0]),
        ..TrainVae::default()
    };
    let mld = TrainMld { network: network(), ema: 0.9, training: training(steps[1]), ..TrainMld::default() };
    let lcm = DistillLcm { distillation: distillation(steps[2]) };
    let pcm = DistillPcm { phases: 2, distillation: distillation(steps[3]), ..DistillPcm::default() };
    let control =
        TrainControl { network: network(), embedding: 12, training: training(steps[2]), ..TrainControl::default() };
    let evaluate = |model: &str, teacher: &str, steps: usize, guidance: f64| {
        StageSettings::EvaluateLatentFid(EvaluateLatentFid {
            model: model.into(),
            teacher: teacher.into(),
            sampler: Sampler { steps, guidance, ..Sampler::default() },
            repeats: 2,
            samples: 2,
            components: 4,
            shards,
            ..EvaluateLatentFid::default()
        })
    };
    let latent = |model| vec![("model", model), ("latents", "latents"), ("dataset", "dataset"), ("teacher", "mld")];
    let teacher = || vec![("teacher", "mld"), ("latents", "latents"), ("text", "text")];
    vec![
        ("dataset", StageSettings::DataSynthetic(data), vec![]),
        ("text", StageSettings::TextEmbed(TextEmbed::default()), vec![("dataset", "dataset")]),
        (
            "length",
            StageSettings::TrainLength(TrainLength { training: training(steps[0]), ..TrainLength::default() }),
            vec![("dataset", "dataset"), ("text", "text")],
        ),
        ("vae", StageSettings::TrainVae(vae), vec![("dataset", "dataset")]),
        (
            "latents",
            StageSettings::EncodeLatents(EncodeLatents { crops: 3, shards, ..EncodeLatents::default() }),
            vec![("dataset", "dataset"), ("vae", "vae")],
        ),
        (
            "reconstruction",
            StageSettings::EvaluateReconstruction(EvaluateReconstruction {
                shards,
                ..EvaluateReconstruction::default()
            }),
            vec![("dataset", "dataset"), ("vae", "vae")],
        ),
        ("mld", StageSettings::TrainMld(mld), vec![("vae", "vae"), ("latents", "latents"), ("text", "text")]),
        ("lcm", StageSettings::DistillLcm(lcm), teacher()),
        ("pcm", StageSettings::DistillPcm(pcm), teacher()),
        (
            "control",
            StageSettings::TrainControl(control),
            vec![("model", "lcm"), ("dataset", "dataset"), ("latents", "latents"), ("text", "text")],
        ),
        ("eval-mld", evaluate("mld", "mld", 4, 3.0), latent("mld")),
        ("eval-lcm", evaluate("lcm", "mld", 2, 2.0), latent("lcm")),
        ("eval-pcm", evaluate("pcm", "mld", 2, 2.0), latent("pcm")),
    ]
}

/// Repeats every training of `links`, initialised with its own output, so that every tensor fits. Returns the number of
/// trainings.
#[allow(dead_code, reason = "not every test file uses it")]
pub(crate) fn begin_again(bench: &mut Bench, links: Vec<Link>, outputs: &BTreeMap<&'static str, Digest>) -> usize {
    let mut count = 0;
    for (name, mut settings, inputs) in links {
        let mut named = false;
        for reference in settings.refs().into_iter().filter(|reference| reference.field == "init") {
            name.clone_into(reference.name);
            named = true;
        }
        if !named {
            continue;
        }
        let mut inputs: Vec<(&str, Digest)> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
        inputs.push(("init", outputs[name]));
        bench.forget(name);
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        let said = ran.told.log.join("\n");
        assert!(said.contains("starts with") && !said.contains("fresh: "), "{name}: {said}");
        assert_ne!(ran.output(), outputs[name], "{name}");
        count += 1;
    }
    count
}
