//! Models that diffuse motion itself, and Free-T2M's losses, with sizes for which a step takes a few milliseconds.

use std::collections::BTreeMap;

use protocol::stage::{
    Batch, DataSynthetic, Decay, EvaluateT2m, EvaluatorNetwork, FrequencyLosses, LowFrequency, MdmNetwork,
    MovementPhase, MultiModality, Network, Optimizer, Prediction, Replicas, Sampler, Semantic, Solver,
    StableMoFusionNetwork, StageSettings, TextEmbed, TrainEvaluator, TrainMdm, TrainMld, TrainStableMoFusion, Training,
};
use protocol::{Digest, Seed, Steps};
use stage_lab::{Bench, Script};
use stages::context::Outcome;
use stages::generate::Generator;

const STEPS: u64 = 9;

fn training(steps: u64) -> Training {
    Training {
        steps: Steps(steps),
        batch: Batch { global: 6, slices: 3 },
        lr: 1e-3,
        warmup: Steps(2),
        decay: Decay::Cosine,
        optimizer: Optimizer::default(),
        max_grad_norm: 1.0,
        sync: Replicas::default(),
        stop: None,
    }
}

fn mdm() -> TrainMdm {
    TrainMdm {
        network: MdmNetwork { width: 16, layers: 2, heads: 2, feed_forward: 24, dropout: 0.1 },
        timesteps: 8,
        mask_frames: true,
        max_frames: 196,
        ema: 0.9,
        training: training(STEPS),
        ..TrainMdm::default()
    }
}

fn stablemofusion() -> TrainStableMoFusion {
    TrainStableMoFusion {
        network: StableMoFusionNetwork {
            width: 16,
            multipliers: vec![1, 2],
            time: 8,
            text: 8,
            text_layers: 1,
            text_heads: 2,
            text_feed_forward: 12,
            ..StableMoFusionNetwork::default()
        },
        max_frames: 196,
        ema: 0.5,
        ema_every: 2,
        training: training(STEPS),
        ..TrainStableMoFusion::default()
    }
}

fn losses() -> FrequencyLosses {
    FrequencyLosses {
        low_frequency: LowFrequency { weight: 1.0, from: 0.5, ..LowFrequency::default() },
        semantic: Semantic { weight: 0.5, to: 0.5, ..Semantic::default() },
    }
}

/// A stage: its name, its settings, and the stage of each of its inputs.
type Described = (&'static str, StageSettings, &'static [(&'static str, &'static str)]);

/// The stages before the models.
fn world(members: usize) -> (Bench, BTreeMap<&'static str, Digest>) {
    let mut bench = Bench::new(burn::tensor::Device::flex(), 7, members);
    let mut outputs = BTreeMap::new();
    let data = DataSynthetic { clips: 40, val: 0.1, test: 0.2, mirror: false };
    let evaluator = TrainEvaluator {
        network: EvaluatorNetwork { movement: 8, motion: 8, text: 8, embedding: 8, ..EvaluatorNetwork::default() },
        movement: MovementPhase { until: 0.5, window: 24, batch: 0, ..MovementPhase::default() },
        training: training(4),
        ..TrainEvaluator::default()
    };
    let stages: [Described; 4] = [
        ("dataset", data.into(), &[]),
        ("text", TextEmbed::default().into(), &[("dataset", "dataset")]),
        ("semantics", evaluator.clone().into(), &[("dataset", "dataset")]),
        ("evaluator", evaluator.into(), &[("dataset", "dataset")]),
    ];
    for (name, settings, inputs) in stages {
        let inputs: Vec<_> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        outputs.insert(name, ran.output());
    }
    (bench, outputs)
}

type Inputs = Vec<(&'static str, Digest)>;

fn inputs(outputs: &BTreeMap<&'static str, Digest>, losses: bool) -> Inputs {
    let mut inputs = vec![("dataset", outputs["dataset"]), ("text", outputs["text"])];
    if losses {
        inputs.push((FrequencyLosses::EVALUATOR, outputs["semantics"]));
    }
    inputs
}

/// Every kind of model here: name, settings, and true if it reads an evaluator.
fn models() -> Vec<(&'static str, StageSettings, bool)> {
    let full = StableMoFusionNetwork { full_attention: true, ..stablemofusion().network };
    let noise = protocol::stage::Diffusion { prediction: Prediction::Velocity, ..mdm().diffusion };
    vec![
        ("mdm", mdm().into(), false),
        ("free-mdm", TrainMdm { losses: losses(), ..mdm() }.into(), true),
        ("paper-mdm", TrainMdm { mask_frames: false, diffusion: noise, losses: losses(), ..mdm() }.into(), true),
        ("smf", stablemofusion().into(), false),
        ("free-smf", TrainStableMoFusion { losses: losses(), network: full, ..stablemofusion() }.into(), true),
    ]
}

fn run(bench: &mut Bench, name: &str, settings: &StageSettings, inputs: &Inputs) -> Digest {
    bench.run(name, settings, inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output()
}

/// One member, three members with a lost leader and a joiner, and a kill of all with a resume have the same result.
#[test]
fn p6_members_kills_and_resumes_change_no_byte() {
    let (mut bench, outputs) = world(1);
    bench.checkpoint.every = Steps(3);
    for (name, settings, reads) in models() {
        let inputs = inputs(&outputs, reads);
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        let expected = ran.output();
        let recorded = |key: &str| -> Vec<f64> {
            ran.told.records.iter().filter(|(_, found, _)| found == key).map(|(_, _, value)| *value).collect()
        };
        assert_eq!(recorded("loss").len(), STEPS as usize, "{name}");
        for term in ["denoising", "low_frequency", "semantic"] {
            let values = recorded(term);
            assert_eq!(values.iter().any(|value| *value > 0.0), reads, "{name}: {term} is {values:?}");
        }

        bench.forget(name);
        bench.members = 3;
        bench.script = Script { lost: vec![(0, 4)], joins: vec![(5, 2)], ..Script::default() };
        assert_eq!(run(&mut bench, name, &settings, &inputs), expected, "{name}: three members");

        bench.forget(name);
        bench.members = 2;
        bench.script = Script { lost: vec![(0, 5), (1, 5)], ..Script::default() };
        assert!(bench.run(name, &settings, &inputs).is_err(), "{name}: over before it was killed");
        bench.script = Script { drain: Some(6), ..Script::default() };
        bench.members = 1;
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(ran.outcome, Outcome::Yielded { at: 7 }, "{name}");
        bench.script = Script::default();
        assert_eq!(run(&mut bench, name, &settings, &inputs), expected, "{name}: killed at 5, yielded at 7");
    }
}

/// A trained model of motion is a model like any other: every solver samples from it at any length, and it is measured.
#[test]
fn models_of_motion_are_drawn_from_and_measured() {
    let (mut bench, outputs) = world(1);
    for (name, settings, reads) in models().into_iter().filter(|(name, ..)| *name != "free-mdm") {
        let model = run(&mut bench, name, &settings, &inputs(&outputs, reads));
        let manifest = bench.manifest(model).expect("stored");
        let generator = Generator::load(&manifest, &*bench.blobs(), &burn::tensor::Device::flex()).expect("it opens");
        let own = generator.sampler();
        let expected = if name.ends_with("mdm") { (8, Solver::Own) } else { (10, Solver::Own) };
        assert_eq!((own.steps, own.solver, own.guidance), (expected.0, expected.1, 2.5), "{name}");
        for solver in [
            Solver::Own,
            Solver::Ddpm,
            Solver::Ddim,
            Solver::DpmSolver,
            Solver::DpmSolverPp,
            Solver::SdeDpmSolverPp,
            Solver::SdeDpmSolverPp2023,
        ] {
            let sampler = Sampler { steps: 4, solver, ..own.clone() };
            let draw = |frames, seed| generator.generate("a person walks", Some(frames), Some(&sampler), Seed(seed));
            let drawn = draw(37, 3).unwrap_or_else(|e| panic!("{name}, {solver:?}: {e}"));
            assert_eq!(drawn.features.len(), 37 * 263, "{name}");
            assert_eq!(drawn.features, draw(37, 3).expect("again").features, "{name}, {solver:?}");
            assert_ne!(drawn.features, draw(37, 4).expect("again").features, "{name}, {solver:?}");
        }
        let refused = generator.generate("a person walks", Some(197), None, Seed(3)).unwrap_err().to_string();
        assert!(refused.contains("1 to 196"), "{refused}");

        let evaluate = EvaluateT2m {
            sampler: Sampler { steps: 2, guidance: 2.5, ..Sampler::default() },
            repeats: 1,
            multimodality: MultiModality { captions: 0, ..MultiModality::default() },
            all_if_small: true,
            shards: 2,
            ..EvaluateT2m::default()
        };
        let read = vec![("dataset", outputs["dataset"]), ("evaluator", outputs["evaluator"]), ("model", model)];
        let report = bench.run("t2m", &evaluate.into(), &read).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(report.metrics().contains_key("fid"), "{name}: {:?}", report.metrics());
        bench.forget("t2m");
    }
}

/// Training starts with the weights of a trained model that fit.
#[test]
fn training_goes_on_from_a_trained_model() {
    let (mut bench, outputs) = world(1);
    let mut inputs = inputs(&outputs, false);
    let host = run(&mut bench, "host", &mdm().into(), &inputs);
    inputs.push((FrequencyLosses::EVALUATOR, outputs["semantics"]));
    let tuned = TrainMdm { init: "host".into(), losses: losses(), ..mdm() };
    let scratch = run(&mut bench, "tuned", &TrainMdm { init: String::new(), ..tuned.clone() }.into(), &inputs);
    bench.forget("tuned");
    inputs.push(("init", host));
    assert_ne!(run(&mut bench, "tuned", &tuned.clone().into(), &inputs), scratch);
    bench.forget("tuned");
    let other = MdmNetwork { layers: 3, ..mdm().network };
    let ran = bench.run("tuned", &TrainMdm { network: other, ..tuned }.into(), &inputs).unwrap();
    let fresh: Vec<&String> = ran.told.log.iter().filter(|line| line.starts_with("fresh: ")).collect();
    assert!(
        !fresh.is_empty() && fresh.iter().all(|line| line.contains(".2.") && line.contains("not there")),
        "{fresh:?}"
    );
    let smf = TrainStableMoFusion { init: "host".into(), ..stablemofusion() };
    let refused = bench.run("smf", &smf.into(), &inputs).unwrap_err().to_string();
    assert!(refused.contains("`init` does not match this network"), "{refused}");
}

/// The latent host, through its decoder.
#[test]
fn p6_free_mld_changes_no_byte() {
    let (mut bench, mut outputs) = world(1);
    let network = Network { width: 16, layers: 3, heads: 2, feed_forward: 32, ..Network::default() };
    let vae = protocol::stage::TrainVae {
        latent: protocol::stage::LatentShape { tokens: 2, dim: 8 },
        network: network.clone(),
        training: training(4),
        ..protocol::stage::TrainVae::default()
    };
    let dataset = ("dataset", outputs["dataset"]);
    outputs.insert("vae", run(&mut bench, "vae", &vae.into(), &vec![dataset]));
    let encode = protocol::stage::EncodeLatents { crops: 2, shards: 2, ..Default::default() };
    outputs.insert("latents", run(&mut bench, "latents", &encode.into(), &vec![dataset, ("vae", outputs["vae"])]));
    let mld = TrainMld { network, losses: losses(), decoded: 0.7, training: training(STEPS), ..TrainMld::default() };
    let inputs = vec![
        ("vae", outputs["vae"]),
        ("latents", outputs["latents"]),
        ("text", outputs["text"]),
        (FrequencyLosses::EVALUATOR, outputs["semantics"]),
    ];
    let plain = TrainMld { losses: FrequencyLosses::default(), ..mld.clone() };
    let without = run(&mut bench, "mld", &plain.into(), &inputs[..3].to_vec());
    bench.forget("mld");
    let settings: StageSettings = mld.into();
    let ran = bench.run("mld", &settings, &inputs).unwrap_or_else(|e| panic!("mld: {e}"));
    assert_ne!(ran.output(), without, "the losses reach the denoiser");
    for term in ["denoising", "low_frequency", "semantic"] {
        assert!(ran.told.records.iter().any(|(_, key, value)| key == term && *value > 0.0), "{term}");
    }
    bench.forget("mld");
    bench.members = 3;
    bench.script = Script { lost: vec![(0, 4)], joins: vec![(5, 2)], ..Script::default() };
    assert_eq!(run(&mut bench, "mld", &settings, &inputs), ran.output(), "three members");
}
