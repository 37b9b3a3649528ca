//! Controlled motion: training, sampling and measuring, with sizes for which a step takes a few milliseconds.

use std::collections::BTreeMap;

use burn::tensor::Device;
use checkpoint::model::{self, Model};
use motion::Skeleton;
use protocol::artifact::Role;
use protocol::stage::{
    Batch, ControlDistance, ControlFeedback, ControlHints, ControlLoss, ControlMean, ControlSetting, DataFormat,
    DataSynthetic, Decay, DistillLcm, DistillPcm, Distillation, DrawMotions, EncodeLatents, EvaluateControl,
    EvaluatorNetwork, LatentShape, MovementPhase, Network, Optimizer, Replicas, Sampler, StageSettings, TextEmbed,
    TrainControl, TrainEvaluator, TrainMld, TrainVae, Training,
};
use protocol::{Digest, Manifest, Seed, Steps};
use stage_lab::{Bench, Script};
use stages::artifacts;
use stages::context::Outcome;
use stages::generate::Generator;
use stages::parts::control::ControlOptions;
use stages::parts::hint::{Hint, metres};

const STEPS: u64 = 9;

/// A stage: its name, its settings, and the stage of each of its inputs.
type Described<'a> = (&'a str, StageSettings, &'a [(&'a str, &'a str)]);

fn training(steps: u64) -> Training {
    Training {
        steps: Steps(steps),
        batch: Batch { global: 6, slices: 3 },
        lr: 1e-3,
        warmup: Steps(0),
        decay: Decay::Constant,
        optimizer: Optimizer::default(),
        max_grad_norm: 1.0,
        sync: Replicas::default(),
        stop: None,
    }
}

fn network() -> Network {
    Network { width: 16, layers: 3, heads: 2, feed_forward: 32, dropout: 0.1, ..Network::default() }
}

/// The stages before control, on latents of this shape: 1x16 is v1, which has no projections.
fn world(latent: LatentShape) -> (Bench, BTreeMap<&'static str, Digest>) {
    let mut bench = Bench::new(Device::flex(), 7, 1);
    let distillation = || Distillation {
        training: training(3),
        guidance_dim: 16,
        guidance: (0.5, 5.0),
        ..DistillLcm::default().distillation
    };
    let evaluator = TrainEvaluator {
        network: EvaluatorNetwork { movement: 8, motion: 8, text: 8, embedding: 8, ..EvaluatorNetwork::default() },
        movement: MovementPhase { until: 0.5, window: 24, batch: 0, ..MovementPhase::default() },
        training: training(4),
        ..TrainEvaluator::default()
    };
    let teacher: &[(&str, &str)] = &[("teacher", "mld"), ("latents", "latents"), ("text", "text")];
    let pcm = DistillPcm { phases: 2, distillation: distillation(), ..DistillPcm::default() };
    let stages: [Described<'_>; 8] = [
        ("dataset", DataSynthetic { clips: 40, val: 0.1, test: 0.2, mirror: false }.into(), &[]),
        ("text", TextEmbed::default().into(), &[("dataset", "dataset")]),
        ("evaluator", evaluator.into(), &[("dataset", "dataset")]),
        (
            "vae",
            TrainVae { latent, network: network(), training: training(6), ..TrainVae::default() }.into(),
            &[("dataset", "dataset")],
        ),
        (
            "latents",
            EncodeLatents { crops: 2, shards: 2, ..EncodeLatents::default() }.into(),
            &[("dataset", "dataset"), ("vae", "vae")],
        ),
        (
            "mld",
            TrainMld { network: network(), training: training(4), ..TrainMld::default() }.into(),
            &[("vae", "vae"), ("latents", "latents"), ("text", "text")],
        ),
        ("lcm", DistillLcm { distillation: distillation() }.into(), teacher),
        ("pcm", pcm.into(), teacher),
    ];
    let mut outputs = BTreeMap::new();
    for (name, settings, inputs) in stages {
        let inputs: Vec<_> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        outputs.insert(name, ran.output());
    }
    (bench, outputs)
}

fn v2() -> LatentShape {
    LatentShape { tokens: 2, dim: 8 }
}

type Inputs = Vec<(&'static str, Digest)>;

fn inputs(outputs: &BTreeMap<&'static str, Digest>, base: &str) -> Inputs {
    let common = ["dataset", "latents", "text"].map(|name| (name, outputs[name]));
    [("model", outputs[base])].into_iter().chain(common).collect()
}

fn temporal() -> TrainControl {
    TrainControl { network: network(), embedding: 12, training: training(STEPS), ..TrainControl::default() }
}

fn spatial() -> TrainControl {
    let joints = vec!["pelvis".into(), "left_wrist".into()];
    TrainControl {
        hints: ControlHints { setting: ControlSetting::Spatial, joints, density: (0.0, 100.0) },
        loss: ControlLoss {
            distance: ControlDistance::SmoothL1,
            mean: ControlMean::Coordinate,
            metres: true,
            ..ControlLoss::default()
        },
        trajectory_lr: 5e-4,
        ..temporal()
    }
}

fn run(bench: &mut Bench, name: &str, settings: &StageSettings, inputs: &Inputs) -> Digest {
    bench.run(name, settings, inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output()
}

/// One member, three members with a lost leader and a joiner, and a kill of all with a resume have the same result, for
/// a teacher and both students.
#[test]
fn p6_members_kills_and_resumes_change_no_byte() {
    let (mut bench, outputs) = world(v2());
    bench.checkpoint.every = Steps(3);
    let latent_only = ControlLoss { tokens: 0.5, control: 0.0, ..ControlLoss::default() };
    let rounds = |rounds| ControlFeedback { rounds, ..ControlFeedback::default() };
    let on_mld = TrainControl { feedback: rounds(2), ..spatial() };
    let on_pcm = TrainControl { feedback: rounds(1), loss: latent_only, ..temporal() };
    let cases: [(&str, &str, TrainControl, &[&str]); 3] = [
        ("on-lcm", "lcm", temporal(), &["latent", "control"]),
        ("on-mld", "mld", on_mld, &["latent", "control", "feedback_latent", "feedback_control"]),
        ("on-pcm", "pcm", on_pcm, &["latent", "tokens", "feedback_latent"]),
    ];
    for (name, base, settings, terms) in cases {
        let (settings, inputs) = (StageSettings::from(settings), inputs(&outputs, base));
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        let expected = ran.output();
        for term in ["latent", "tokens", "control", "feedback_latent", "feedback_control"] {
            let values: Vec<f64> =
                ran.told.records.iter().filter(|(_, key, _)| key == term).map(|(_, _, value)| *value).collect();
            let there = terms.contains(&term);
            let positive = values.iter().filter(|value| **value > 0.0).count();
            let steps = if there { STEPS as usize } else { 0 };
            assert_eq!(positive, steps, "{name}: {term} is {values:?}");
        }
        // All parts of the base are unchanged.
        let read = |digest| Model::read(&bench.manifest(digest).unwrap()).unwrap().parts;
        let (mut with, without) = (read(expected), read(outputs[base]));
        assert!(with.remove(&Role::CONTROL).is_some());
        assert_eq!(with, without, "{name}");

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

/// Targets for a wave of the pelvis and one wrist in some frames.
fn hint(frames: usize) -> Hint {
    let mut hint = Hint::none(frames, 22);
    for t in (0..frames).step_by(7) {
        let at = t as f32 / frames as f32;
        hint.tell(t, 0, [at.sin(), 0.9, at]);
        hint.tell(t, 20, [0.3, 1.2 + 0.2 * at.cos(), at]);
    }
    hint
}

fn generator(bench: &Bench, manifest: &Manifest) -> Generator {
    Generator::load(manifest, &*bench.blobs(), &Device::flex()).expect("it opens")
}

/// Training lowers the distance from targets, and a model follows its targets; with scale 0 its motion is that of the
/// base.
#[test]
fn a_control_part_learns_and_is_heeded() {
    for (latent, base) in [(v2(), "lcm"), (LatentShape { tokens: 1, dim: 16 }, "pcm")] {
        let (mut bench, outputs) = world(latent);
        let steps = 160;
        let settings = TrainControl {
            network: Network { dropout: 0.0, ..network() },
            training: Training { lr: 5e-3, ..training(steps) },
            hints: ControlHints { density: (100.0, 100.0), ..ControlHints::default() },
            loss: ControlLoss { latent: 0.0, ..ControlLoss::default() },
            ..temporal()
        };
        let ran = bench.run("control", &settings.into(), &inputs(&outputs, base)).expect("it trains");
        let values: Vec<f64> =
            ran.told.records.iter().filter(|(_, key, _)| key == "control").map(|(_, _, value)| *value).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let (first, last) = (mean(&values[..20]), mean(&values[values.len() - 20..]));
        eprintln!("{base}: the motion term went from {first:.3} to {last:.3}");
        assert!(last < 0.9 * first, "{base}: {first} to {last}");

        let manifest = bench.manifest(ran.output()).expect("stored");
        let controlled = generator(&bench, &manifest);
        let free = generator(&bench, &bench.manifest(outputs[base]).expect("stored"));
        let sampler = Sampler { steps: if base == "pcm" { 2 } else { 1 }, guidance: 2.0, ..Sampler::default() };
        let draw = |scale| {
            let told = (&hint(60), ControlOptions { scale, ..ControlOptions::default() });
            controlled.generate_controlled("a person walks", Some(&sampler), Seed(3), told).expect("a motion").features
        };
        let without = free.generate("a person walks", Some(60), Some(&sampler), Seed(3)).expect("a motion").features;
        assert_eq!(controlled.generate("a person walks", Some(60), Some(&sampler), Seed(3)).unwrap().features, without);
        let silent: f32 = draw(0.0).iter().zip(&without).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(silent < 1e-5, "{base}: scale 0 moves a feature by {silent}");
        assert_ne!(draw(1.0), without);
        assert_eq!(draw(1.0), draw(1.0));
        // Without targets footing changes the root's path and nothing else.
        let feet = Sampler { footing: true, ..sampler.clone() };
        let held = free.generate("a person walks", Some(60), Some(&feet), Seed(3)).expect("a motion").features;
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let layout = skeleton.layout();
        for (t, (was, is)) in without.chunks(skeleton.features).zip(held.chunks(skeleton.features)).enumerate() {
            let pose = layout.root_height.start..layout.velocities.start;
            assert_eq!((was[0], &was[pose.clone()]), (is[0], &is[pose]), "{base}: frame {t}");
            assert_eq!(
                was[layout.root_velocity.clone()] != is[layout.root_velocity.clone()],
                t < 59,
                "{base}: frame {t}"
            );
        }
        let told = (&hint(60), ControlOptions::default());
        let told = controlled.generate_controlled("a person walks", Some(&feet), Seed(3), told).expect("a motion");
        assert_eq!(told.features, draw(1.0), "{base}: it goes where it is told");
        let errors = hint(60).errors(&metres(&draw(1.0), skeleton), 0.5).expect("something is told");
        assert!(errors.average.is_finite());
        let refined = |steps| {
            let told = (&hint(60), ControlOptions { refine: steps, ..ControlOptions::default() });
            let motion = controlled.generate_controlled("a person walks", Some(&sampler), Seed(3), told);
            hint(60)
                .errors(&metres(&motion.expect("a motion").features, skeleton), 0.5)
                .expect("something is told")
                .average
        };
        let (few, many) = (refined(5), refined(100));
        eprintln!("{base}: {:.3} m off as drawn, {few:.3} and {many:.3} m refined", errors.average);
        // The decoder of so small a VAE can correct little.
        assert!(few < errors.average && many < 0.9 * errors.average, "{base}: {} to {few} to {many}", errors.average);
        assert_eq!(refined(5), few);
        // A motion of one frame has no movement.
        let told = (&hint(1), ControlOptions { refine: 2, ..ControlOptions::default() });
        let one = controlled.generate_controlled("a person walks", Some(&sampler), Seed(3), told).expect("a motion");
        assert_eq!(one.frames, 1);

        let told = (&hint(60), ControlOptions::default());
        let refused =
            free.generate_controlled("a person walks", Some(&sampler), Seed(3), told).unwrap_err().to_string();
        assert!(refused.contains("no control part"), "{refused}");

        // `draw.motions` follows a path, and ends with it.
        let path = vec![[0.0, 0.0, 0.9, 0.0], [2.95, 0.0, 0.9, 2.0]];
        let drawing = DrawMotions { path, steps: sampler.steps, guidance: 2.0, ..DrawMotions::default() };
        let drawn = bench.run("drawn", &drawing.clone().into(), &[("model", ran.output())]).expect("the stage runs");
        let drawn = bench.manifest(drawn.output()).expect("stored");
        let motions = artifacts::file(&*bench.blobs(), &drawn, "motions.json").expect("motions");
        let motions: serde_json::Value = serde_json::from_slice(&motions).expect("JSON");
        let motion = &motions["motions"][0];
        assert_eq!(
            (&motion["frames"], motion["waypoints"].as_array().map(Vec::len)),
            (&60.into(), Some(2)),
            "{motion}"
        );
        let short = DrawMotions { seconds: 2.0, ..drawing.clone() };
        let refused = bench.run("drawn", &short.into(), &[("model", ran.output())]).expect_err("too short").to_string();
        assert!(refused.contains("`path`: it takes 3.00 s; expected at most 2.00"), "{refused}");
        let refused = bench.run("drawn", &drawing.into(), &[("model", outputs[base])]).expect_err("free").to_string();
        assert!(refused.contains("`path`: the model has no control part"), "{refused}");
    }
}

/// Rounds of feedback reduce the distance from targets, each motion by itself. Without them the result is that of a
/// part without the network.
#[test]
fn feedback_corrects_what_was_drawn() {
    let (mut bench, outputs) = world(v2());
    let settings = |rounds| TrainControl {
        network: Network { dropout: 0.0, ..network() },
        training: Training { lr: 5e-3, ..training(160) },
        hints: ControlHints { density: (100.0, 100.0), ..ControlHints::default() },
        loss: ControlLoss { latent: 0.0, ..ControlLoss::default() },
        feedback: ControlFeedback { rounds, lr: 1e-2 },
        ..temporal()
    };
    let plain = run(&mut bench, "control", &settings(0).into(), &inputs(&outputs, "lcm"));
    bench.forget("control");
    let ran = bench.run("control", &settings(2).into(), &inputs(&outputs, "lcm")).expect("it trains");
    let last = |term: &str| {
        let values = ran.told.records.iter().filter(|(_, key, _)| key == term).map(|(_, _, value)| *value);
        values.skip(140).sum::<f64>() / 20.0
    };
    let (drawn, corrected) = (last("control"), last("feedback_control"));
    eprintln!("the motion term is {drawn:.3} as drawn, {corrected:.3} after feedback");
    assert!(corrected < 0.95 * drawn, "{drawn} to {corrected}");

    let [plain, corrects] =
        [plain, ran.output()].map(|digest| generator(&bench, &bench.manifest(digest).expect("stored")));
    let sampler = Sampler { steps: 1, guidance: 2.0, ..Sampler::default() };
    let draw = |of: &Generator, hint: &Hint, seed: u64, options: ControlOptions| {
        of.generate_controlled("a person walks", Some(&sampler), Seed(seed), (hint, options))
            .expect("a motion")
            .features
    };
    let rounds = |feedback| ControlOptions { feedback, ..ControlOptions::default() };
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    // Targets from another motion of the same model, in all frames, as in training.
    let other = metres(&draw(&plain, &Hint::none(60, skeleton.joints), 100, ControlOptions::default()), skeleton);
    let told = Hint::of(&other, skeleton.joints, &[0, 10, 11, 15, 20, 21], &(0..60).collect::<Vec<_>>());
    let off = |hint: &Hint, seed: u64, options: ControlOptions| {
        distance(hint, &metres(&draw(&corrects, hint, seed, options), skeleton))
    };

    let same = |a: Vec<f32>, b: Vec<f32>, why: &str| assert!(a == b, "{why}");
    let of = |generator, options| draw(generator, &told, 3, options);
    same(of(&corrects, rounds(Some(0))), of(&plain, rounds(None)), "the other two networks learn alike");
    same(of(&plain, rounds(Some(3))), of(&plain, rounds(None)), "no network, no rounds");
    same(of(&corrects, rounds(Some(2))), of(&corrects, rounds(None)), "as many as in training");
    let silent = ControlOptions { scale: 0.0, ..ControlOptions::default() };
    same(of(&corrects, silent), of(&plain, silent), "at scale 0 nothing is changed");

    let mean = |count: usize| (0..8).map(|seed| off(&told, seed, rounds(Some(count)))).sum::<f64>() / 8.0;
    let (none, two) = (mean(0), mean(2));
    eprintln!("{none:.3} m off without feedback, {two:.3} m after two rounds");
    assert!(two < none, "{none} m to {two} m");

    // A round that increases the distance is ignored: more rounds come as near as fewer. It also holds for another
    // path, and when each change is many times larger than in training.
    for (hint, scale) in [(&told, 1.0), (&hint(60), 1.0), (&hint(60), 30.0)] {
        for seed in 0..4 {
            let off = [0, 1, 2, 4].map(|rounds| {
                off(hint, seed, ControlOptions { scale, feedback: Some(rounds), ..ControlOptions::default() })
            });
            eprintln!("at scale {scale} {off:.3?} m off after none, one, two and four rounds");
            assert!(off.windows(2).all(|pair| pair[1] <= pair[0] + 1e-6), "scale {scale}: {off:?}");
        }
    }
}

/// Root mean square distance of a motion `[frames, joints, 3]` from its targets, metres.
fn distance(hint: &Hint, motion: &[f32]) -> f64 {
    let square = |(t, j, position): (usize, usize, [f32; 3])| -> f64 {
        let at = 3 * (t * hint.joints() + j);
        position.iter().zip(&motion[at..]).map(|(told, found)| f64::from(told - found).powi(2)).sum()
    };
    (hint.iter().map(square).sum::<f64>() / hint.told() as f64).sqrt()
}

/// A report has the same bytes for any number of shards, and has values with the part and without.
#[test]
fn control_is_measured_by_case() {
    let (mut bench, outputs) = world(v2());
    let model = run(&mut bench, "control", &spatial().into(), &inputs(&outputs, "lcm"));
    let evaluate = |shards| EvaluateControl {
        setting: ControlSetting::Spatial,
        joints: vec!["pelvis".into(), "six".into()],
        percent: vec![25.0],
        frames: vec![2],
        refine: 2,
        sampler: Sampler { steps: 1, guidance: 2.0, ..Sampler::default() },
        repeats: 2,
        all_if_small: true,
        shards,
        ..EvaluateControl::default()
    };
    let read = vec![("dataset", outputs["dataset"]), ("evaluator", outputs["evaluator"]), ("model", model)];
    let two = bench.run("report", &evaluate(2).into(), &read).unwrap_or_else(|e| panic!("{e}"));
    let metrics = two.metrics();
    for name in ["average_error", "location_error", "trajectory_error", "fid", "r_precision_top3", "skating_ratio"] {
        let mean = metrics[name];
        let cases = ["pelvis/25pct", "pelvis/2frames", "six/25pct", "six/2frames"];
        let of_cases = cases.iter().map(|case| metrics[&format!("{name}/{case}")]).sum::<f64>() / 4.0;
        assert!((mean - of_cases).abs() < 1e-9, "{name}: {mean} and {of_cases}");
        assert!(metrics.contains_key(&format!("uncontrolled_{name}")), "{name}");
        assert!(metrics.contains_key(&format!("{name}.lower")), "{name}");
    }
    assert!(metrics["average_error"] > 0.0 && metrics["uncontrolled_average_error"] > 0.0);
    assert!((0.0..=1.0).contains(&metrics["location_error/six/2frames"]));
    let three = bench.run("report", &evaluate(3).into(), &read).expect("it runs");
    assert_eq!(three.metrics(), metrics, "3 shards");

    let without = vec![("dataset", outputs["dataset"]), ("evaluator", outputs["evaluator"]), ("model", outputs["lcm"])];
    let refused = bench.run("report", &evaluate(2).into(), &without).unwrap_err().to_string();
    assert!(refused.contains("no control part"), "{refused}");
}

/// A part for one denoiser is refused with another, and a model is not controlled twice.
#[test]
fn what_does_not_fit_is_refused() {
    let (mut bench, outputs) = world(v2());
    let model = run(&mut bench, "control", &temporal().into(), &inputs(&outputs, "lcm"));
    let parts = Model::read(&bench.manifest(model).unwrap()).unwrap().parts;
    let control = bench.manifest(parts[&Role::CONTROL]).expect("a part is stored by itself");
    let other = bench.manifest(outputs["pcm"]).unwrap();
    let refused = model::extend(&other, None, &BTreeMap::from([(Role::CONTROL, control)])).unwrap_err().to_string();
    assert!(refused.contains("`control` was trained with the `denoiser`"), "{refused}");

    let mut twice = inputs(&outputs, "lcm");
    twice[0].1 = model;
    let refused = bench.run("twice", &temporal().into(), &twice).unwrap_err().to_string();
    assert!(refused.contains("already has a control part"), "{refused}");

    let foot = TrainControl {
        hints: ControlHints { joints: vec!["right_midfoot".into()], ..ControlHints::default() },
        ..temporal()
    };
    let refused = bench.run("kit", &foot.into(), &inputs(&outputs, "lcm")).unwrap_err().to_string();
    assert!(refused.contains("has no joint `right_midfoot`") && refused.contains("left_wrist"), "{refused}");
}
