//! Encoder, codes, decoder, losses with gradients and one training step of the tokenizers (fixtures `05_rvq_humanml`,
//! `05_t2mgpt_vqvae`, and the tokenizer of `05_mmm`).

use std::borrow::Cow;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::flat;
use models::kernels::Dropout;
use models::losses::Pointwise;
use models::networks::{Init, Tokenizer, TokenizerConfig};
use models::quantizer::{Book, Pass, candidates, look_up, perplexity};
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{DataFormat, Positions};
use serde_json::Value;

use crate::common::{Array, Arrays, Gates, device, error, folders, json, name, relative, shared, tracked, values};
use crate::networks::{check_gradients, gradients, scalar};
use crate::{FORWARD, LOSS};

/// Gate of codebooks, sums and counts after an update.
pub(crate) const EMA: f64 = 1e-5;

/// Loads the arrays under `prefix` into a module. Names that contain one of `skipped` are no parameters of ours.
pub(crate) fn filled<M: Module>(module: M, weights: &Arrays, prefix: &str, skipped: &[&str]) -> M {
    let entries = flat::layout(&module);
    let ours = |n: &&str| n.starts_with(prefix) && !skipped.iter().any(|part| n.contains(part));
    let names: Vec<&str> = weights.names().filter(ours).collect();
    let stored = entries.iter().flat_map(|entry| {
        let array = weights.get(&format!("{prefix}{}", entry.name));
        assert_eq!(array.shape, entry.shape, "{}", entry.name);
        array.f32s()
    });
    let stored: Vec<f32> = stored.collect();
    assert_eq!(names.len(), entries.len(), "as many parameters as stored: {names:?}");
    flat::write(module, &stored)
}

pub(crate) fn draws(device: &Device) -> Init<'_> {
    Init::new(Seed(1), "parity", Positions::Uniform, device)
}

pub(crate) fn size(config: &Value, key: &str) -> usize {
    config[key].as_u64().unwrap_or_else(|| panic!("`{key}` is a number")) as usize
}

pub(crate) fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

pub(crate) fn ids(array: &Array) -> Vec<i64> {
    array.values.iter().map(|v| *v as i64).collect()
}

/// A tokenizer with one codebook per layer.
struct Loaded {
    network: Tokenizer,
    books: Vec<Vec<f32>>,
    dim: usize,
    codes: usize,
    decay: f64,
    format: DataFormat,
}

fn load(config: &Value, weights: &Arrays, prefix: &str, device: &Device) -> Loaded {
    let features = weights.get(&format!("{prefix}encoder.model.0.weight")).shape[1];
    let format = [DataFormat::Humanml3d, DataFormat::Kit].into_iter().find(|f| Skeleton::of(*f).features == features);
    let or = |key: &str, other: usize| config[key].as_u64().map_or(other, |v| v as usize);
    let decay = config["mu"].as_f64().unwrap_or(0.99);
    let config = TokenizerConfig {
        features,
        dim: size(config, "code_dim"),
        width: config["vq_width"].as_u64().map_or_else(|| size(config, "width"), |w| w as usize),
        levels: or("down_t", 2),
        stride: or("stride_t", 2),
        depth: or("depth", 3),
        growth: or("dilation_growth_rate", 3),
    };
    let network = filled(Tokenizer::new(&config, &mut draws(device)), weights, prefix, &["quantizer."]);
    let single = weights.find(&format!("{prefix}quantizer.codebook"));
    let layers = (0..).map_while(|q| weights.find(&format!("{prefix}quantizer.layers.{q}.codebook")));
    let books: Vec<Vec<f32>> = single.into_iter().chain(layers).map(Array::f32s).collect();
    let codes = books[0].len() / config.dim;
    Loaded { network, codes, decay, books, dim: config.dim, format: format.expect("a format with these features") }
}

/// Converts rows [B n, d] to [B, d, n].
fn channels_first(rows: Vec<f32>, batch: usize, dim: usize) -> Tensor<3> {
    let n = rows.len() / dim / batch;
    Tensor::<3>::from_data(TensorData::new(rows, [batch, n, dim]), &device()).swap_dims(1, 2)
}

impl Loaded {
    fn rows(&self, motion: Tensor<3>) -> Tensor<2> {
        let encoded = self.network.encode(motion, &mut Dropout::off());
        let [batch, n, dim] = encoded.dims();
        encoded.reshape([batch * n, dim])
    }

    fn decode(&self, rows: Tensor<2>, batch: usize) -> Tensor<3> {
        let [all, dim] = rows.dims();
        self.network.decode(rows.reshape([batch, all / batch, dim]), &mut Dropout::off())
    }

    fn pass(&self, rows: &[f32]) -> Pass {
        let book = |layer: usize, _: &[f32]| Cow::<[f32]>::Borrowed(self.books[layer].as_slice());
        Pass::through(rows.to_vec(), self.dim, self.books.len(), &device(), book, None)
    }

    fn decode_ids(&self, ids: &[i64], layers: usize, batch: usize) -> Tensor<3> {
        let rows = look_up(ids, layers, &self.books, self.dim);
        let n = rows.len() / self.dim;
        self.decode(Tensor::from_data(TensorData::new(rows, [n, self.dim]), &device()), batch)
    }
}

#[test]
fn parity_tokenizers() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["05_rvq_humanml", "05_t2mgpt_vqvae", "05_mmm"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let end = "encoder.model.0.weight";
        let prefix = weights.names().find_map(|n| n.strip_suffix(end)).expect("a tokenizer").to_owned();
        let mut gates = Gates::default();
        let plain = load(&config, &weights, &prefix, &device());
        for case in io.cases() {
            if case == "vq" {
                mmm(&plain, &io, &mut gates);
            } else if io.find(&format!("{case}/code_idx")).is_some() {
                forward(&plain, &case, &expected, &io, &mut gates);
            } else if io.find(&format!("{case}/after/code_count")).is_some()
                || io.find(&format!("{case}/after/code_count/0")).is_some()
            {
                train(&load(&config, &weights, &prefix, &tracked()), &prefix, &case, &expected, &io, &mut gates);
            }
        }
        gates.close(&name(&folder));
    }
}

fn forward(loaded: &Loaded, case: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let motion = stored("motion").tensor::<3>(&device());
    let batch = motion.dims()[0];
    let rows = values(loaded.rows(motion));
    let (layers, dim) = (loaded.books.len(), loaded.dim);
    gates.tensor("encoded", case, channels_first(rows.clone(), batch, dim), stored("encoder_out"), FORWARD);
    let pass = loaded.pass(&rows);
    assert_eq!(pass.ids(layers), ids(stored("code_idx")), "{case}: ids");
    if let Some(all) = io.find(&format!("{case}/all_codes")) {
        for (q, layer) in pass.layers.iter().enumerate() {
            let found = layer.codes.iter().flat_map(|c| loaded.books[q][c * dim..(c + 1) * dim].to_vec()).collect();
            let wanted = crate::common::row(all, q);
            gates.tensor("codes", case, channels_first(found, batch, dim), &wanted, FORWARD);
        }
    }
    let count = rows.len() as f64;
    let (_, commitment) =
        pass.straight_through(Tensor::from_data(TensorData::new(rows.clone(), [rows.len() / dim, dim]), &device()));
    let commitment = scalar(&commitment) / count / layers as f64;
    gates.check("loss", case, relative(commitment, number(&expected[format!("{case}/commit_loss")])), LOSS);
    let used = |layer: &models::quantizer::LayerPass| perplexity(&layer.statistics(loaded.codes, dim).0);
    let found = pass.layers.iter().map(used).sum::<f64>() / layers as f64;
    gates.check("perplexity", case, relative(found, number(&expected[format!("{case}/perplexity")])), LOSS);
    let all = ids(stored("code_idx"));
    let decoded = loaded.decode_ids(&all, layers, batch);
    gates.tensor("decoded", case, decoded.clone(), stored("reconstruction"), FORWARD);
    if let Some(wanted) = io.find(&format!("{case}/decode_from_idx")) {
        gates.tensor("decoded", case, decoded, wanted, FORWARD);
        let first: Vec<i64> = all.chunks_exact(layers).flat_map(|ids| ids[..2].to_vec()).collect();
        gates.tensor("decoded", case, loaded.decode_ids(&first, 2, batch), stored("decode_first_2_layers"), FORWARD);
        let holes = loaded.decode_ids(&ids(stored("idx_with_minus_one")), layers, batch);
        gates.tensor("decoded", case, holes, stored("decode_with_minus_one"), FORWARD);
    } else {
        let one = &all[..all.len() / batch];
        let decoded = loaded.decode_ids(one, layers, 1);
        gates.tensor("decoded", case, decoded, stored("decode_first_clip_from_idx"), FORWARD);
    }
}

/// Checks loss, gradients and the codebooks' update in training mode.
fn train(loaded: &Loaded, prefix: &str, case: &str, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let device = tracked();
    let find = |part: &str| io.find(&format!("{case}/{part}"));
    let motion = find("motion").unwrap_or_else(|| io.get("train/motion")).tensor::<3>(&device);
    let [batch, frames, _] = motion.dims();
    let (dim, codes, all_layers) = (loaded.dim, loaded.codes, loaded.books.len());
    // The name of a single layer has no number at its end.
    let of = |part: &str, q: usize| find(&format!("{part}/{q}")).or_else(|| find(part).filter(|_| all_layers == 1));
    let rows = loaded.rows(motion.clone());
    let host = values(rows.clone());
    let given = of("before/code_count", 0).is_some();
    // Stored ids are negative for the layers that were left out.
    let active = find("indices")
        .map_or(all_layers, |indices| indices.values[..all_layers].iter().filter(|id| **id >= 0.0).count());
    let noise = |q: usize| find(&format!("tile_noise/{q}")).map(Array::f32s);
    let mut books = loaded.books.clone();
    let mut uniforms = |layer: usize, row: usize, out: &mut [f32]| {
        let stored = of("gumbel_u", layer).expect("draws for each active layer");
        out.iter_mut().zip(&stored.values[row * codes..]).for_each(|(out, u)| *out = *u as f32);
    };
    let drawn = of("gumbel_u", 0).is_some();
    let codebook = |layer: usize, rows: &[f32]| {
        if !given {
            // Each layer uses noise for its start, then for its update.
            books[layer] = candidates(rows, codes, dim, |_| noise(2 * layer).expect("noise on tiled rows"));
        }
        Cow::<[f32]>::Owned(books[layer].clone())
    };
    let pass = Pass::through(
        host.clone(),
        dim,
        active,
        &crate::common::device(),
        codebook,
        if drawn { Some(&mut uniforms) } else { None },
    );
    if let Some(indices) = find("indices") {
        assert_eq!(pass.ids(all_layers), ids(indices), "{case}: ids");
    }
    let (quantised, commitment) = pass.straight_through(rows);
    if let Some(wanted) = find("quantized") {
        gates.tensor("quantized", case, channels_first(values(quantised.clone()), batch, dim), wanted, FORWARD);
    }
    let decoded = loaded.decode(quantised, batch);
    gates.tensor("decoded", case, decoded.clone(), io.get(&format!("{case}/reconstruction")), FORWARD);
    let positions = Skeleton::of(loaded.format).layout().positions;
    let count = decoded.dims()[1].min(frames);
    let part = |x: &Tensor<3>, r: std::ops::Range<usize>| x.clone().slice([0..batch, 0..count, r]);
    let weights = models::losses::FrameWeights::plain(&vec![count; batch], count, &device);
    let compared = |range: std::ops::Range<usize>| {
        weights.compare(Pointwise::SmoothL1, part(&decoded, range.clone()), part(&motion, range)) / batch as f32
    };
    let width = decoded.dims()[2];
    let (rec, explicit) = (compared(0..width), compared(positions));
    let commit = commitment / (host.len() * active) as f32;
    let total = rec.clone() + explicit.clone() * 0.5 + commit.clone() * 0.02;
    let wanted = &expected[format!("{case}/loss")];
    let checks = [("rec", &rec), ("explicit", &explicit), ("commit", &commit), ("total", &total)];
    for (name, found) in checks {
        gates.check("loss", format!("{case}/{name}"), relative(scalar(found), number(&wanted[name])), LOSS);
    }
    let used: f64 = pass.layers.iter().map(|layer| perplexity(&layer.statistics(codes, dim).0)).sum();
    gates.check("perplexity", case, relative(used / active as f64, number(&wanted["perplexity"])), LOSS);

    let mut entries = flat::layout(&loaded.network);
    entries.iter_mut().for_each(|entry| entry.name = format!("{prefix}{}", entry.name));
    let grads = gradients(&loaded.network, total);
    check_gradients(gates, &entries, &grads, &expected[format!("{case}/grad")], io, &format!("{case}/grad"));

    for (q, layer) in pass.layers.iter().enumerate() {
        let (mut sums, mut counts) = match (of("before/code_sum", q), of("before/code_count", q)) {
            (Some(sums), Some(counts)) => (sums.f32s(), counts.f32s()),
            _ => (books[q].clone(), vec![1.0; codes]),
        };
        let (new_counts, new_sums) = layer.statistics(codes, dim);
        let rows = candidates(&layer.rows, codes, dim, |_| noise(2 * q + 1).expect("noise on tiled rows"));
        let mut book = Book { codes: &mut books[q], sums: &mut sums, counts: &mut counts, decay: loaded.decay };
        book.update(&new_sums, &new_counts, &rows);
        for (name, found) in [("codebook", &books[q]), ("code_sum", &sums), ("code_count", &counts)] {
            let wanted = of(&format!("after/{name}"), q).expect("the state after the step");
            gates.check("after", format!("{case}/{name}/{q}"), error(found, &wanted.values), EMA);
        }
    }
    for (q, book) in books.iter().enumerate().skip(active) {
        let wanted = of("after/codebook", q).expect("the state after the step");
        gates.check("after", format!("{case} idle {q}"), error(book, &wanted.values), EMA);
    }
}

fn mmm(loaded: &Loaded, io: &Arrays, gates: &mut Gates) {
    let motion = io.get("vq/motion").tensor::<3>(&device());
    let batch = motion.dims()[0];
    let rows = values(loaded.rows(motion));
    let wanted = io.get("vq/latent_before_quantiser");
    gates.tensor("encoded", "vq", channels_first(rows.clone(), batch, loaded.dim), wanted, FORWARD);
    assert_eq!(loaded.pass(&rows).ids(1), ids(io.get("vq/encoded_ids")), "vq: ids");
    let decoded = loaded.decode_ids(&ids(io.get("vq/ids")), 1, batch);
    gates.tensor("decoded", "vq", decoded, io.get("vq/decoded"), FORWARD);
}
