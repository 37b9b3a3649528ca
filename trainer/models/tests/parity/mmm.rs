//! MMM's generator (fixture `05_mmm`): logits, the training script's draws, loss, gradients and update, and sampling
//! step by step.

use burn::tensor::Device;
use models::flat;
use models::kernels::Dropout;
use models::networks::{Mmm, MmmCondition, MmmConfig};
use models::optim::{AdamW, global_norm};
use models::tokens::mmm::{Corruption, Counts, Example, Sampling, Step, logits, loss, sample};
use protocol::stage::TokenNetwork;
use serde_json::Value;

use crate::common::{Array, Arrays, Gates, device, error, folders, json, name, relative, row, shared, tracked};
use crate::gpt::without;
use crate::networks::{check_gradients, gradients, scalar, split};
use crate::tokenizer::{draws, filled, number, size};
use crate::{FORWARD, LOSS};

/// Names in the published state that are no parameters here.
const NOT_OURS: [&str; 4] = ["vqvae.", "attn.mask", "pos_embed.embed", "pos_embedding"];
/// Gate of the norm of a parameter's change in one update.
const CHANGE: f64 = 1e-3;

struct Loaded {
    network: Mmm,
    sizes: MmmConfig,
    codes: Array,
    device: Device,
}

impl Loaded {
    fn condition(&self, io: &Arrays, case: &str) -> MmmCondition {
        MmmCondition {
            codes_kd: self.codes.tensor(&self.device),
            text_bc: io.get(&format!("{case}/sentence")).tensor(&self.device),
            words_bnc: io.get(&format!("{case}/words")).tensor(&self.device),
            words: None,
        }
    }
}

fn load(config: &Value, weights: &Arrays, device: Device) -> Loaded {
    let sizes = MmmConfig {
        codes: size(config, "num_vq"),
        dim: size(config, "code_dim"),
        network: TokenNetwork {
            width: size(config, "embed_dim"),
            layers: size(config, "num_layers"),
            heads: size(config, "heads"),
            feed_forward: size(config, "fc_rate") * size(config, "embed_dim"),
            word_blocks: size(config, "num_local_layer"),
            ..TokenNetwork::default()
        },
        block: size(config, "block_size"),
        text_dim: size(config, "clip_dim"),
    };
    let network = filled(Mmm::new(&sizes, &mut draws(&device)), weights, "", &NOT_OURS);
    let codes = weights.get("trans_base.vqvae.vqvae.quantizer.codebook").clone();
    Loaded { network, sizes, codes, device }
}

#[test]
fn parity_mmm() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["05_mmm"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let mut gates = Gates::default();
        let plain = load(&config, &weights, device());
        for case in io.cases() {
            match case.as_str() {
                "vq" => {}
                "forward" => forward(&plain, &io, &mut gates),
                "inpaint" => inpaint(&plain, &config, &io, &mut gates),
                case if case.starts_with("train") => {
                    train(&load(&config, &weights, tracked()), case, &expected, &io, &mut gates);
                }
                case => sampled(&plain, case, &config, &expected, &io, &mut gates),
            }
        }
        gates.close(&name(&folder));
    }
}

fn forward(loaded: &Loaded, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("forward/{part}"));
    let ids = stored("ids").usizes();
    let visible: Vec<usize> = stored("token_len").usizes().iter().map(|len| len + 1).collect();
    let hidden: Vec<bool> = stored("text_visible").values.iter().map(|v| *v == 1.0).collect();
    let pass = |visible: Option<&[usize]>, text: Option<&[bool]>| {
        loaded.network.forward(&ids, &loaded.condition(io, "forward"), visible, text, &mut Dropout::off())
    };
    gates.tensor("logits", "forward", pass(Some(&visible), None), stored("logits"), FORWARD);
    let found = pass(Some(&visible), Some(&hidden));
    gates.tensor("logits", "text hidden", found, stored("logits_text_hidden_for_some"), FORWARD);
    gates.tensor("logits", "no key mask", pass(None, None), stored("logits_no_key_mask"), FORWARD);
}

fn train(loaded: &Loaded, case: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let lengths = stored("token_len").usizes();
    let kept = io.find(&format!("{case}/pkeep")).map_or(0.5, |stored| stored.values[0]);
    let example = |b: usize| {
        let keep: Vec<bool> = row(stored("keep_u"), b).values.iter().map(|u| *u < kept).collect();
        let (random, order) = (row(stored("rand_ids"), b).usizes(), row(stored("perm_u"), b).f32s());
        let share = stored("ratio_u").values[b] as f32;
        let draws = Corruption { share, keep: &keep, random: &random, order: &order };
        Example::new(&loaded.sizes, &row(stored("target"), b).usizes()[..lengths[b]], &draws)
    };
    let examples: Vec<Example> = (0..lengths.len()).map(example).collect();
    let input: Vec<usize> = examples.iter().flat_map(|e| e.input.clone()).collect();
    assert_eq!(input, stored("masked_input").usizes(), "{case}: what the network sees");
    let target: Vec<usize> = examples.iter().flat_map(|e| e.target.clone()).collect();
    assert_eq!(target, stored("target").usizes(), "{case}: targets");
    let visible: Vec<usize> = lengths.iter().map(|len| len + 1).collect();
    let condition = loaded.condition(io, case);
    let found = logits(&loaded.network, &condition, &input, Some(&visible), &mut Dropout::off());
    gates.tensor("logits", case, found.clone(), stored("logits"), FORWARD);
    let loss = loss(found, &examples) / examples.len() as f32;
    gates.check("loss", case, relative(scalar(&loss), number(&expected[format!("{case}/loss")])), LOSS);
    let entries = flat::layout(&loaded.network);
    let grads = gradients(&loaded.network, loss);
    let prefix = format!("{case}/grad");
    check_gradients(gates, &entries, &grads, &without(&expected[&prefix], &NOT_OURS), io, &prefix);
    let Some(changes) = expected.get(format!("{case}/adamw_change")).or_else(|| expected.get("adamw_change")) else {
        return;
    };
    if case != "train" {
        return;
    }
    let adam = AdamW { beta1: 0.5, beta2: 0.9, eps: 1e-8, weight_decay: 1e-6 };
    let before = flat::read(&loaded.network);
    let mut after = before.clone();
    let (mut m, mut v) = (vec![0.0; after.len()], vec![0.0; after.len()]);
    adam.step(1, 2e-4, &mut after, &grads, &mut m, &mut v);
    let change: Vec<f32> = after.iter().zip(&before).map(|(a, b)| a - b).collect();
    for (entry, values) in split(&entries, &change) {
        if let Some(wanted) = changes[&entry.name].as_f64() {
            gates.check("change", &entry.name, relative(global_norm(values), wanted), CHANGE);
        }
    }
}

/// Stored uniform draws [step, B, P, K]; a greedy case stores one value for all.
fn uniforms(stored: &Array) -> impl FnMut(usize, usize, usize, &mut [f32]) + '_ {
    move |step: usize, b: usize, p: usize, out: &mut [f32]| {
        let [_, batch, len, classes] = stored.shape[..] else { panic!("draws by step, clip, position and class") };
        if classes == 1 {
            out.fill(stored.values[step] as f32);
            return;
        }
        let at = ((step * batch + b) * len + p) * classes;
        out.iter_mut().zip(&stored.values[at..at + classes]).for_each(|(out, u)| *out = *u as f32);
    }
}

/// Runs the sampler and compares each step.
fn stepwise(
    loaded: &Loaded,
    case: &str,
    sampling: &Sampling,
    given: &[Vec<Option<usize>>],
    io: &Arrays,
    gates: &mut Gates,
) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let mut draws = uniforms(stored("gumbel_u"));
    let steps = stored("ids_in").shape[0];
    let mut taken = 0;
    let see = |step: &Step<'_>| {
        let what = format!("{case} step {taken}");
        let of = |part: &str| row(stored(part), taken);
        assert_eq!(step.seen, of("ids_in").usizes(), "{what}: what the network sees");
        let masked = |b: usize| {
            let positions = step.drawn.len() / given.len();
            step.drawn[b * positions..(b + 1) * positions].iter().flatten().count()
        };
        let counts: Vec<usize> = (0..given.len()).map(masked).collect();
        assert_eq!(counts, of("num_masked").usizes(), "{what}: how many are masked");
        let pred = of("pred");
        for (at, drawn) in step.drawn.iter().enumerate() {
            if let Some(id) = drawn {
                assert_eq!(*id as f64, pred.values[at], "{what}: draw at {at}");
            }
        }
        gates.check("scores", &*what, error(step.scores, &of("score").values), FORWARD);
        for (part, at) in [("logits_first", 0), ("logits_last", steps - 1)] {
            let wanted = stored(part);
            if at == taken {
                // In-painting stores no logits past the end of a clip.
                gates.check("logits", &*what, error(&step.logits[..wanted.values.len()], &wanted.values), FORWARD);
            }
        }
        taken += 1;
    };
    let condition = loaded.condition(io, case);
    let found = sample(&loaded.network, &loaded.sizes, sampling, &condition, given, &mut draws, see);
    assert_eq!(found, stored("ids").usizes(), "{case}: ids");
    assert_eq!(taken, steps, "{case}: steps");
}

fn sampled(loaded: &Loaded, case: &str, config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let settings = &config["samples"][case];
    let frames = io.get(&format!("{case}/frames")).usizes();
    let known = io.find(&format!("{case}/token_cond"));
    let clip = |(b, frames): (usize, &usize)| -> Vec<Option<usize>> {
        let token = |p: usize| {
            let id = known.map(|known| row(known, b).usizes()[p])?;
            (id != loaded.sizes.mask()).then_some(id)
        };
        (0..frames.div_ceil(4)).map(token).collect()
    };
    let given: Vec<_> = frames.iter().enumerate().map(clip).collect();
    let sampling = Sampling {
        steps: size(settings, "max_steps"),
        greedy: settings["rand_pos"] == Value::Bool(false),
        counts: Counts::Open,
        stops_alone: true,
    };
    let steps = io.get(&format!("{case}/ids_in")).shape[0];
    assert_eq!(Some(steps as u64), expected[format!("{case}/steps")].as_u64());
    stepwise(loaded, case, &sampling, &given, io, gates);
}

fn inpaint(loaded: &Loaded, config: &Value, io: &Arrays, gates: &mut Gates) {
    let known = |part: &str| io.get(&format!("inpaint/{part}")).usizes().into_iter().map(Some);
    let gap = std::iter::repeat_n(None, size(&config["inpaint"], "len"));
    let given = known("first_tokens").chain(gap).chain(known("last_tokens")).collect();
    let steps = io.get("inpaint/ids_in").shape[0];
    let sampling = Sampling { steps, greedy: false, counts: Counts::Whole, stops_alone: false };
    stepwise(loaded, "inpaint", &sampling, &[given], io, gates);
}
