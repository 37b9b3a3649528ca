//! Codebooks over several updates in a row (fixture `05_rvq_ema`): a single layer, repeated rows, MMM's rule, and the
//! residual stack with its gradient.

use std::borrow::Cow;

use burn::tensor::{Tensor, TensorData};
use models::quantizer::{Book, LayerPass, Pass, assign, candidates, noise_len, perplexity};
use serde_json::Value;

use crate::LOSS;
use crate::common::{Array, Arrays, Gates, device, error, folders, json, name, relative, row, shared, tracked, values};
use crate::networks::scalar;
use crate::tokenizer::{EMA, ids, number, size};

/// Gate of whole gradients.
const GRADIENT: f64 = 1e-4;

#[test]
fn parity_codebooks() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["05_rvq_ema"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();
        for case in io.cases() {
            if case == "rvq" {
                stack(&config, &expected, &io, &mut gates);
            } else {
                alone(&case, &config, &expected, &io, &mut gates);
            }
        }
        gates.close(&name(&folder));
    }
}

/// Rows [B T, d] of an array [B, d, T].
fn as_rows(x: &Array) -> Vec<f32> {
    values(x.tensor::<3>(&device()).swap_dims(1, 2))
}

/// An array [B, d, T] of rows [B T, d].
fn as_channels(rows: Vec<f32>, like: &Array) -> Tensor<3> {
    let [batch, dim, len] = [like.shape[0], like.shape[1], like.shape[2]];
    Tensor::<3>::from_data(TensorData::new(rows, [batch, len, dim]), &device()).swap_dims(1, 2)
}

struct State {
    codes: Vec<f32>,
    sums: Vec<f32>,
    counts: Vec<f32>,
    decay: f64,
}

impl State {
    fn start(codes: Vec<f32>, count: usize, decay: f64) -> Self {
        Self { sums: codes.clone(), counts: vec![1.0; count], codes, decay }
    }

    fn book(&mut self) -> Book<'_> {
        Book { codes: &mut self.codes, sums: &mut self.sums, counts: &mut self.counts, decay: self.decay }
    }
}

/// Replacement rows for codes: the first ones, or the first in a stored permutation.
fn replacements(io: &Arrays, case: &str, step: usize, rows: &[f32], count: usize, dim: usize) -> Vec<f32> {
    let picked = match io.find(&format!("{case}/permutation")) {
        None => rows.to_vec(),
        Some(all) => row(all, step).usizes().iter().flat_map(|i| rows[i * dim..(i + 1) * dim].to_vec()).collect(),
    };
    candidates(&picked, count, dim, |len| {
        let noise = row(io.get(&format!("{case}/noise_update")), step).f32s();
        assert_eq!(noise.len(), len, "as much noise as repeated rows");
        noise
    })
}

fn alone(case: &str, config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let (count, dim) = (size(config, "nb_code"), size(config, "code_dim"));
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let start = |part: &str| io.find(&format!("{case}/start_{part}")).map(Array::f32s);
    let mut state = match (start("codebook"), start("sum"), start("count")) {
        (Some(codes), Some(sums), Some(counts)) => Some(State { codes, sums, counts, decay: number(&config["mu"]) }),
        _ => None,
    };
    let (mut used, mut since) = (vec![0.0; count], 0.0);
    let remembers = io.find(&format!("{case}/usage_memory")).is_some();
    for step in 0..size(&config[case], "steps") {
        let what = format!("{case} step {step}");
        let x = row(stored("x"), step);
        let rows = as_rows(&x);
        gates.check("rows", &*what, error(&rows, &row(stored("rows"), step).values), EMA);
        let state = state.get_or_insert_with(|| {
            let first = candidates(&rows, count, dim, |len| {
                let noise = stored("noise_init").f32s();
                assert_eq!((noise.len(), len), (len, noise_len(rows.len(), count * dim)));
                noise
            });
            gates.check("after", format!("{case} start"), error(&first, &stored("codebook_after_init").values), EMA);
            State::start(first, count, number(&config["mu"]))
        });
        let codes = assign(&rows, &state.codes, dim, &device(), None);
        let taken: Vec<i64> = codes.iter().map(|code| *code as i64).collect();
        assert_eq!(taken, ids(&row(stored("indices"), step)), "{what}: ids");
        let found: Vec<f32> = codes.iter().flat_map(|c| state.codes[c * dim..(c + 1) * dim].to_vec()).collect();
        let commitment =
            rows.iter().zip(&found).map(|(r, c)| f64::from(r - c).powi(2)).sum::<f64>() / rows.len() as f64;
        let wanted = number(&expected[format!("{case}/commit_loss")][step]);
        gates.check("loss", &*what, relative(commitment, wanted), LOSS);
        gates.tensor("output", &*what, as_channels(found, &x), &row(stored("output"), step), EMA);
        let pass = LayerPass { rows: rows.clone(), codes };
        let (counts, sums) = pass.statistics(count, dim);
        let wanted = number(&expected[format!("{case}/perplexity")][step]);
        gates.check("perplexity", &*what, relative(perplexity(&counts), wanted), LOSS);
        gates.check("batch", &*what, error(&counts, &row(stored("batch_count"), step).values), EMA);
        gates.check("batch", &*what, error(&sums, &row(stored("batch_sum"), step).values), EMA);
        let rows = replacements(io, case, step, &rows, count, dim);
        let resets = if remembers {
            state.book().update_remembering(&sums, &counts, &rows, &mut used, &mut since)
        } else {
            state.book().update(&sums, &counts, &rows)
        };
        let wanted = number(&expected[format!("{case}/codes_reset_per_step")][step]);
        assert_eq!(resets as f64, wanted, "{what}: codes that were replaced");
        if remembers {
            gates.check("after", format!("{what} usage"), error(&used, &row(stored("usage_memory"), step).values), 0.0);
            assert_eq!(f64::from(since), stored("reset_counter").values[step], "{what}: updates since a look");
        }
        let after = [("codebook", &state.codes), ("code_sum", &state.sums), ("code_count", &state.counts)];
        for (name, found) in after {
            let wanted = row(stored(name), step);
            gates.check("after", format!("{what} {name}"), error(found, &wanted.values), EMA);
        }
    }
}

fn stack(config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let (count, dim) = (size(config, "nb_code"), size(config, "code_dim"));
    let (steps, layers) = (size(&config["rvq"], "steps"), size(&config["rvq"], "layers"));
    let stored = |part: &str| io.get(&format!("rvq/{part}"));
    let mut states: Vec<Option<State>> = (0..layers).map(|_| None).collect();
    for step in 0..steps {
        let what = format!("rvq step {step}");
        let last = config["rvq"]["force_drop"][step].as_i64().expect("a layer");
        let active = usize::try_from(last).map_or(layers, |last| last + 1);
        let x = row(stored("x"), step);
        let rows = as_rows(&x);
        let mut uniforms = |layer: usize, at: usize, out: &mut [f32]| {
            let draws = row(&row(stored("gumbel_u"), step), layer);
            out.iter_mut().zip(&draws.values[at * count..]).for_each(|(out, u)| *out = *u as f32);
        };
        let codebook = |layer: usize, rows: &[f32]| {
            let state = states[layer].get_or_insert_with(|| {
                let first = candidates(rows, count, dim, |_| unreachable!("enough rows"));
                let wanted = stored(&format!("codebook_after_init/{layer}"));
                gates.check("after", format!("rvq start {layer}"), error(&first, &wanted.values), EMA);
                State::start(first, count, number(&config["mu"]))
            });
            Cow::<[f32]>::Owned(state.codes.clone())
        };
        let pass = Pass::through(rows.clone(), dim, active, &device(), codebook, Some(&mut uniforms));
        assert_eq!(pass.ids(layers), ids(&row(stored("indices"), step)), "{what}: ids");

        let n = rows.len() / dim;
        let tracked = Tensor::<2>::from_data(TensorData::new(rows.clone(), [n, dim]), &tracked()).require_grad();
        let (quantised, commitment) = pass.straight_through(tracked.clone());
        let found = as_channels(values(quantised.clone()), &x);
        gates.tensor("output", &*what, found, &row(stored("output"), step), EMA);
        let commitment = commitment / (rows.len() * active) as f32;
        let wanted = number(&expected["rvq/commit_loss"][step]);
        gates.check("loss", &*what, relative(scalar(&commitment), wanted), LOSS);
        let back = as_rows(&row(stored("grad_output"), step));
        let back = Tensor::<2>::from_data(TensorData::new(back, [n, dim]), &tracked.device());
        let loss = (quantised * back).sum() + commitment * 0.02;
        let gradient = values(tracked.grad(&loss.backward()).expect("a gradient"));
        let wanted = row(stored("grad_input"), step);
        gates.tensor("gradient", &*what, as_channels(gradient, &x), &wanted, GRADIENT);

        let mut used = 0.0;
        for (q, layer) in pass.layers.iter().enumerate() {
            let what = format!("{what} layer {q}");
            let updated = stored(&format!("updated_steps/{q}")).usizes();
            let at = updated.iter().position(|s| *s == step).expect("an active layer is updated");
            let of = |part: &str| row(stored(&format!("{part}/{q}")), at);
            gates.check("rows", &*what, error(&layer.rows, &of("rows").values), EMA);
            let (counts, sums) = layer.statistics(count, dim);
            used += perplexity(&counts);
            gates.check("batch", &*what, error(&counts, &of("batch_count").values), EMA);
            gates.check("batch", &*what, error(&sums, &of("batch_sum").values), EMA);
            let replaced = candidates(&layer.rows, count, dim, |_| unreachable!("enough rows"));
            let state = states[q].as_mut().expect("an active layer has begun");
            state.book().update(&sums, &counts, &replaced);
            let after = [("codebook", &state.codes), ("code_sum", &state.sums), ("code_count", &state.counts)];
            for (name, found) in after {
                gates.check("after", format!("{what} {name}"), error(found, &of(name).values), EMA);
            }
        }
        let wanted = number(&expected["rvq/perplexity"][step]);
        gates.check("perplexity", &*what, relative(used / active as f64, wanted), LOSS);
    }
}
