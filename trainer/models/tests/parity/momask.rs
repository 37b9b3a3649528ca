//! Logits, losses with gradients and generation of MoMask's two transformers (fixture `05_momask_transformers`).

use burn::tensor::{Device, Tensor};
use models::flat;
use models::kernels::Dropout;
use models::networks::{MaskedTransformer, MomaskConfig, ResidualTransformer};
use models::tokens::masked::{Canvas, Corruption, Example, Sampling};
use models::tokens::{cross_entropy, masked, residual};
use protocol::stage::TokenNetwork;
use serde_json::Value;

use crate::common::{Array, Arrays, Gates, device, folders, json, name, relative, row, shared, tracked};
use crate::gpt::without;
use crate::networks::{check_gradients, gradients, scalar};
use crate::tokenizer::{draws, filled, ids, number, size};
use crate::{FORWARD, LOSS};

fn sizes(config: &Value) -> MomaskConfig {
    MomaskConfig {
        codes: size(config, "num_tokens"),
        quantizers: size(config, "num_quantizers"),
        network: TokenNetwork {
            width: size(config, "latent_dim"),
            layers: size(config, "layers"),
            heads: size(config, "heads"),
            feed_forward: size(config, "ff"),
            embedding: size(config, "code_dim"),
            ..TokenNetwork::default()
        },
        text_dim: size(config, "clip_dim"),
    }
}

fn masked_network(config: &MomaskConfig, weights: &Arrays, device: &Device) -> MaskedTransformer {
    filled(MaskedTransformer::new(config, &mut draws(device)), weights, "mask.", &[])
}

fn residual_network(config: &MomaskConfig, weights: &Arrays, which: &str, device: &Device) -> ResidualTransformer {
    let fresh = ResidualTransformer::new(config, which == "res", &mut draws(device));
    filled(fresh, weights, &format!("{which}."), &[])
}

#[test]
fn parity_momask_transformers() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["05_momask_transformers"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let sizes = sizes(&config);
        let mut gates = Gates::default();
        let network = masked_network(&sizes, &weights, &device());
        masked_logits(&network, &io, &mut gates);
        masked_training(&masked_network(&sizes, &weights, &tracked()), &sizes, &expected, &io, &mut gates);
        for case in io.cases() {
            if io.find(&format!("{case}/masked_ids_per_step")).is_some() {
                generation(&network, &sizes, &case, &expected, &io, &mut gates);
            }
        }
        for which in ["res", "res_unshared"] {
            let network = residual_network(&sizes, &weights, which, &device());
            residual_logits(&network, which, &io, &mut gates);
            let training = residual_network(&sizes, &weights, which, &tracked());
            residual_training(&training, &sizes, which, &expected, &io, &mut gates);
            if which == "res" {
                residual_generation(&network, &sizes, &expected, &io, &mut gates);
            }
        }
        gates.close(&name(&folder));
    }
}

/// Converts logits [B, n, C] to upstream's [B, C, n].
fn classes_second(logits: Tensor<3>) -> Tensor<3> {
    logits.swap_dims(1, 2)
}

fn guided(scale: f32, conditional: Tensor<3>, null: Tensor<3>) -> Tensor<3> {
    null.clone() + (conditional - null) * scale
}

fn masked_logits(network: &MaskedTransformer, io: &Arrays, gates: &mut Gates) {
    let off = &mut Dropout::off();
    let text = io.get("cond").tensor::<2>(&device());
    let (tokens, lengths) = (io.get("mask/ids").usizes(), io.get("m_lens").usizes());
    let conditional = network.forward(&tokens, text.clone(), &lengths, off);
    let null = network.forward(&tokens, text.zeros_like(), &lengths, off);
    for (part, logits) in [
        ("logits_cond", conditional.clone()),
        ("logits_null", null.clone()),
        ("logits_cfg4", guided(4.0, conditional, null)),
    ] {
        gates.tensor("logits", part, classes_second(logits), io.get(&format!("mask/{part}")), FORWARD);
    }
    let tokens = io.get("mask_single/ids");
    let text = io.get("mask_single/cond").tensor::<2>(&device());
    let logits = network.forward(&tokens.usizes(), text, &[tokens.shape[1]], off);
    gates.tensor("logits", "single", classes_second(logits), io.get("mask_single/logits"), FORWARD);
}

fn f32s(array: &Array, b: usize) -> Vec<f32> {
    row(array, b).f32s()
}

fn masked_training(
    network: &MaskedTransformer,
    config: &MomaskConfig,
    expected: &Value,
    io: &Arrays,
    gates: &mut Gates,
) {
    let stored = |part: &str| io.get(&format!("mask_train/{part}"));
    let (tokens, lengths) = (stored("ids"), io.get("m_lens").usizes());
    let n = tokens.shape[1];
    let example = |b: usize| {
        let (order, replace, hide) =
            (f32s(stored("rand_for_argsort"), b), f32s(stored("u_10_percent"), b), f32s(stored("u_88_percent"), b));
        let random = row(stored("random_ids"), b).usizes();
        let share = stored("rand_time").values[b] as f32;
        let draws = Corruption { share, order: &order, replace: &replace, hide: &hide, random: &random };
        Example::new(config, &row(tokens, b).usizes(), lengths[b], &draws)
    };
    let examples: Vec<Example> = (0..lengths.len()).map(example).collect();
    let input: Vec<usize> = examples.iter().flat_map(|e| e.input.clone()).collect();
    assert_eq!(input, stored("input_ids").usizes(), "corrupted ids");
    let asked: Vec<bool> = examples.iter().flat_map(|e| e.asked.clone()).collect();
    let labels = stored("labels").usizes();
    let wanted: Vec<bool> = labels.iter().map(|label| *label != config.mask()).collect();
    assert_eq!(asked, wanted, "supervised positions");
    let text = io.get("cond").tensor::<2>(&tracked());
    let logits = network.forward(&input, text, &lengths, &mut Dropout::off());
    gates.tensor("logits", "train", classes_second(logits.clone()), stored("logits"), FORWARD);
    let count = asked.iter().filter(|a| **a).count() as f32;
    let weights: Vec<f32> = asked.iter().map(|a| if *a { 1.0 / count } else { 0.0 }).collect();
    let targets = tokens.usizes();
    assert_eq!(targets.len(), lengths.len() * n);
    let loss = cross_entropy(logits, &targets, &weights);
    gates.check("loss", "mask_train", relative(scalar(&loss), number(&expected["mask_train"]["ce_loss"])), LOSS);
    let wanted = without(&expected["mask_train/grad"], &[]);
    check_gradients(gates, &flat::layout(network), &gradients(network, loss), &wanted, io, "mask_train/grad");
}

/// Stored uniform draws [step, B, n, classes].
fn uniforms(stored: &Array) -> impl FnMut(usize, usize, usize, &mut [f32]) + '_ {
    move |step: usize, b: usize, p: usize, out: &mut [f32]| {
        let [_, batch, len, classes] = stored.shape[..] else { panic!("draws by step, clip, position and class") };
        let at = ((step * batch + b) * len + p) * classes;
        out.iter_mut().zip(&stored.values[at..at + classes]).for_each(|(out, u)| *out = *u as f32);
    }
}

fn sampling(expected: &Value) -> Sampling {
    Sampling {
        steps: expected["timesteps"].as_u64().unwrap_or(1) as usize,
        guidance: number(&expected["cond_scale"]) as f32,
        temperature: number(&expected["temperature"]) as f32,
        threshold: number(&expected["topk_filter_thres"]),
    }
}

fn generation(
    network: &MaskedTransformer,
    config: &MomaskConfig,
    case: &str,
    expected: &Value,
    io: &Arrays,
    gates: &mut Gates,
) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let canvases: Vec<Canvas> = stored("m_lens").usizes().into_iter().map(Canvas::empty).collect();
    let text = stored("cond").tensor::<2>(&device());
    let mut seen = Vec::new();
    let mut draws = uniforms(stored("gumbel_u"));
    let sampling = sampling(&expected[case]);
    let found =
        masked::generate(network, config, &sampling, text, &canvases, &mut draws, |ids| seen.extend(ids.to_vec()));
    assert_eq!(seen, stored("masked_ids_per_step").usizes(), "{case}: what is masked in each step");
    assert_eq!(found, ids(stored("ids")), "{case}: ids");
    gates.check("generated", case, 0.0, 0.0);
}

fn residual_logits(network: &ResidualTransformer, which: &str, io: &Arrays, gates: &mut Gates) {
    let off = &mut Dropout::off();
    let stored = |part: &str| io.get(&format!("{which}/{part}"));
    let (layers, lengths) = (stored("qids").usizes(), io.get("m_lens").usizes());
    let text = io.get("cond").tensor::<2>(&device());
    let sum = stored("history_sum").tensor::<3>(&device());
    let batch = layers.len();
    let features = network.features(sum.clone(), &layers, text.clone(), &lengths, off);
    gates.tensor("features", which, classes_second(features), stored("trans_forward"), FORWARD);
    let logits = network.forward(sum.clone(), &layers, text.clone(), &lengths, off);
    gates.tensor("logits", which, classes_second(logits), stored("logits"), FORWARD);
    let at = |layer: usize, text: Tensor<2>| {
        network.forward(sum.clone(), &vec![layer; batch], text, &lengths, &mut Dropout::off())
    };
    let null = text.zeros_like();
    let found = classes_second(guided(5.0, at(2, text), at(2, null.clone())));
    gates.tensor("logits", format!("{which} cfg"), found, stored("logits_cfg5_q2"), FORWARD);
    let found = classes_second(at(1, null));
    gates.tensor("logits", format!("{which} null"), found, stored("logits_null_q1"), FORWARD);
}

fn residual_training(
    network: &ResidualTransformer,
    config: &MomaskConfig,
    which: &str,
    expected: &Value,
    io: &Arrays,
    gates: &mut Gates,
) {
    let case = format!("{which}_train");
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let (layers, lengths) = (stored("active_q").usizes(), io.get("m_lens").usizes());
    let all = io.get("res/all_indices");
    let n = all.shape[1];
    let token = |b: usize, p: usize, q: usize| {
        if p < lengths[b] { all.values[(b * n + p) * config.quantizers + q] as usize } else { config.residual_pad() }
    };
    // Embedded here, so that the gradient reaches the tables.
    let clips: Vec<Tensor<3>> = (0..layers.len())
        .map(|b| {
            let ids = |q: usize| (0..n).map(|p| token(b, p, q)).collect::<Vec<_>>();
            let all = (0..layers[b]).map(|q| network.embed(&ids(q), q, 1));
            all.reduce(|a, b| a + b).expect("a layer is at least 1")
        })
        .collect();
    let sum = Tensor::cat(clips, 0);
    gates.tensor("history", &*case, sum.clone(), stored("history_sum"), FORWARD);
    let targets: Vec<usize> =
        (0..layers.len()).flat_map(|b| (0..n).map(move |p| (b, p))).map(|(b, p)| token(b, p, layers[b])).collect();
    assert_eq!(targets, stored("labels").usizes(), "{case}: labels");
    let text = io.get("cond").tensor::<2>(&tracked());
    let logits = network.forward(sum, &layers, text, &lengths, &mut Dropout::off());
    gates.tensor("logits", &*case, classes_second(logits.clone()), stored("logits"), FORWARD);
    let count: usize = lengths.iter().sum();
    let weight = |b: usize, p: usize| if p < lengths[b] { 1.0 / count as f32 } else { 0.0 };
    let weights: Vec<f32> = (0..layers.len()).flat_map(|b| (0..n).map(move |p| weight(b, p))).collect();
    let loss = cross_entropy(logits, &targets, &weights);
    gates.check("loss", &*case, relative(scalar(&loss), number(&expected[&case]["ce_loss"])), LOSS);
    let prefix = format!("{case}/grad");
    let wanted = without(&expected[&prefix], &[]);
    check_gradients(gates, &flat::layout(network), &gradients(network, loss), &wanted, io, &prefix);
}

fn residual_generation(
    network: &ResidualTransformer,
    config: &MomaskConfig,
    expected: &Value,
    io: &Arrays,
    gates: &mut Gates,
) {
    let expected = &expected["res_generate"];
    let lengths: Vec<usize> = serde_json::from_value(expected["lengths"].clone()).expect("lengths");
    let text = io.get("cond").tensor::<2>(&device());
    let first = ids(io.get("res_generate/base_ids"));
    let mut draws = uniforms(io.get("res_generate/gumbel_u"));
    let first = residual::First { ids: &first, lengths: &lengths, known: &|_, _| None };
    let found = residual::generate(network, config, &sampling(expected), text, first, &mut draws);
    assert_eq!(found, ids(io.get("res_generate/all_indices")), "res_generate: ids");
    gates.check("generated", "res_generate", 0.0, 0.0);
}
