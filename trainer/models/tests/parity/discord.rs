//! The vector fields of DisCoRD: projections, times, velocities, losses with gradients, steps in a row and whole
//! trajectories (fixtures `06_discord_*`).

use burn::tensor::{Device, Tensor, TensorData};
use models::flat::{self, Entry};
use models::flow::{Solver, between, follow};
use models::kernels::Dropout;
use models::losses::FrameWeights;
use models::networks::{DitConfig, FlowDit, FlowUnet, Projection, TimeFeatures, UnetConfig, falling};
use models::optim::{AdamW, clip_factor, ema, global_norm};
use models::quantizer::look_up;
use serde_json::Value;

use crate::common::{Arrays, Gates, device, error, folders, json, name, relative, row, shared, tracked};
use crate::gpt::without;
use crate::networks::{check_gradients, gradients, scalar, split};
use crate::tokenizer::{draws, filled, ids, number, size};
use crate::{FORWARD, LOSS};

/// Gate of whole trajectories, and of averages after steps.
const TRAJECTORY: f64 = 1e-5;
/// Gate of the norm of a parameter's change in one update.
const CHANGE: f64 = 1e-3;
/// Names in the published state that are no parameters here.
const NOT_OURS: [&str; 4] = ["quantizer.", "num_batches_tracked", "post_norm", "postional_encoding"];

fn unet_config(constructor: &Value) -> UnetConfig {
    let flag = |key: &str| constructor[key].as_bool().unwrap_or(false);
    let or = |key: &str, other: usize| constructor[key].as_u64().map_or(other, |v| v as usize);
    let frequencies = or("learned_sinusoidal_dim", 16);
    UnetConfig {
        features: size(constructor, "channels"),
        width: size(constructor, "dim"),
        multiples: serde_json::from_value(constructor["dim_mults"].clone()).expect("widths"),
        token_dim: size(constructor, "c_in_dim"),
        condition_dim: size(constructor, "c_proj_dim"),
        blocks: or("resnet_per_block", 1),
        projection: match constructor["up_conv_c"].as_str() {
            Some("Repeat_and_stack_and_linear") => Projection::Stack,
            Some("Repeat_and_linear" | "Nearest_and_linear") => Projection::Repeat,
            Some("Transposed") => Projection::Transposed,
            Some("Upsample") => Projection::Upsample,
            other => panic!("projection {other:?} does not exist here"),
        },
        attention: flag("use_attention").then(|| (or("attn_heads", 4), or("attn_dim_head", 32))),
        time: match (flag("random_fourier_features"), flag("learned_sinusoidal_cond")) {
            (true, _) => TimeFeatures::Random(frequencies),
            (false, true) => TimeFeatures::Learned(frequencies),
            (false, false) => TimeFeatures::Sinusoid,
        },
        theta: constructor["sinusoidal_pos_emb_theta"].as_f64().unwrap_or(10_000.0),
        learned_variance: flag("learned_variance"),
    }
}

/// The trained parameters, without statistics of batch norms.
fn trained<'a>(entries: &'a [Entry], values: &'a [f32]) -> (Vec<Entry>, Vec<f32>) {
    let kept = split(entries, values).filter(|(entry, _)| !entry.name.contains("running_"));
    let (entries, values): (Vec<Entry>, Vec<Vec<f32>>) = kept.map(|(e, v)| (e.clone(), v.to_vec())).unzip();
    (entries, values.concat())
}

#[test]
fn parity_discord_unet() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["06_discord_unet", "06_discord_train"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let sizes = unet_config(&config["constructor"]);
        let load = |device: &Device| filled(FlowUnet::new(&sizes, &mut draws(device)), &weights, "", &NOT_OURS);
        let (plain, mut gates) = (load(&device()), Gates::default());
        let books: Vec<Vec<f32>> = (0..)
            .map_while(|q| weights.find(&format!("quantizer.layers.{q}.codebook")))
            .map(crate::common::Array::f32s)
            .collect();
        for case in io.cases() {
            if io.find(&format!("{case}/v")).is_some() {
                forward(&plain, &case, &io, &mut gates);
            } else if case == "sample" || case == "decode_ids" {
                trajectories(&plain, &case, &books, &io, &mut gates);
            } else if case.starts_with("loss") || case == "full_motion" {
                loss(&load(&tracked()), &case, &expected, &io, &mut gates);
            }
        }
        if config["steps"].is_u64() {
            steps(load(&tracked()), &config, &expected, &io, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

fn forward(network: &FlowUnet, case: &str, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let tokens = stored("c").tensor::<3>(&device());
    let times = stored("t").f32s();
    gates.tensor("condition", case, network.condition(tokens.clone()), stored("condition_projected"), FORWARD);
    gates.tensor("time", case, network.time(&times, &device()), stored("time_embedding"), FORWARD);
    let found = network.forward(stored("x_t").tensor(&device()), &times, tokens, &mut Dropout::off());
    gates.tensor("velocity", case, found, stored("v"), FORWARD);
}

/// Samples all trajectories of a fixture, from tokens or from their ids.
fn trajectories(network: &FlowUnet, case: &str, books: &[Vec<f32>], io: &Arrays, gates: &mut Gates) {
    let find = |part: &str| io.find(&format!("{case}/{part}"));
    let noise = find("noise").expect("noise").tensor::<3>(&device());
    let batch = noise.dims()[0];
    let tokens = match find("ids") {
        None => find("c").expect("tokens").tensor::<3>(&device()),
        Some(stored) => {
            let layers = stored.shape[2];
            let width = find("z").or(find("c")).expect("tokens").shape[2];
            let rows = look_up(&ids(stored), layers, books, width);
            let tokens = Tensor::<3>::from_data(TensorData::new(rows, [batch, stored.shape[1], width]), &device());
            let wanted = find("z").or(find("c")).expect("tokens");
            gates.tensor("tokens", case, tokens.clone(), wanted, FORWARD);
            tokens
        }
    };
    let run = |solver: Solver, intervals: usize| {
        let mut seen = Vec::new();
        let velocity = |x: Tensor<3>, t: f32| network.forward(x, &vec![t; batch], tokens.clone(), &mut Dropout::off());
        let end = follow(solver, intervals, noise.clone(), velocity, |x| seen.push(x.clone()));
        (end, seen)
    };
    for (part, solver, intervals) in [
        ("official_midpoint_steps16", Solver::Midpoint, 15),
        ("motion", Solver::Midpoint, 15),
        ("euler16", Solver::Euler, 16),
        ("euler_grid16", Solver::Euler, 15),
        ("euler15/final", Solver::Euler, 15),
    ] {
        if let Some(wanted) = find(part) {
            gates.tensor("sample", format!("{case}/{part}"), run(solver, intervals).0, wanted, TRAJECTORY);
        }
    }
    for (part, solver) in [("midpoint15", Solver::Midpoint), ("euler16", Solver::Euler)] {
        let Some(wanted) = find(&format!("{part}/trajectory")) else { continue };
        let (_, seen) = run(solver, wanted.shape[0] - 1);
        assert_eq!(seen.len(), wanted.shape[0], "a state for each point of the grid");
        for (k, state) in seen.into_iter().enumerate() {
            gates.tensor("sample", format!("{case}/{part} at {k}"), state, &row(wanted, k), TRAJECTORY);
        }
    }
}

fn loss(network: &FlowUnet, case: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let device = tracked();
    let find = |part: &str| io.find(&format!("{case}/{part}"));
    let data = find("data").or(find("motion")).expect("motion").tensor::<3>(&device);
    let noise = find("noise").expect("noise").tensor::<3>(&device);
    let times = find("t").expect("times").f32s();
    let tokens = find("c").or(find("z")).expect("tokens").tensor::<3>(&device);
    let [batch, frames, _] = data.dims();
    let x = between(data.clone(), noise.clone(), &times);
    if let Some(wanted) = find("x_t") {
        gates.tensor("between", case, x.clone(), wanted, FORWARD);
    }
    let found = network.forward(x, &times, tokens, &mut Dropout::off());
    if let Some(wanted) = find("v_pred") {
        gates.tensor("velocity", case, found.clone(), wanted, FORWARD);
    }
    // The mean over the valid frames of a padded batch, over all clips together.
    let squares = (found - (data - noise)).square().mean_dim(2);
    let loss = match find("lengths") {
        None => squares.mean(),
        Some(lengths) => {
            let lengths = lengths.usizes();
            let count = lengths.iter().sum::<usize>() as f32;
            let live = lengths.iter().flat_map(|len| (0..frames).map(move |t| f32::from(t < *len))).collect();
            let live = Tensor::<3>::from_data(TensorData::new(live, [batch, frames, 1]), &device);
            (squares * live).sum() / count
        }
    };
    gates.check("loss", case, relative(scalar(&loss), number(&expected[format!("{case}/loss")])), LOSS);
    let (entries, grads) = trained(&flat::layout(network), &gradients(network, loss));
    let prefix = format!("{case}/grad");
    check_gradients(gates, &entries, &grads, &without(&expected[&prefix], &NOT_OURS), io, &prefix);
}

fn steps(mut network: FlowUnet, config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let device = tracked();
    let entries = flat::layout(&network);
    let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.01 };
    let mut weights = flat::read(&network);
    let mut average = weights.clone();
    let (mut m, mut v) = (vec![0.0; weights.len()], vec![0.0; weights.len()]);
    for step in 0..size(config, "steps") {
        let what = format!("step_{step}");
        let stored = |part: &str| io.get(&format!("{what}/{part}"));
        let (data, noise) = (stored("motion").tensor::<3>(&device), stored("noise").tensor::<3>(&device));
        let times = stored("t").f32s();
        let [batch, frames, _] = data.dims();
        let x = between(data.clone(), noise.clone(), &times);
        gates.tensor("between", &*what, x.clone(), stored("x_t"), FORWARD);
        let found = network.forward(x, &times, stored("z").tensor(&device), &mut Dropout::off());
        // From the second step on, the weights carry the rounding of Adam's first update, which is nearly a sign.
        let gate = if step == 0 { FORWARD } else { CHANGE };
        gates.tensor("velocity", &*what, found.clone(), stored("prediction"), gate);
        let target = data - noise;
        gates.tensor("target", &*what, target.clone(), stored("target"), FORWARD);
        let weigh = FrameWeights::plain(&vec![frames; batch], frames, &device);
        let loss = weigh.compare(models::losses::Pointwise::L2, found, target) / batch as f32;
        let of = |part: &str| &expected[format!("{what}/{part}")];
        gates.check("loss", &*what, relative(scalar(&loss), number(of("loss"))), LOSS);
        let mut grads = gradients(&network, loss);
        check_gradients(gates, &entries, &grads, of("grad"), io, &format!("{what}/grad"));
        let norm = global_norm(&grads);
        gates.check("norm", &*what, relative(norm, number(of("norm_before_clip"))), 1e-4);
        let factor = clip_factor(norm, number(&config["max_norm"]));
        grads.iter_mut().for_each(|g| *g *= factor as f32);
        let before = weights.clone();
        adam.step(step as u64 + 1, number(&config["lr"]), &mut weights, &grads, &mut m, &mut v);
        ema(&mut average, &weights, number(&config["ema_rate"]));
        let difference = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<f32>>();
        for (part, values) in
            [("change", difference(&weights, &before)), ("ema_distance", difference(&weights, &average))]
        {
            for (entry, values) in split(&entries, &values) {
                let wanted = number(&of(part)[&entry.name]);
                gates.check(
                    "change",
                    format!("{what} {part} {}", entry.name),
                    relative(global_norm(values), wanted),
                    CHANGE,
                );
            }
        }
        for (part, values, gate) in
            [("param", &weights, CHANGE), ("ema", &average, TRAJECTORY), ("grad_after_clip", &grads, 1e-4)]
        {
            for (entry, values) in split(&entries, values) {
                if let Some(wanted) = io.find(&format!("{what}/{part}/{}", entry.name)) {
                    gates.check("whole", format!("{what} {part} {}", entry.name), error(values, &wanted.values), gate);
                }
            }
        }
        network = flat::write(network, &weights);
    }
}

#[test]
fn parity_discord_dit() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["06_discord_dit"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let mut gates = Gates::default();
        let heads = |n: &str| n.strip_prefix("bias_for_heads/").and_then(|n| n.parse::<usize>().ok());
        for count in io.names().filter_map(heads).collect::<Vec<_>>() {
            let wanted = io.get(&format!("bias_for_heads/{count}"));
            let len = wanted.shape[1];
            let found = falling(count, len, &device()).reshape([count, len, len]);
            gates.tensor("bias", count.to_string(), found, wanted, FORWARD);
        }
        for (variant, options) in config["variants"].as_object().expect("variants") {
            let sizes = dit_config(&config["constructor"], options, &weights, variant);
            let load = |device: &Device| {
                filled(FlowDit::new(&sizes, &mut draws(device)), &weights, &format!("{variant}."), &NOT_OURS)
            };
            dit_forward(&load(&device()), &sizes, variant, &io, &mut gates);
            dit_loss(&load(&tracked()), &sizes, variant, &expected, &io, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

fn dit_config(constructor: &Value, options: &Value, weights: &Arrays, variant: &str) -> DitConfig {
    DitConfig {
        features: size(constructor, "out_dim"),
        width: size(constructor, "embed_dim"),
        token_dim: size(constructor, "c_in_dim"),
        condition_dim: size(constructor, "c_proj_dim"),
        heads: size(constructor, "num_heads"),
        rate: size(constructor, "mlp_ratio"),
        layers: size(constructor, "depth"),
        positions: options["pos_encoding"] == "sinusoidal",
        alibi: options["temporal_bias"] == "alibi_future",
        text_dim: weights.find(&format!("{variant}.net.text_embed.weight")).map(|table| table.shape[1]),
    }
}

fn dit_forward(network: &FlowDit, sizes: &DitConfig, variant: &str, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("forward/{part}"));
    let wanted = |part: &str| io.get(&format!("{variant}/{part}"));
    let times = stored("t").f32s();
    let tokens = stored("z").tensor::<3>(&device());
    let text = || sizes.text_dim.map(|_| stored("text").tensor::<2>(&device()));
    gates.tensor("condition", variant, network.condition(tokens.clone()), wanted("condition"), FORWARD);
    gates.tensor("time", variant, network.time(&times, &device()), wanted("time_embedding"), FORWARD);
    let lengths = stored("lengths").usizes();
    for (part, lengths) in [("flow", None), ("flow_masked", Some(lengths.as_slice()))] {
        let x = stored("x").tensor(&device());
        let found = network.forward(x, &times, tokens.clone(), text(), lengths, &mut Dropout::off());
        gates.tensor("velocity", format!("{variant} {part}"), found, wanted(part), FORWARD);
    }
}

fn dit_loss(network: &FlowDit, sizes: &DitConfig, variant: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let device = tracked();
    let stored = |part: &str| io.get(&format!("loss/{part}"));
    let (data, noise) = (stored("motion").tensor::<3>(&device), stored("noise").tensor::<3>(&device));
    let times = stored("t").f32s();
    let text =
        sizes.text_dim.map(|_| io.find("loss/text").unwrap_or_else(|| io.get("forward/text")).tensor::<2>(&device));
    let x = between(data.clone(), noise.clone(), &times);
    let tokens = stored("z").tensor(&device);
    let found = network.forward(x, &times, tokens, text, None, &mut Dropout::off());
    let loss = (found - (data - noise)).square().mean();
    gates.check("loss", variant, relative(scalar(&loss), number(&expected[format!("{variant}/loss")])), LOSS);
    let prefix = format!("{variant}/grad");
    let entries = flat::layout(network);
    check_gradients(gates, &entries, &gradients(network, loss), &without(&expected[&prefix], &NOT_OURS), io, &prefix);
}
