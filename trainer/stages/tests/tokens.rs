//! Tokenizers and token generators: end to end with tiny sizes, and with members that come, go and are killed.
#![allow(clippy::unwrap_used, reason = "a test may panic")]
#![allow(clippy::single_range_in_vec_init, reason = "one span that is kept")]

mod common;

use std::collections::BTreeMap;

use protocol::stage::{
    Batch, CheckpointPolicy, DataSynthetic, Decay, DistillDiscord, EncodeTokens, EvaluateReconstruction,
    EvaluatorNetwork, FlowNetwork, FlowPrediction, FlowProjection, FlowSolver, ModelDecoder, MovementPhase, Optimizer,
    Replicas, Resets, Sampler, StageSettings, TextEmbed, TokenGenerator, TokenNetwork, TokenizerNetwork, TrainDiscord,
    TrainEvaluator, TrainTokenizer, TrainTokens, Training,
};
use protocol::{Digest, Seed, Steps};
use stage_lab::{Bench, Script};
use stages::context::StageError;
use stages::generate::Generator;
use stages::parts::tokenizer::TrainedTokenizer;

const STEPS: u64 = 14;

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

/// Divisor of root and contact deviations of the residual tokenizer.
const BIAS: f64 = 25.0;

/// A tokenizer with codebooks of `codes` codes. A batch has 24 rows; with 40 codes they are repeated.
fn tokenizer(quantizers: usize, codes: usize, resets: Resets) -> StageSettings {
    StageSettings::from(TrainTokenizer {
        codes,
        code_dim: 4,
        quantizers,
        quantize_dropout: 0.5,
        drawn: quantizers > 1,
        resets,
        feature_bias: if quantizers > 1 { BIAS } else { 1.0 },
        network: TokenizerNetwork { width: 8, depth: 2, growth: 2, dropout: 0.1 },
        window: 16,
        training: training(STEPS),
        ..TrainTokenizer::default()
    })
}

fn generator(generator: TokenGenerator) -> StageSettings {
    StageSettings::from(TrainTokens {
        generator,
        network: TokenNetwork {
            width: 16,
            layers: if generator == TokenGenerator::Mmm { 2 } else { 1 },
            heads: 2,
            feed_forward: 32,
            dropout: 0.1,
            embedding: 8,
            word_blocks: 1,
        },
        longest: 20,
        training: training(STEPS),
        ..TrainTokens::default()
    })
}

fn discord() -> StageSettings {
    StageSettings::from(TrainDiscord {
        network: FlowNetwork { width: 8, condition: 6, ..FlowNetwork::default() },
        window: 16,
        solver_steps: 2,
        ema: 0.9,
        training: training(STEPS),
        ..TrainDiscord::default()
    })
}

/// A student of a flow decoder, which decodes a VAE's latents if `vae` names one.
fn jumps(vae: &str, solver_steps: usize) -> StageSettings {
    StageSettings::from(DistillDiscord {
        vae: vae.into(),
        window: 16,
        intervals: 4,
        solver_steps,
        training: training(STEPS),
        ..DistillDiscord::default()
    })
}

fn evaluator() -> StageSettings {
    StageSettings::from(TrainEvaluator {
        network: EvaluatorNetwork { movement: 8, motion: 8, text: 8, embedding: 8, ..EvaluatorNetwork::default() },
        movement: MovementPhase { until: 0.5, window: 24, batch: 0, ..MovementPhase::default() },
        training: training(4),
        ..TrainEvaluator::default()
    })
}

type Link = (&'static str, StageSettings, Vec<(&'static str, &'static str)>);

/// A VAE and a model of its latents, and the flow decoders that replace the VAE's own.
fn of_latents(shards: usize) -> Vec<Link> {
    let StageSettings::TrainDiscord(flow) = discord() else { unreachable!() };
    // A code of four frames is wide, and the published projection grows with its square.
    let network = FlowNetwork { projection: FlowProjection::Repeat, ..flow.network };
    let flow = TrainDiscord { vae: "vae".into(), network, ..flow };
    let measured = EvaluateReconstruction {
        decoder: "decoder".into(),
        evaluator: "evaluator".into(),
        shards,
        ..EvaluateReconstruction::default()
    };
    let vae = || vec![("dataset", "dataset"), ("vae", "vae")];
    let wanted = |(name, ..): &Link| ["vae", "latents", "mld"].contains(name);
    let mut links: Vec<Link> = common::chain(shards, [STEPS; 4]).into_iter().filter(wanted).collect();
    links.extend([
        ("latent-flow", flow.into(), vae()),
        ("latent-jump", jumps("vae", 1), [vae(), vec![("teacher", "latent-flow")]].concat()),
        ("smooth-mld", ModelDecoder::default().into(), vec![("model", "mld"), ("decoder", "latent-flow")]),
        (
            "latent-reconstruction",
            measured.into(),
            [vae(), vec![("decoder", "latent-jump"), ("evaluator", "evaluator")]].concat(),
        ),
    ]);
    links
}

/// Everything from clips to models: a plain tokenizer with an autoregressive generator and MMM's, a residual one with a
/// masked one.
fn chain(shards: usize) -> Vec<Link> {
    let encode = || StageSettings::from(EncodeTokens { padded: 40, shards, ..EncodeTokens::default() });
    let evaluate = || {
        let tokenizer = "tokenizer".into();
        StageSettings::from(EvaluateReconstruction { tokenizer, shards, ..EvaluateReconstruction::default() })
    };
    let smooth = StageSettings::from(EvaluateReconstruction {
        tokenizer: "tokenizer".into(),
        decoder: "decoder".into(),
        evaluator: "evaluator".into(),
        shards,
        ..EvaluateReconstruction::default()
    });
    let data = || vec![("dataset", "dataset")];
    let with = |tokenizer| vec![("dataset", "dataset"), ("tokenizer", tokenizer)];
    let model = |tokens, tokenizer| vec![("tokens", tokens), ("tokenizer", tokenizer), ("text", "text")];
    let clips = DataSynthetic { clips: 24, val: 0.1, test: 0.25, mirror: false };
    let mut links = vec![
        ("dataset", clips.into(), vec![]),
        ("text", TextEmbed::default().into(), data()),
        ("evaluator", evaluator(), data()),
        ("plain", tokenizer(1, 8, Resets::Remembering), data()),
        ("residual", tokenizer(3, 40, Resets::Always), data()),
        ("plain-tokens", encode(), with("plain")),
        ("residual-tokens", encode(), with("residual")),
        ("reconstruction", evaluate(), with("residual")),
        ("gpt", generator(TokenGenerator::Autoregressive), model("plain-tokens", "plain")),
        ("momask", generator(TokenGenerator::Masked), model("residual-tokens", "residual")),
        (
            "mmm",
            generator(TokenGenerator::Mmm),
            [model("plain-tokens", "plain"), vec![("dataset", "dataset")]].concat(),
        ),
        ("discord", discord(), with("residual")),
        ("smooth", ModelDecoder::default().into(), vec![("model", "momask"), ("decoder", "discord")]),
        (
            "smooth-reconstruction",
            smooth,
            [with("residual"), vec![("decoder", "discord"), ("evaluator", "evaluator")]].concat(),
        ),
        ("jumps", jumps("", 2), [with("residual"), vec![("teacher", "discord")]].concat()),
        ("quick", ModelDecoder::default().into(), vec![("model", "momask"), ("decoder", "jumps")]),
    ];
    links.extend(of_latents(shards));
    links
}

fn bench(members: usize) -> Bench {
    let mut bench = Bench::new(burn::tensor::Device::flex(), 7, members);
    bench.checkpoint = CheckpointPolicy { every: Steps(5), ..CheckpointPolicy::default() };
    bench
}

struct World {
    bench: Bench,
    outputs: BTreeMap<&'static str, Digest>,
    metrics: BTreeMap<&'static str, BTreeMap<String, f64>>,
}

impl World {
    fn inputs(&self, inputs: &[(&'static str, &'static str)]) -> Vec<(&'static str, Digest)> {
        inputs.iter().map(|(field, from)| (*field, self.outputs[from])).collect()
    }
}

fn run(members: usize, shards: usize) -> World {
    let mut world = World { bench: bench(members), outputs: BTreeMap::new(), metrics: BTreeMap::new() };
    for (name, settings, inputs) in chain(shards) {
        let inputs = world.inputs(&inputs);
        let ran = world.bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        world.metrics.insert(name, ran.metrics().clone());
        world.outputs.insert(name, ran.output());
    }
    world
}

#[test]
fn p6_tokens_and_what_draws_them_have_the_same_bytes_for_any_number_of_members_and_shards() {
    let one = run(1, 1);
    for (members, shards) in [(2, 3), (3, 2)] {
        let other = run(members, shards);
        for (name, digest) in &one.outputs {
            assert_eq!(digest, &other.outputs[name], "{name}: {members} members, {shards} shards");
        }
    }
    let used = one.metrics["residual-tokens"]["used"];
    assert!(used > 0.0 && used <= 1.0, "{used}");
    for metric in ["mpjpe_mm", "sjpe", "used", "perplexity"] {
        assert!(one.metrics["reconstruction"][metric] > 0.0, "{metric}");
    }
    // On the same tokens, and in an evaluator's space.
    let (plain, smooth) = (&one.metrics["reconstruction"], &one.metrics["smooth-reconstruction"]);
    assert!(smooth["fid"] > 0.0 && !plain.contains_key("fid"), "{smooth:?}");
    assert_eq!((plain["used"], plain["perplexity"]), (smooth["used"], smooth["perplexity"]));
    assert_ne!(plain["sjpe"], smooth["sjpe"]);
    assert!(one.metrics["latent-reconstruction"]["mu_mpjpe_mm"] > 0.0);
}

#[test]
fn models_of_tokens_draw_motions_as_all_others_do() {
    let world = run(1, 1);
    for (name, sampler) in [
        ("gpt", Sampler { steps: 1, guidance: 0.0, ..Sampler::default() }),
        ("smooth", Sampler { steps: 3, guidance: 1.0, ..Sampler::default() }),
        ("quick", Sampler { steps: 3, guidance: 1.0, ..Sampler::default() }),
        ("smooth-mld", Sampler { steps: 3, guidance: 2.0, ..Sampler::default() }),
        ("mmm", Sampler { steps: 4, guidance: 0.0, ..Sampler::default() }),
        ("momask", Sampler { steps: 4, guidance: 2.0, ..Sampler::default() }),
    ] {
        let manifest = world.bench.manifest(world.outputs[name]).unwrap();
        let model = Generator::load(&manifest, &*world.bench.blobs(), &burn::tensor::Device::flex()).unwrap();
        let draw = |seed| model.generate("a person walks", Some(50), Some(&sampler), Seed(seed)).unwrap();
        let (motion, again, other) = (draw(1), draw(1), draw(2));
        assert_eq!(motion.features, again.features, "{name}");
        assert_ne!(motion.features, other.features, "{name}");
        assert!(motion.features.iter().all(|v| v.is_finite()));
        if name == "gpt" {
            assert!(motion.frames.is_multiple_of(4) && motion.frames <= 84, "{}", motion.frames);
        } else {
            assert_eq!(motion.frames, 50, "{name}");
        }
        let wrong = Sampler { steps: 2000, ..sampler.clone() };
        assert!(model.check_sampler(&wrong).is_err(), "{name}");
    }
}

#[test]
fn a_tokenizer_sees_root_and_contacts_as_many_times_larger_as_its_bias_says() {
    let world = run(1, 1);
    let blobs = world.bench.blobs();
    let manifest = |name| world.bench.manifest(world.outputs[name]).unwrap();
    let dataset = stages::artifacts::dataset(&*blobs, &manifest("dataset")).unwrap();
    let layout = dataset.skeleton().layout();
    for (name, bias) in [("plain", 1.0), ("residual", BIAS as f32)] {
        let tokenizer = TrainedTokenizer::read(&*blobs, &manifest(name), &burn::tensor::Device::flex()).unwrap();
        let mut row: Vec<f32> = dataset.mean.iter().zip(&dataset.std).map(|(mean, std)| mean + std).collect();
        tokenizer.normalise(&mut row);
        for (i, value) in row.iter().enumerate() {
            let wanted = if i < 4 || layout.contacts.contains(&i) { bias } else { 1.0 };
            assert!((value - wanted).abs() < 1e-2 * wanted, "{name}: feature {i} is {value}, expected {wanted}");
        }
    }
}

#[test]
fn masked_generators_draw_a_part_of_a_motion_and_keep_the_tokens_of_the_rest() {
    let world = run(1, 1);
    let blobs = world.bench.blobs();
    let device = burn::tensor::Device::flex();
    let open = |name| Generator::load(&world.bench.manifest(world.outputs[name]).unwrap(), &*blobs, &device).unwrap();
    for (name, tokenizer, guidance) in [("momask", "residual", 2.0), ("mmm", "plain", 0.0)] {
        let model = open(name);
        let sampler = Sampler { steps: 4, guidance, ..Sampler::default() };
        let source = model.generate("a person walks", Some(64), Some(&sampler), Seed(1)).unwrap();
        let edit = |seed| model.edit("a jump", &source.features, &[0..41, 60..64], Some(&sampler), Seed(seed)).unwrap();
        let (edited, again, other) = (edit(3), edit(3), edit(4));
        assert_eq!(edited.kept, [0..40, 60..64], "whole tokens");
        assert_eq!((edited.motion.frames, &edited.motion.features), (64, &again.motion.features), "{name}");
        assert_ne!(edited.motion.features, other.motion.features, "{name}: another seed draws another jump");

        // Far from generated tokens, the result is the decoded kept tokens, in all layers.
        let manifest = world.bench.manifest(world.outputs[tokenizer]).unwrap();
        let tokenizer = TrainedTokenizer::read(&*blobs, &manifest, &device).unwrap();
        let mut rows = source.features.clone();
        tokenizer.normalise(&mut rows);
        let mut rows = tokenizer.decode(&tokenizer.encode(rows));
        tokenizer.denormalise(&mut rows);
        let width = rows.len() / 64;
        let differs = |t: usize| rows[t * width..(t + 1) * width] != edited.motion.features[t * width..(t + 1) * width];
        assert!(
            !(0..8).any(differs) && (40..60).any(differs),
            "{name}: {:?}",
            (0..64).map(differs).collect::<Vec<_>>()
        );

        let refused = |keep: &[std::ops::Range<usize>], motion: &[f32]| {
            model.edit("a jump", motion, keep, Some(&sampler), Seed(3)).unwrap_err().to_string()
        };
        assert!(refused(&[0..64], &source.features).contains("nothing is left to generate"));
        assert!(refused(&[1..4], &source.features).contains("nothing stays"));
        assert!(refused(&[0..4], &source.features.repeat(2)).contains("generates 1 to 80"));
    }
    let source = open("momask").generate("a person walks", Some(40), None, Seed(1)).unwrap();
    let refused = open("gpt").edit("a jump", &source.features, &[0..20], None, Seed(1)).unwrap_err().to_string();
    assert!(refused.contains("cannot regenerate part of a motion"), "{refused}");
}

/// Chains of kills with 1 to 3 members in turn, some right after a checkpoint, one before the first step. Then members
/// join, adopt the state of a peer and are lost.
#[test]
fn p5_p6_kills_joins_and_losses_change_no_byte() {
    let whole = run(1, 1);
    for (name, settings, inputs) in chain(1) {
        if !["plain", "residual", "gpt", "momask", "mmm", "discord", "jumps"].contains(&name) {
            continue;
        }
        let inputs = whole.inputs(&inputs);
        let mut bench = run_up_to(name).bench;
        for kills in [&[0_u64, 6][..], &[5, 9, 13]] {
            bench.forget(name);
            for (round, step) in kills.iter().enumerate() {
                let members = 1 + round % 3;
                bench.members = members;
                bench.script = Script { lost: (0..members).map(|m| (m, *step)).collect(), ..Script::default() };
                assert!(bench.run(name, &settings, &inputs).is_err(), "{name}: over before the kill at step {step}");
            }
            bench.script = Script::default();
            bench.members = 2;
            let output = bench.run(name, &settings, &inputs).unwrap().output();
            assert_eq!(output, whole.outputs[name], "{name} killed at {kills:?}");
        }
        bench.forget(name);
        bench.members = 1;
        bench.script = Script { joins: vec![(1, 3), (2, 3)], lost: vec![(2, 8), (0, 11)], ..Script::default() };
        let output = bench.run(name, &settings, &inputs).unwrap().output();
        assert_eq!(output, whole.outputs[name], "{name} with members that come and go");
    }
}

/// A world in which everything before stage `name` has run.
fn run_up_to(name: &str) -> World {
    let mut world = World { bench: bench(1), outputs: BTreeMap::new(), metrics: BTreeMap::new() };
    for (stage, settings, inputs) in chain(1) {
        if stage == name {
            break;
        }
        let inputs = world.inputs(&inputs);
        let output = world.bench.run(stage, &settings, &inputs).unwrap().output();
        world.outputs.insert(stage, output);
    }
    world
}

/// Over one interval the student's jump is the teacher's Euler step, for any output of its network. Over shorter ones
/// it can learn.
#[test]
fn a_student_starts_as_its_teachers_step() {
    let mut world = run_up_to("discord");
    for prediction in [FlowPrediction::Velocity, FlowPrediction::Data] {
        let StageSettings::TrainDiscord(flow) = discord() else { unreachable!() };
        let flow = TrainDiscord { solver: FlowSolver::Euler, prediction, ..flow };
        let inputs = world.inputs(&[("dataset", "dataset"), ("tokenizer", "residual")]);
        world.bench.forget("discord");
        let teacher = world.bench.run("discord", &flow.into(), &inputs).unwrap().output();
        let inputs = [&inputs[..], &[("teacher", teacher)]].concat();
        let mut losses = Vec::new();
        for intervals in [1, 4] {
            let StageSettings::DistillDiscord(settings) = jumps("", 1) else { unreachable!() };
            let training = Training { lr: 1e-9, ..settings.training };
            let settings = DistillDiscord { intervals, training, ..settings };
            world.bench.forget("jumps");
            let ran = world.bench.run("jumps", &settings.into(), &inputs).unwrap();
            losses.push(ran.metrics()["loss"]);
            assert_eq!(world.bench.manifest(ran.output()).unwrap().meta["prediction"], prediction.name());
        }
        assert!(losses[0] < 1e-6 && losses[1] > 1e-4, "{prediction:?}: {losses:?}");
    }
}

/// The weights of a network that predicts the velocity fit one that predicts the data by name and shape, but are
/// meaningless there.
#[test]
fn what_begins_with_another_prediction_is_refused() {
    let mut world = run_up_to("jumps");
    let StageSettings::TrainDiscord(flow) = discord() else { unreachable!() };
    let data = TrainDiscord { prediction: FlowPrediction::Data, init: "discord".into(), ..flow.clone() };
    let inputs = world.inputs(&[("dataset", "dataset"), ("tokenizer", "residual")]);
    let velocity = ("init", world.outputs["discord"]);
    let with = |more: &[(&'static str, Digest)]| [&inputs[..], more].concat();
    let error = world.bench.run("data", &data.clone().into(), &with(&[velocity])).unwrap_err();
    let said = "the network of `init` predicts the velocity, but this stage trains one that predicts the data";
    assert!(matches!(&error, StageError::Input(error) if error.starts_with(said)), "{error}");
    assert_eq!(world.bench.checkpoints("data"), [0_u64; 0], "it had begun");
    let output = world.bench.run("data", &data.clone().into(), &inputs).unwrap().output();
    let begun = world.bench.run("more", &data.into(), &with(&[("init", output)])).unwrap();
    assert!(begun.told.log.iter().any(|line| line.starts_with("starts with")), "{:?}", begun.told.log);
    // A student has its teacher's prediction.
    let of_data = with(&[("teacher", output), velocity]);
    let error = world.bench.run("jumps", &jumps("", 1), &of_data).unwrap_err().to_string();
    assert!(error.contains(said), "{error}");
    world.bench.run("jumps", &jumps("", 1), &with(&[("teacher", output), ("init", output)])).unwrap();
}

#[test]
fn what_does_not_fit_is_refused_with_a_reason() {
    let mut world = run_up_to("momask");
    let refused = |world: &mut World, settings: StageSettings, inputs: &[(&'static str, &'static str)]| {
        let inputs = world.inputs(inputs);
        world.bench.run("wrong", &settings, &inputs).unwrap_err().to_string()
    };
    let other = [("tokens", "plain-tokens"), ("tokenizer", "residual"), ("text", "text")];
    let error = refused(&mut world, generator(TokenGenerator::Autoregressive), &other);
    assert!(error.contains("were not encoded with"), "{error}");
    let mut other = other.to_vec();
    other.push(("dataset", "dataset"));
    let error = refused(&mut world, generator(TokenGenerator::Mmm), &other);
    assert!(error.contains("were not encoded with"), "{error}");
    let layered = [("tokens", "residual-tokens"), ("tokenizer", "residual"), ("text", "text")];
    let error = refused(&mut world, generator(TokenGenerator::Autoregressive), &layered);
    assert!(error.contains("one codebook"), "{error}");
    // A decoder of other codes, or of latents.
    let mut decoders = run(1, 1);
    for (decoder, model, words) in [
        ("discord", "gpt", "another tokenizer"),
        ("latent-flow", "gpt", "a vae instead of a tokenizer"),
        ("jumps", "mld", "a tokenizer instead of a vae"),
    ] {
        let error = refused(&mut decoders, ModelDecoder::default().into(), &[("model", model), ("decoder", decoder)]);
        assert!(error.contains(words), "{decoder} on {model}: {error}");
    }
    let taught = [("dataset", "dataset"), ("tokenizer", "residual"), ("teacher", "jumps")];
    let error = refused(&mut decoders, jumps("", 2), &taught);
    assert!(error.contains("is a student"), "{error}");
    let StageSettings::TrainTokenizer(mut settings) = tokenizer(1, 8, Resets::Always) else { unreachable!() };
    settings.window = 4_000;
    let error = refused(&mut world, settings.into(), &[("dataset", "dataset")]);
    assert!(error.contains("the longest clip"), "{error}");
}

#[test]
fn every_kind_of_tokens_begins_with_what_it_gave() {
    let mut world = run(1, 1);
    // 2 tokenizers, 3 generators, 2 flow decoders and their students, the evaluator, the VAE and the teacher of its
    // latents.
    assert_eq!(common::begin_again(&mut world.bench, chain(1), &world.outputs), 12);
}
