//! Free-T2M's losses: the low-pass filter, both hosts' terms and totals, and the gradient that upstream's semantic term
//! lacks (fixtures `07_free_t2m*`).
//!
//! The hosts average terms differently. MDM's host computes one low-frequency mean over the whole batch and multiplies
//! it by each sample's stage. StableMoFusion's averages over the samples in a stage. Both transform all frames, padding
//! included.

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use models::diffusion::{Schedule, affine, unzip};
use models::flat;
use models::frequency::{Agreement, Stage, coefficients, cosines, low_frequency, low_pass, semantic};
use models::kernels::Dropout;
use models::losses::Pointwise;
use models::networks::{EvaluatorConfig, MotionEncoder, MovementEncoder};
use models::optim::global_norm;
use protocol::stage::Prediction;
use serde_json::Value;

use crate::common::{Arrays, Gates, device, error, folders, json, name, relative, shared, tracked, values};
use crate::networks::{check_gradients, count, draws, gradients, load, scalar};
use crate::raw_diffusion::{
    batch_first, check_listed, cosine, frames_first, given, lengths, linear, masked_errors, mdm, stablemofusion,
};
use crate::{FORWARD, LOSS};

/// Gate of whole gradients with respect to predictions.
const GRADIENT: f64 = 1e-4;
/// Gate of norms of gradients, relative.
const NORM: f64 = 1e-4;

#[test]
fn parity_free_t2m_terms() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["07_free_t2m"]) {
        let io = Arrays::read(&folder.join("io.safetensors"));
        if io.find("dct/x").is_none() {
            continue;
        }
        let expected = json(&folder.join("expected.json"));
        let mut gates = Gates::default();
        transform(&io, &mut gates);
        for host in ["mdm", "smf"] {
            filtered(host, &expected, &io, &mut gates);
        }
        totals(&expected, &io, &mut gates);
        gates.close(&name(&folder));
    }
}

/// The stored transform is twice the plain sum; ours is orthonormal.
fn transform(io: &Arrays, gates: &mut Gates) {
    let x = io.get("dct/x");
    let (rows, n) = (x.shape[0], x.shape[1]);
    let column = Tensor::<3>::from_data(TensorData::new(x.f32s(), [rows, n, 1]), &device());
    let lengths = vec![n; rows];
    let found: Vec<f32> = values(coefficients(column.clone(), &lengths, n))
        .iter()
        .enumerate()
        .map(|(i, c)| c * 2.0 * (n as f32 / if i % n == 0 { 1.0 } else { 2.0 }).sqrt())
        .collect();
    gates.check("transform", "dct", error(&found, &io.get("dct/dct2_unnormalised").values), FORWARD);
    let back = values(low_pass(column, &lengths, n));
    gates.check("transform", "roundtrip", error(&back, &io.get("dct/roundtrip").values), FORWARD);
}

fn filtered(host: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let device = device();
    let part = |part: &str| io.get(&format!("{host}/{part}")).tensor::<3>(&device);
    let (found, target) = (part("prediction"), part("target"));
    let [batch, frames, _] = found.dims();
    let whole = vec![frames; batch];
    let prefix = format!("{host}/lf_loss_per_sample_K");
    for k in io.names().filter_map(|n| n.strip_prefix(&prefix)) {
        let keep = k.parse().expect("a number of coefficients in the name");
        let stored = io.get(&format!("{host}/lowpass_target_first4ch_K{k}"));
        let slow = low_pass(target.clone(), &whole, keep).slice([0..batch, 0..frames, 0..stored.shape[2]]);
        gates.tensor("low pass", format!("{host} K {k}"), slow, stored, FORWARD);
        let loss = |weights: &[f32]| {
            let term = low_frequency(found.clone(), target.clone(), &whole, keep, Pointwise::L2, weights);
            scalar(&term) as f32
        };
        let one = |b: usize| (0..batch).map(|i| if i == b { 1.0 } else { 0.0 }).collect::<Vec<f32>>();
        let each: Vec<f32> = (0..batch).map(|b| loss(&one(b))).collect();
        gates.check("loss", format!("{host} K {k}"), error(&each, &io.get(&format!("{prefix}{k}")).values), LOSS);
        let mean = f64::from(loss(&vec![1.0 / batch as f32; batch]));
        let wanted = expected[format!("{host}/lf_loss_K{k}")].as_f64().expect("a loss");
        gates.check("loss", format!("{host} K {k} mean"), relative(mean, wanted), LOSS);
    }
}

/// Checks StableMoFusion's total of stored predictions and embeddings: K is 1 and the threshold 300.
fn totals(expected: &Value, io: &Arrays, gates: &mut Gates) {
    let device = device();
    let (found, target) = (io.get("smf/prediction").tensor(&device), io.get("smf/target").tensor(&device));
    let lengths = lengths(io.get("smf/mask"));
    let mse = Tensor::cat(masked_errors(&found, &target, &lengths), 0).sum() / lengths.len() as f32;
    let wanted = expected["smf/masked_mse_only"].as_f64().expect("a loss");
    gates.check("loss", "smf masked", relative(scalar(&mse), wanted), LOSS);
    let [a, b] = ["prediction", "target"].map(|part| io.get(&format!("smf/embedding_{part}")).tensor::<2>(&device));
    gates.tensor("cosine", "smf", cosines(a.clone(), b.clone()), io.get("smf/cosine"), FORWARD);
    for case in io.names().filter_map(|n| n.strip_prefix("smf/")?.strip_suffix("/t")) {
        let times = io.get(&format!("smf/{case}/t")).usizes();
        let frames = found.dims()[1];
        let total = smf_terms(&times, found.clone(), target.clone(), (a.clone(), b.clone()), frames);
        let total = scalar(&(mse.clone() + total.0 + total.1));
        let wanted = expected[format!("smf/{case}/total")].as_f64().expect("a loss");
        gates.check("loss", format!("smf {case} total"), relative(total, wanted), LOSS);
    }
}

/// StableMoFusion's two stages as released.
fn smf_stages() -> [Stage; 2] {
    [Stage::of_shares(0.0, 0.3, 1000), Stage::new(301..=999)]
}

/// Equal weights of the samples in a stage, which sum to 1.
fn shares(stage: &Stage, times: &[usize]) -> Vec<f32> {
    let mask = stage.mask(times);
    let count = mask.iter().sum::<f32>().max(1.0);
    mask.iter().map(|m| m / count).collect()
}

/// The two terms of StableMoFusion; embeddings are those of all samples.
fn smf_terms(
    times: &[usize],
    found: Tensor<3>,
    target: Tensor<3>,
    embeddings: (Tensor<2>, Tensor<2>),
    frames: usize,
) -> (Tensor<1>, Tensor<1>) {
    let [low, high] = smf_stages();
    let weights = shares(&low, times);
    // Upstream drops the batch axis of a single sample, and then nothing is filtered.
    let keep = if low.mask(times).iter().sum::<f32>() == 1.0 { frames } else { 1 };
    let slow = low_frequency(found, target, &vec![frames; times.len()], keep, Pointwise::L2, &weights);
    (slow, semantic(embeddings.0, embeddings.1, Agreement::Cosine, &shares(&high, times)))
}

/// The evaluator's networks for motions.
struct Encoder {
    movement: MovementEncoder,
    motion: MotionEncoder,
    features: usize,
}

impl Encoder {
    fn new(config: &Value, weights: &Path, device: &Device) -> Self {
        let sizes = EvaluatorConfig {
            features: count(config, "input_feats"),
            movement_hidden: count(config, "movement_hidden"),
            movement: count(config, "movement_latent"),
            motion_hidden: count(config, "motion_hidden"),
            embedding: count(config, "coemb"),
            word: 1,
            classes: 1,
            text_hidden: 1,
        };
        Self {
            movement: load(MovementEncoder::new(&sizes, &mut draws(device)), weights, "movement_encoder."),
            motion: load(MotionEncoder::new(&sizes, &mut draws(device)), weights, "motion_encoder."),
            features: sizes.features,
        }
    }

    fn embed(&self, motion_btf: Tensor<3>, frames: &[usize]) -> Tensor<2> {
        let [batch, all, _] = motion_btf.dims();
        let features = motion_btf.slice([0..batch, 0..all, 0..self.features]);
        let lengths: Vec<usize> = frames.iter().map(|frames| frames / 4).collect();
        self.motion.forward(self.movement.forward(features, &mut Dropout::off()), &lengths)
    }
}

/// The gradient of a loss with respect to `at`.
fn slope(at: &Tensor<3>, loss: Tensor<1>) -> Vec<f32> {
    values(at.grad(&loss.backward()).expect("a gradient"))
}

fn noised(schedule: &Schedule, x0: &Tensor<3>, noise: Tensor<3>, times: &[usize]) -> Tensor<3> {
    let (a, e) = unzip(times.iter().map(|t| schedule.add_noise(*t)));
    affine(x0.clone(), noise, &a, &e)
}

fn stages(case: &str, io: &Arrays, low: &Stage, high: &Stage, times: &[usize]) {
    for (stage, key) in [(low, "low_frequency_stage"), (high, "semantic_stage")] {
        let stored = io.get(&format!("{case}/{key}")).f32s();
        assert_eq!(stage.mask(times), stored, "{case}: {key}");
    }
}

#[test]
fn parity_free_t2m_in_mdm() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["07_free_t2m_mdm_total"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = folder.join("weights.safetensors");
        let device = tracked();
        let host = mdm(&config["constructor"], &weights, "mdm.", &device);
        let encoder = Encoder::new(&config["motion_encoder"], &weights, &device);
        let schedule = cosine(count(&config["diffusion"], "steps"));
        let mut gates = Gates::default();
        for case in config["cases"].as_object().expect("cases").keys() {
            let part = |part: &str| frames_first(io.get(&format!("{case}/{part}"))).tensor::<3>(&device);
            let times = io.get(&format!("{case}/t")).usizes();
            // Upstream has absolute timesteps for any number of steps.
            let (low, high) = (Stage::new(30..=usize::MAX), Stage::new(0..=20));
            stages(case, &io, &low, &high, &times);
            let lengths = lengths(io.get(&format!("{case}/mask")));
            let x0 = part("x0");
            let text = crate::common::row(io.get(&format!("{case}/text_embed")), 0).tensor(&device);
            let noisy = noised(&schedule, &x0, part("noise"), &times);
            let masked = host.1.then_some(&lengths[..]);
            // A graph supports one backward pass.
            let predict = || host.0.forward(noisy.clone(), &times, Tensor::clone(&text), masked, &mut Dropout::off());
            let predicted = predict();
            let stored = frames_first(io.get(&format!("{case}/prediction")));
            gates.tensor("output", case, predicted.clone(), &stored, FORWARD);

            let (batch, frames) = (times.len(), x0.dims()[1]);
            let mse = |p: &Tensor<3>| Tensor::cat(masked_errors(p, &x0, &lengths), 0).sum() / batch as f32;
            // One mean over the batch, multiplied by the mean of the mask.
            let slow = |p: &Tensor<3>| {
                let share = low.mask(&times).iter().sum::<f32>() / batch as f32;
                let weights = vec![share / batch as f32; batch];
                low_frequency(p.clone(), x0.clone(), &vec![frames; batch], 1, Pointwise::L2, &weights)
            };
            let frames_of = |part: &str| io.get(&format!("{case}/encoder_lengths_{part}")).usizes();
            let target = encoder.embed(x0.clone(), &frames_of("target")).detach();
            let embedded = |p: &Tensor<3>| encoder.embed(p.clone(), &frames_of("prediction"));
            let weights: Vec<f32> = high.mask(&times).iter().map(|m| m / batch as f32).collect();
            let agree = |p: &Tensor<3>| semantic(embedded(p), target.clone(), Agreement::Cosine, &weights);
            for (key, found) in [("prediction", embedded(&predicted)), ("target", target.clone())] {
                let stored = io.get(&format!("{case}/embedding_{key}"));
                gates.tensor("embedding", format!("{case} {key}"), found, stored, FORWARD);
            }

            let terms = &expected[format!("{case}/loss")]["terms"];
            for (key, found) in
                [("masked_mse", mse(&predict())), ("low_frequency", slow(&predict())), ("semantic", agree(&predict()))]
            {
                let wanted = terms[key]["mean"].as_f64().expect("a mean");
                gates.check("loss", format!("{case} {key}"), relative(scalar(&found), wanted), LOSS);
                if let Some(wanted) = terms[key]["grad_global_norm"].as_f64() {
                    let norm = global_norm(&gradients(&host.0, found));
                    gates.check("grad norm", format!("{case} {key}"), relative(norm, wanted), NORM);
                }
            }
            let ours = |p: &Tensor<3>| mse(p) + slow(p);
            let total = scalar(&ours(&predicted)) + 2.0 * scalar(&agree(&predicted));
            let wanted = expected[format!("{case}/loss")]["total"].as_f64().expect("a total");
            gates.check("loss", format!("{case} total"), relative(total, wanted), LOSS);
            let prefix = format!("{case}/grad");
            let entries = flat::layout(&host.0);
            let found = gradients(&host.0, ours(&predict()));
            check_gradients(&mut gates, &entries, &found, &expected[&prefix], &io, &prefix);

            let leaf = || predicted.clone().detach().require_grad();
            let stored = frames_first(io.get(&format!("{case}/grad_prediction")));
            let at = leaf();
            let found = slope(&at, ours(&at));
            gates.check("grad of prediction", case, error(&found, &stored.values), GRADIENT);
            if let Some(stored) = io.find(&format!("{case}/ours/grad_prediction_of_semantic")) {
                let at = leaf();
                let found = slope(&at, agree(&at));
                let what = format!("{case} semantic");
                gates.check("grad of prediction", what, error(&found, &frames_first(stored).values), GRADIENT);
            }
        }
        gates.close(&name(&folder));
    }
}

#[test]
fn parity_free_t2m_in_stablemofusion() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["07_free_t2m_smf_total"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = folder.join("weights.safetensors");
        let device = tracked();
        let host = stablemofusion(&config["constructor"], &weights, "unet_model.", &device);
        let encoder = Encoder::new(&config["motion_encoder"], &weights, &device);
        let mut gates = Gates::default();
        for case in config["cases"].as_object().expect("cases").keys() {
            let part = |part: &str| io.get(&format!("{case}/{part}"));
            let times = part("t").usizes();
            let [low, high] = smf_stages();
            stages(case, &io, &low, &high, &times);
            let lengths = part("lengths").usizes();
            let x0 = part("x0").tensor::<3>(&device);
            let noisy = noised(&linear(Prediction::Sample), &x0, part("noise").tensor(&device), &times);
            let kept: Vec<bool> = part("condition_dropped").values.iter().map(|dropped| *dropped == 0.0).collect();
            let tokens = batch_first(part("clip_states"), &device);
            // A graph supports one backward pass.
            let predict = || {
                let off = &mut Dropout::off();
                let text = host.encode_text(tokens.clone(), None, off);
                host.forward(noisy.clone(), &times, Some(&given(text, Vec::clone(&kept))), off)
            };
            let predicted = predict();
            gates.tensor("output", case, predicted.clone(), part("prediction"), FORWARD);

            let frames = x0.dims()[1];
            let frames_of: Vec<usize> = lengths.iter().map(|l| *l.min(&frames)).collect();
            let mse = |p: &Tensor<3>| Tensor::cat(masked_errors(p, &x0, &frames_of), 0).sum() / times.len() as f32;
            let target = encoder.embed(x0.clone(), &frames_of).detach();
            let embedded = |p: &Tensor<3>| encoder.embed(p.clone(), &frames_of);
            let terms = |p: &Tensor<3>| smf_terms(&times, p.clone(), x0.clone(), (embedded(p), target.clone()), frames);
            let chosen: Vec<usize> = (0..times.len()).filter(|b| high.has(times[*b])).collect();
            if let Some(stored) = io.find(&format!("{case}/encoder_lengths")) {
                assert_eq!(chosen.iter().map(|b| frames_of[*b]).collect::<Vec<_>>(), stored.usizes(), "{case}");
                for (key, found) in [("prediction", embedded(&predicted)), ("target", target.clone())] {
                    let width = found.dims()[1];
                    let all = values(found);
                    let found: Vec<f32> = chosen.iter().flat_map(|b| all[b * width..][..width].to_vec()).collect();
                    let stored = io.get(&format!("{case}/embedding_{key}"));
                    gates.check("embedding", format!("{case} {key}"), error(&found, &stored.values), FORWARD);
                }
            }

            let stored = &expected[format!("{case}/loss")];
            let (slow, agree) = terms(&predicted);
            let parts = [
                ("masked_mse", scalar(&mse(&predicted))),
                ("low_frequency", scalar(&slow)),
                ("semantic", scalar(&agree)),
                ("total", scalar(&(mse(&predicted) + slow + agree))),
            ];
            for (key, found) in parts {
                let wanted = stored[key].as_f64().expect("a loss");
                gates.check("loss", format!("{case} {key}"), relative(found, wanted), LOSS);
            }
            let prefix = format!("{case}/grad");
            let again = predict();
            let found = gradients(&host, mse(&again) + terms(&again).0);
            check_listed(&mut gates, &host, &found, &expected[&prefix], &io, &prefix);

            let leaf = || predicted.clone().detach().require_grad();
            let at = leaf();
            let found = slope(&at, mse(&at) + terms(&at).0);
            gates.check("grad of prediction", case, error(&found, &part("grad_prediction").values), GRADIENT);
            if let Some(stored) = io.find(&format!("{case}/ours/grad_prediction_of_semantic")) {
                let at = leaf();
                let all = slope(&at, terms(&at).1);
                let size = all.len() / times.len();
                let found: Vec<f32> = chosen.iter().flat_map(|b| all[b * size..][..size].to_vec()).collect();
                gates.check("grad of prediction", format!("{case} semantic"), error(&found, &stored.values), GRADIENT);
            }
        }
        gates.close(&name(&folder));
    }
}
