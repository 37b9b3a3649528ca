//! Text encoders (fixtures `09_text_clip`, `09_text_t5`). CLIP: states, pooled and projected vectors of stored ids,
//! under both namings of its weights, with and without masks. T5: position buckets and bias, its gated variant, and
//! Sentence-T5's vector.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use models::flat;
use models::networks::{
    ClipText, ClipTextConfig, Linear, T5Config, T5Encoder, distance_bucket, mean_of_tokens, normalised,
    renamed_from_openai,
};
use serde_json::Value;

use crate::FORWARD;
use crate::common::{Array, Arrays, Gates, device, folders, json, name, row, shared};
use crate::tokenizer::{draws, filled};

/// Names in published folders that are not part of the text tower.
const NOT_OURS: [&str; 4] = ["vision_model.", "visual_projection.", "logit_scale", "position_ids"];

/// The first rows of `found`, as many as the stored array has.
fn first<const D: usize>(found: Tensor<D>, stored: &Array) -> Tensor<D> {
    found.narrow(0, 0, stored.shape[0])
}

#[test]
fn parity_text_clip() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["09_text_clip"]) {
        let device = device();
        let config = json(&folder.join("config.json"));
        let sizes: ClipTextConfig =
            serde_json::from_value(with_projection(&config)).expect("a published configuration");
        let fresh = || ClipText::new(&sizes, &mut draws(&device));
        let weights = Arrays::read(&folder.join("model.safetensors"));
        let tower = filled(fresh(), &weights, "", &NOT_OURS);
        let renamed = openai(fresh(), &Arrays::read(&folder.join("openai_weights.safetensors")));
        assert_eq!(flat::read(&renamed), flat::read(&tower), "one tower under two namings");

        let io = Arrays::read(&folder.join("io.safetensors"));
        let listed = io.get("states_of_captions").usizes();
        let mut gates = Gates::default();
        for case in io.cases() {
            let ids = io.find(&format!("{case}/input_ids")).unwrap_or_else(|| io.get("hf77/input_ids"));
            let is_masked = case.ends_with("_masked");
            let visible =
                is_masked.then(|| io.get("hf77/attention_mask").values.iter().map(|v| *v > 0.0).collect::<Vec<_>>());
            let batch = ids.shape[0];
            let found = tower.forward(&ids.usizes(), batch, visible.as_deref());
            let states = found.tokens_bth;
            let at = |what: &str| io.find(&format!("{case}/{what}"));
            if let Some(expected) = at("pooled") {
                gates.tensor("pooled", &case, found.pooled_bh, expected, FORWARD);
            }
            if let Some(expected) = at("text_embeds") {
                gates.tensor("projected", &case, found.projected_bc, expected, FORWARD);
            }
            if let Some(expected) = at("last_hidden_state") {
                let all: Vec<Tensor<3>> = listed.iter().map(|i| states.clone().narrow(0, *i, 1)).collect();
                gates.tensor("states", &case, first(Tensor::cat(all, 0), expected), expected, FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

/// `text_config`, with the projection's width from the level above.
fn with_projection(config: &Value) -> Value {
    let mut text = config["text_config"].clone();
    text["projection_dim"] = config["projection_dim"].clone();
    text
}

/// `module` with weights under OpenAI's names.
fn openai<M: Module>(module: M, weights: &Arrays) -> M {
    let renamed = weights.names().flat_map(|name| {
        let array = weights.get(name);
        renamed_from_openai(name, &array.shape, array.f32s())
    });
    let mut renamed: BTreeMap<String, (Vec<usize>, Vec<f32>)> =
        renamed.map(|(name, shape, values)| (name, (shape, values))).collect();
    let take = |entry: flat::Entry| {
        let (shape, values) = renamed.remove(&entry.name).unwrap_or_else(|| panic!("no `{}`", entry.name));
        assert_eq!(shape, entry.shape, "{}", entry.name);
        values
    };
    let all: Vec<f32> = flat::layout(&module).into_iter().flat_map(take).collect();
    assert!(renamed.is_empty(), "unused: {:?}", renamed.keys());
    flat::write(module, &all)
}

fn t5(folder: &Path, device: &Device) -> T5Encoder {
    let sizes: T5Config = serde_json::from_value(json(&folder.join("config.json"))).expect("a published configuration");
    let weights = Arrays::read(&folder.join("model.safetensors"));
    filled(T5Encoder::new(&sizes, &mut draws(device)), &weights, "", &["encoder.embed_tokens"])
}

#[test]
fn parity_text_t5() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["09_text_t5"]) {
        let device = device();
        let (plain, gated) = (t5(&folder, &device), t5(&folder.join("gated"), &device));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();

        let distances = io.get("buckets/relative_position").values.iter();
        let buckets: Vec<usize> = distances.map(|d| distance_bucket(*d as i64, 32, 128)).collect();
        assert_eq!(buckets, io.get("buckets/bidirectional_32_128").usizes());

        let (ids, lengths) = (io.get("tokens/input_ids"), io.get("tokens/length").usizes());
        let caption = |i: usize| row(ids, i).usizes()[..lengths[i]].to_vec();
        for i in io.get("states_of_captions").usizes() {
            let (ids, case) = (caption(i), format!("caption_{i}"));
            for (what, encoder) in [("states", &plain), ("states_gated", &gated)] {
                let expected = io.get(&format!("{case}/{what}"));
                let found = encoder.forward(&ids, &[ids.len()]);
                let [_, len, width] = found.dims();
                gates.tensor("states", format!("{case}/{what}"), found.reshape([len, width]), expected, FORWARD);
            }
            if let Some(expected) = io.find(&format!("{case}/position_bias")) {
                let found = plain.position_bias(ids.len());
                let [_, heads, len, _] = found.dims();
                gates.tensor("bias", &case, found.reshape([heads, len, len]), expected, FORWARD);
            }
        }

        // A padded batch: states of padding are undefined on both sides.
        let of = io.get("padded/rows").usizes();
        let expected = io.get("padded/states");
        let longest = expected.shape[1];
        let padded: Vec<usize> = of.iter().flat_map(|i| row(ids, *i).usizes()[..longest].to_vec()).collect();
        let own: Vec<usize> = of.iter().map(|i| lengths[*i].min(longest)).collect();
        let found = plain.forward(&padded, &own);
        for (b, len) in own.iter().enumerate() {
            let found = found.clone().narrow(0, b, 1).narrow(1, 0, *len);
            let stored = row(expected, b);
            let width = stored.shape[1];
            let stored = Array { shape: vec![1, *len, width], values: stored.values[..len * width].to_vec() };
            gates.tensor("padded", format!("row {b}"), found, &stored, FORWARD);
        }

        let dense = Arrays::read(&folder.join("2_Dense/model.safetensors"));
        let weight = dense.get("linear.weight");
        let fresh = Linear::zero(&draws(&device), weight.shape[1], weight.shape[0]);
        let dense = filled(fresh, &dense, "linear.", &[]);
        let mean = |encoder: &T5Encoder| {
            let one = |i: usize| mean_of_tokens(encoder.forward(&caption(i), &[lengths[i]]), &[lengths[i]]);
            Tensor::cat((0..lengths.len()).map(one).collect(), 0)
        };
        let pooled = mean(&plain);
        let projected = dense.forward(pooled.clone());
        gates.tensor("sentence", "pooled", pooled, io.get("sentence/pooled"), FORWARD);
        gates.tensor("sentence", "dense", projected.clone(), io.get("sentence/dense"), FORWARD);
        gates.tensor("sentence", "embedding", normalised(projected), io.get("sentence/embedding"), FORWARD);
        gates.tensor("sentence", "gated", mean(&gated), io.get("gated/pooled"), FORWARD);
        gates.close(&name(&folder));
    }
}
