//! The whole chain in memory, small: its value must not hang on who computed what.

use std::collections::BTreeMap;

use protocol::Digest;
use protocol::Steps;
use protocol::stage::{
    Batch, DataSynthetic, Decay, DistillLcm, DistillPcm, Distillation, EncodeLatents, EvaluateLatentFid,
    EvaluateReconstruction, LatentShape, Network, Optimizer, Sampler, Shape, StageSettings, TextEmbed, TrainMld,
    TrainVae, Training,
};
use stages::context::Outcome;
use stages::testing::{Bench, Script};

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
type Link = (&'static str, StageSettings, Vec<(&'static str, &'static str)>);

/// The stages in order.
fn chain(shards: usize) -> Vec<Link> {
    let data = DataSynthetic { clips: 24, val: 0.1, test: 0.25, mirror: false };
    let vae = TrainVae {
        latent: LatentShape { tokens: 2, dim: 8 },
        network: network(),
        training: training(8),
        ..TrainVae::default()
    };
    let mld = TrainMld { network: network(), ema: 0.9, training: training(10), ..TrainMld::default() };
    let lcm = DistillLcm { distillation: distillation(6) };
    let pcm = DistillPcm { phases: 2, distillation: distillation(6), ..DistillPcm::default() };
    let evaluate = |model: &str, teacher: &str, steps: usize, guidance: f64| {
        StageSettings::EvaluateLatentFid(EvaluateLatentFid {
            model: model.into(),
            teacher: teacher.into(),
            sampler: Sampler { steps, guidance, timesteps: vec![] },
            repeats: 2,
            samples: 2,
            components: 4,
            shards,
            ..EvaluateLatentFid::default()
        })
    };
    let latent = |model| vec![("model", model), ("latents", "latents"), ("text", "text"), ("teacher", "mld")];
    let teacher = || vec![("teacher", "mld"), ("latents", "latents"), ("text", "text")];
    vec![
        ("dataset", StageSettings::DataSynthetic(data), vec![]),
        ("text", StageSettings::TextEmbed(TextEmbed::default()), vec![("dataset", "dataset")]),
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
        ("eval-mld", evaluate("mld", "mld", 4, 3.0), latent("mld")),
        ("eval-lcm", evaluate("lcm", "mld", 2, 2.0), latent("lcm")),
        ("eval-pcm", evaluate("pcm", "mld", 2, 2.0), latent("pcm")),
    ]
}

/// The digest of every stage's output, and the metrics of the evaluations.
fn run(bench: &mut Bench, shards: usize) -> BTreeMap<&'static str, Digest> {
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain(shards) {
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        eprintln!("{name}: {} {:?}", ran.output(), ran.metrics());
        outputs.insert(name, ran.output());
    }
    outputs
}

fn bench(members: usize) -> Bench {
    Bench::new(burn::tensor::Device::flex(), 7, members)
}

#[test]
fn every_digest_is_the_same_with_any_number_of_members_and_shards() {
    let alone = run(&mut bench(1), 1);
    let pair = run(&mut bench(2), 3);
    assert_eq!(alone, pair, "1 member and 1 shard against 2 and 3");
    let mut three = bench(3);
    // One is lost in each training stage, the leader, and another joins.
    three.script = Script { lost: vec![(0, 3)], joins: vec![(5, 1)], wind_down: None };
    assert_eq!(alone, run(&mut three, 4), "1 member against 3 of which the leader is lost and a fourth joins");
}

#[test]
fn a_stage_that_yields_and_goes_on_gives_the_same_bytes() {
    let chain = chain(2);
    let mut whole = bench(2);
    let mut cut = bench(2);
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain {
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let expected = whole.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output();
        if settings.shape() == Shape::Gang {
            cut.script = Script { wind_down: Some(3), ..Script::default() };
            let ran = cut.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(ran.outcome, Outcome::Yielded { at: 4 }, "{name}");
            assert_eq!(cut.checkpoints(name), [4], "{name}");
            cut.script = Script::default();
            cut.members = 3;
        }
        let ran = cut.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(ran.output(), expected, "{name}: 4 steps by two, the rest by three");
        cut.members = 2;
        outputs.insert(name, expected);
    }
}

/// What a sweep rests on: a trial that is trained in rungs is bit for bit the stage that is trained in one go.
#[test]
fn a_stage_that_is_trained_in_rungs_gives_the_same_bytes() {
    let mut bench = bench(1);
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain(2) {
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let expected = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output();
        outputs.insert(name, expected);
        if settings.shape() != Shape::Gang {
            continue;
        }
        bench.take_checkpoint(name);
        let mut state = None;
        for (stop, members) in [(Some(2), 2), (Some(5), 1), (None, 3)] {
            let mut rung = settings.clone();
            rung.training_mut().expect("a gang trains").stop = stop.map(Steps);
            let inputs: Vec<_> = inputs.iter().copied().chain(state.map(|state| ("state", state))).collect();
            bench.members = members;
            let ran = bench.run(name, &rung, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
            let (step, left) = bench.take_checkpoint(name).expect("a rung leaves its state");
            match stop {
                Some(stop) => {
                    assert_eq!(step, stop, "{name}");
                    assert_ne!(ran.output(), expected, "{name}: what was trained for {stop} steps is something else");
                }
                None => assert_eq!(ran.output(), expected, "{name}"),
            }
            state = Some(left);
        }
        bench.members = 1;
    }
}
