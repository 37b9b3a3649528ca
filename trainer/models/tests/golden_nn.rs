//! Transformer blocks, GRUs, convolutions and the small evaluators against PyTorch's layers (golden `nn`).
//!
//! Only layers of the published networks are checked: norm after the residual, exact GELU, one layer of GRU. The others
//! are named and skipped, and so are causal masks.

mod common;

use std::path::Path;

use burn::tensor::{Device, Tensor};
use common::{Array, Arrays, Gates, golden, json, name, row, values};
use models::kernels::{Dropout, KeyMask};
use models::names;
use models::networks::{
    BiGru, Block, Deconv, EvaluatorConfig, Init, MotionEncoder, MovementEncoder, StackConfig, TextEncoder,
};
use protocol::Seed;
use protocol::stage::Positions;
use serde_json::Value;

const GATE: f64 = 3e-6;

#[test]
fn golden_nn() {
    for root in golden("nn") {
        check_layers(&root);
    }
}

fn check_layers(root: &Path) {
    let info = json(&root.join("info.json"));
    let mut seen = 0;
    let mut files: Vec<_> = std::fs::read_dir(root)
        .expect("a readable folder")
        .map(|entry| entry.expect("a readable folder").path())
        .collect();
    files.sort();
    for file in files {
        let file_name = name(&file);
        let Some(layer) = file_name.strip_suffix(".io.safetensors") else { continue };
        let weights = root.join(format!("{layer}.weights.safetensors"));
        if let Some(check) = recurrent(layer) {
            seen += 1;
            let (io, stored, mut gates) = (Arrays::read(&file), Arrays::read(&weights), Gates::default());
            for device in [Device::flex(), Device::flex().autodiff()] {
                check(&io, &stored, &device, &mut gates);
            }
            gates.close(&format!("golden/nn/{layer}"));
            continue;
        }
        let decoder = layer.starts_with("decoder_layer");
        if !(decoder || layer.starts_with("encoder_layer")) || !layer.ends_with("gelu_postnorm") {
            fixtures::skip(&format!("golden/nn/{layer}: no network here has this layer"));
            continue;
        }
        seen += 1;
        let (io, mut gates) = (Arrays::read(&file), Gates::default());
        // The kernels have separate paths with and without a tape.
        for device in [Device::flex(), Device::flex().autodiff()] {
            let block = block(&weights, heads(&info[layer]), decoder, &device);
            let check = if decoder { check_decoder } else { check_encoder };
            check(&block, &io, &device, &mut gates);
        }
        gates.close(&format!("golden/nn/{layer}"));
    }
    assert!(seen > 0, "no layer that exists here is stored");
}

/// Heads of a layer by its description, or four if the description has none.
fn heads(description: &Value) -> usize {
    let stated = description.as_str().and_then(|text| text.split("nhead=").nth(1));
    let digits = |text: &str| text.chars().take_while(char::is_ascii_digit).collect::<String>();
    stated.map_or(4, |text| digits(text).parse().expect("a number of heads"))
}

/// A block with the sizes of the stored weights.
fn block(weights: &Path, heads: usize, memory: bool, device: &Device) -> Block {
    let bytes = std::fs::read(weights).expect("readable weights");
    let linear1 = Arrays::read(weights).get("linear1.weight").shape.clone();
    let config = StackConfig { width: linear1[1], layers: 1, heads, feed_forward: linear1[0], norm_eps: 1e-5, memory };
    let block = Block::new(&mut Init::new(Seed(1), "golden", Positions::Uniform, device), &config);
    names::load(block, &bytes, "").expect("weights that fit")
}

/// Valid keys of each sequence; a stored mask is 1 where masked, and masks a tail.
fn lengths(mask: &Array) -> Vec<usize> {
    let keys = mask.shape[1];
    let valid = |mask: &[f64]| {
        let count = mask.iter().take_while(|m| **m == 0.0).count();
        assert!(mask[count..].iter().all(|m| *m == 1.0), "only tails are masked");
        count
    };
    mask.values.chunks(keys).map(valid).collect()
}

fn check_encoder(block: &Block, io: &Arrays, device: &Device, gates: &mut Gates) {
    let off = &mut Dropout::off();
    let x = io.get("x").tensor::<3>(device);
    gates.tensor("encoder", "y", block.forward(x.clone(), None, None, off), io.get("y"), GATE);
    let mask = KeyMask::new(&lengths(io.get("pad_mask")), 0);
    // Padded queries are computed too, from the valid keys.
    gates.tensor("encoder", "y_padded", block.forward(x, None, Some(&mask), off), io.get("y_padded"), GATE);
}

/// Memories are never padded; each sequence sees its own, cut to its length.
fn check_decoder(block: &Block, io: &Arrays, device: &Device, gates: &mut Gates) {
    let (tgt, memory, y) = (io.get("tgt"), io.get("memory"), io.get("y"));
    for (b, keys) in lengths(io.get("mem_pad_mask")).into_iter().enumerate() {
        let one = |array: &Array| row(array, b).tensor::<2>(device).unsqueeze::<3>();
        let width = memory.shape[2];
        let memory: Tensor<3> = one(memory).slice([0..1, 0..keys, 0..width]);
        let found = block.forward(one(tgt), Some(memory), None, &mut Dropout::off());
        gates.check("decoder", format!("y of {b}"), common::error(&values(found), &row(y, b).values), GATE);
    }
}

type Check = fn(&Arrays, &Arrays, &Device, &mut Gates);

/// The check of a layer of the evaluators.
fn recurrent(layer: &str) -> Option<Check> {
    Some(match layer {
        "gru_bidirectional" => check_gru,
        "conv_stack" => check_convolutions,
        "evaluator_movement_encoder_small" => check_movements,
        "evaluator_motion_encoder_small" => check_motion,
        "evaluator_text_encoder_small" => check_text,
        _ => return None,
    })
}

fn draws(device: &Device) -> Init<'_> {
    Init::new(Seed(1), "golden", Positions::Uniform, device)
}

fn loaded<M: burn::module::Module>(module: M, stored: &Arrays) -> M {
    names::load(module, &std::fs::read(&stored.file).expect("readable weights"), "").expect("weights that fit")
}

/// Sizes from stored shapes; sizes that a layer does not have are 1.
fn sizes(stored: &Arrays) -> EvaluatorConfig {
    let dim = |name: &str, axis: usize| stored.find(name).map_or(1, |a| a.shape[axis]);
    EvaluatorConfig {
        features: dim("main.0.weight", 1),
        movement_hidden: dim("main.0.weight", 0),
        movement: dim("main.3.weight", 0).max(dim("input_emb.weight", 1)),
        motion_hidden: dim("hidden", 2),
        word: dim("pos_emb.weight", 0),
        classes: dim("pos_emb.weight", 1),
        text_hidden: dim("hidden", 2),
        embedding: dim("output_net.3.weight", 0),
    }
}

fn check_movements(io: &Arrays, stored: &Arrays, device: &Device, gates: &mut Gates) {
    let network = loaded(MovementEncoder::new(&sizes(stored), &mut draws(device)), stored);
    let found = network.forward(io.get("x").tensor(device), &mut Dropout::off());
    gates.tensor("movements", "y", found, io.get("y"), GATE);
}

fn check_motion(io: &Arrays, stored: &Arrays, device: &Device, gates: &mut Gates) {
    let network = loaded(MotionEncoder::new(&sizes(stored), &mut draws(device)), stored);
    let found = network.forward(io.get("x").tensor(device), &io.get("lengths").usizes());
    gates.tensor("motion", "y", found, io.get("y"), GATE);
}

fn check_text(io: &Arrays, stored: &Arrays, device: &Device, gates: &mut Gates) {
    let network = loaded(TextEncoder::new(&sizes(stored), &mut draws(device)), stored);
    let (words, classes) = (io.get("word_embs").tensor(device), io.get("pos_onehot").tensor(device));
    gates.tensor("text", "y", network.forward(words, classes, &io.get("cap_lens").usizes()), io.get("y"), GATE);
}

/// Checks equal and ragged lengths. Past a sequence's end the stored state is zero and ours is ignored.
fn check_gru(io: &Arrays, stored: &Arrays, device: &Device, gates: &mut Gates) {
    let rows = stored.get("weight_ih_l0").shape.clone();
    let width = rows[0] / 3;
    let network = loaded(BiGru::new(&mut draws(device), rows[1], width), stored);
    let x = io.get("x").tensor::<3>(device);
    let [batch, tokens, _] = x.dims();
    let full = vec![tokens; batch];
    for (lengths, y, last) in [(full, "y", "h_n"), (io.get("lengths").usizes(), "y_packed", "h_n_packed")] {
        let start = |k: usize| row(io.get("h0"), k).tensor::<2>(device);
        let states = network.forward(x.clone(), &lengths, [start(0), start(1)]).map(values);
        let (mut found, mut ends) = (vec![0.0; batch * tokens * 2 * width], vec![0.0; 2 * batch * width]);
        for (k, states) in states.iter().enumerate() {
            for (b, length) in lengths.iter().enumerate() {
                let at = |t: usize| &states[(b * tokens + t) * width..][..width];
                for t in 0..*length {
                    found[((b * tokens + t) * 2 + k) * width..][..width].copy_from_slice(at(t));
                }
                ends[(k * batch + b) * width..][..width].copy_from_slice(at(if k == 0 { tokens - 1 } else { 0 }));
            }
        }
        gates.check("states", y, common::error(&found, &io.get(y).values), GATE);
        gates.check("last states", last, common::error(&ends, &io.get(last).values), GATE);
    }
}

/// Checks both convolutions; the layers between and after them are computed here in f64.
fn check_convolutions(io: &Arrays, stored: &Arrays, device: &Device, gates: &mut Gates) {
    use models::networks::Conv;
    let x = io.get("x").tensor::<3>(device).swap_dims(1, 2);
    let part = |name: &str| stored.get(name).tensor::<3>(device);
    let bias = |name: &str| stored.get(name).tensor::<1>(device);
    let x = Conv::from_weights(part("0.weight"), bias("0.bias")).forward(x);
    let x = burn::tensor::activation::leaky_relu(x, 0.2);
    let x = Deconv::from_weights(part("2.weight"), bias("2.bias")).forward(x).swap_dims(1, 2);
    let [batch, channels, frames] = x.dims();
    let (gamma, beta, groups) = (&stored.get("3.weight").values, &stored.get("3.bias").values, 3);
    let size = channels / groups * frames;
    let mut found = values(x);
    for (g, group) in found.chunks_mut(size).enumerate() {
        let mean = group.iter().map(|v| f64::from(*v)).sum::<f64>() / size as f64;
        let variance = group.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / size as f64;
        for (i, v) in group.iter_mut().enumerate() {
            let channel = g % groups * (channels / groups) + i / frames;
            let y = (f64::from(*v) - mean) / (variance + 1e-5).sqrt() * gamma[channel] + beta[channel];
            *v = (y / (1.0 + (-y).exp())) as f32;
        }
    }
    assert_eq!(io.get("y").shape, [batch, channels, frames]);
    gates.check("convolutions", "y", common::error(&found, &io.get("y").values), GATE);
}
