//! Logits, loss with gradients, greedy and drawn ids of the autoregressive generator (fixtures `05_t2mgpt_transformer`,
//! `05_t2mgpt_sampling`).

use burn::tensor::{Device, Tensor};
use models::flat;
use models::kernels::Dropout;
use models::networks::{Gpt, GptConfig};
use models::tokens::autoregressive::{Draw, Example, loss, sample};
use protocol::stage::TokenNetwork;
use serde_json::{Value, json as value};

use crate::common::{Arrays, Gates, device, folders, json, name, relative, shared, tracked};
use crate::networks::{check_gradients, gradients, scalar};
use crate::tokenizer::{draws, filled, number, size};
use crate::{FORWARD, LOSS};

/// Names in the published state that are no parameters here.
const NOT_OURS: [&str; 3] = ["attn.mask", "pos_embed.embed", "pos_embedding"];

fn network(config: &Value, weights: &Arrays, device: &Device) -> (Gpt, GptConfig) {
    let config = GptConfig {
        codes: size(config, "num_vq"),
        network: TokenNetwork {
            width: size(config, "embed_dim"),
            layers: size(config, "num_layers_base_and_head"),
            heads: size(config, "heads"),
            feed_forward: size(config, "fc_rate") * size(config, "embed_dim"),
            ..TokenNetwork::default()
        },
        block: size(config, "block_size"),
        text_dim: size(config, "clip_dim"),
    };
    (filled(Gpt::new(&config, &mut draws(device)), weights, "", &NOT_OURS), config)
}

/// Expected gradients without the parameters that only the published state has.
pub(crate) fn without(expected: &Value, names: &[&str]) -> Value {
    let mut expected = expected.clone();
    if let Some(unused) = expected["no_gradient"].as_array_mut() {
        unused.retain(|n| !names.iter().any(|part| n.as_str().is_some_and(|n| n.contains(part))));
    }
    if expected["no_gradient"].is_null() {
        expected["no_gradient"] = value!([]);
    }
    expected
}

#[test]
fn parity_autoregressive() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["05_t2mgpt_transformer", "05_t2mgpt_sampling"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let mut gates = Gates::default();
        let (plain, sizes) = network(&config, &weights, &device());
        for case in io.cases() {
            if io.find(&format!("{case}/exponential")).is_some() {
                drawn(&plain, &sizes, &case, &expected, &io, &mut gates);
            } else if case == "train" {
                let (network, _) = network(&config, &weights, &tracked());
                train(&network, &sizes, &expected, &io, &mut gates);
            } else if case == "greedy" {
                let text = io.get("full/cond").tensor::<2>(&device());
                let stored = io.get("greedy/ids");
                let rows = stored.shape[0];
                let text = text.clone().slice([0..rows, 0..text.dims()[1]]);
                let found = sample(&plain, &sizes, text, Draw::Greedy);
                assert_eq!(found.concat(), stored.usizes(), "greedy ids");
                gates.check("greedy", "ids", 0.0, 0.0);
            } else {
                let wanted = io.get(&format!("{case}/logits"));
                let ids = io.find(&format!("{case}/ids")).map_or_else(Vec::new, crate::common::Array::usizes);
                let all = io.get("full/cond").tensor::<2>(&device());
                let text = all.clone().slice([0..wanted.shape[0], 0..all.dims()[1]]);
                let logits = plain.forward(&ids, text, &mut Dropout::off());
                gates.tensor("logits", &*case, logits, wanted, FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

fn train(network: &Gpt, config: &GptConfig, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("train/{part}"));
    let (targets, lengths) = (stored("target").usizes(), stored("lens").usizes());
    let (keep, random) = (stored("keep_mask").usizes(), stored("random_ids").usizes());
    let places = config.block - 1;
    let example = |b: usize| {
        let keep: Vec<bool> = keep[b * places..(b + 1) * places].iter().map(|k| *k == 1).collect();
        let tokens = &targets[b * config.block..][..lengths[b]];
        Example::new(config, tokens, &keep, &random[b * places..(b + 1) * places])
    };
    let examples: Vec<Example> = (0..lengths.len()).map(example).collect();
    let input: Vec<usize> = examples.iter().flat_map(|e| e.input.clone()).collect();
    assert_eq!(input, stored("input_ids").usizes(), "corrupted ids");
    let target: Vec<usize> = examples.iter().flat_map(|e| e.target.clone()).collect();
    assert_eq!(target, targets, "targets");
    let text: Tensor<2> = io.get("full/cond").tensor(&tracked());
    let logits = network.forward(&input, text, &mut Dropout::off());
    gates.tensor("logits", "train", logits.clone(), stored("logits"), FORWARD);
    let loss = loss(logits, &examples) / examples.len() as f32;
    gates.check("loss", "train", relative(scalar(&loss), number(&expected["train/loss"])), LOSS);
    let wanted = without(&expected["train/grad"], &NOT_OURS);
    check_gradients(gates, &flat::layout(network), &gradients(network, loss), &wanted, io, "train/grad");
}

fn drawn(network: &Gpt, config: &GptConfig, case: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let text = stored("text").tensor::<2>(&device());
    let (exponentials, classes) = (stored("exponential"), config.codes + 1);
    let mut taken = 0;
    let mut fill = |step: usize, _: usize, out: &mut [f64]| {
        taken += 1;
        // A case stores only the draws that it used.
        let at = step * classes;
        out.copy_from_slice(&exponentials.values[at..at + classes]);
    };
    let found = sample(network, config, text, Draw::Categorical(&mut fill));
    assert_eq!(found.concat(), stored("ids").usizes(), "{case}: ids");
    let wanted = expected[format!("{case}/evaluations")].as_u64();
    assert_eq!(Some(taken), wanted, "{case}: evaluations");
    let probabilities = stored("probs");
    let drawn = stored("drawn").usizes();
    let text = stored("text").tensor::<2>(&device());
    let logits = network.forward(&drawn[..drawn.len() - 1], text, &mut Dropout::off());
    let shares = burn::tensor::activation::softmax(logits, 2);
    let [_, len, _] = shares.dims();
    gates.tensor("shares", case, shares.reshape([len, classes]), probabilities, FORWARD);
}
