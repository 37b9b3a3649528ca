//! Transformer blocks against PyTorch's layers (golden `nn`).
//!
//! Only layers that the published networks have: norm after the residual, exact GELU. The others are named and skipped,
//! and so are causal masks.

mod common;

use std::path::Path;

use burn::tensor::{Device, Tensor};
use common::{Array, Arrays, Gates, json, name, row, shared, values};
use models::kernels::{Dropout, KeyMask};
use models::names;
use models::networks::{Block, Init, StackConfig};
use protocol::Seed;
use protocol::stage::Positions;
use serde_json::Value;

const GATE: f64 = 3e-6;

#[test]
fn golden_nn() {
    let Some(root) = shared("golden/nn") else { return };
    let info = json(&root.join("info.json"));
    let mut seen = 0;
    let mut files: Vec<_> = std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    for file in files {
        let file_name = name(&file);
        let Some(layer) = file_name.strip_suffix(".io.safetensors") else { continue };
        let weights = root.join(format!("{layer}.weights.safetensors"));
        let decoder = layer.starts_with("decoder_layer");
        if !(decoder || layer.starts_with("encoder_layer")) || !layer.ends_with("gelu_postnorm") {
            eprintln!("SKIPPED: golden/nn/{layer}: no network here has this layer");
            continue;
        }
        seen += 1;
        let (io, mut gates) = (Arrays::read(&file), Gates::default());
        // On the tape and off it, the kernels take different ways.
        for device in [Device::flex(), Device::flex().autodiff()] {
            let block = block(&weights, heads(&info[layer]), decoder, &device);
            let check = if decoder { check_decoder } else { check_encoder };
            check(&block, &io, &device, &mut gates);
        }
        gates.close(&format!("golden/nn/{layer}"));
    }
    assert!(seen > 0, "no layer that exists here is stored");
}

/// Heads of a layer: as its description says, four where it says nothing.
fn heads(description: &Value) -> usize {
    let stated = description.as_str().and_then(|text| text.split("nhead=").nth(1));
    let digits = |text: &str| text.chars().take_while(char::is_ascii_digit).collect::<String>();
    stated.map_or(4, |text| digits(text).parse().expect("a number of heads"))
}

/// A block of the stored weights' sizes.
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

/// Memories are never padded here; each sequence sees its own, cut to its length.
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
