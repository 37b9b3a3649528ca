//! An imported evaluator on real clips: the embeddings and metrics of `evaluate.t2m`.
//!
//! The fixtures (`04_evaluator_*`) store embeddings of their own motions and words, and distances, but none of real
//! clips. So there is a second implementation of the networks, in plain loops over f64. It is compared with the
//! fixtures. Then the stage's embeddings of the clips of `humanml3d-mini` are compared with it, and the stage's metrics
//! with recomputed ones.

use std::collections::BTreeMap;
use std::path::Path;

use checkpoint::Blobs as _;
use models::names;
use models::networks::{Evaluator, Init};
use motion::Skeleton;
use motion::dataset::{Dataset, Entry};
use nalgebra::DMatrix;
use protocol::message::StageTask;
use protocol::stage::{CheckpointPolicy, DataFormat, DataOpen, EvaluateT2m, ImportEvaluator, Split, StageSettings};
use protocol::{Digest, RunId, Seed, StageName};
use safetensors::SafeTensors;
use stage_lab::{Bench, MemoryAttempt};
use stages::artifacts;
use stages::context::{Outcome, Part};
use stages::kinds;
use stages::metrics::retrieval::in_groups;
use stages::parts::evaluator::TrainedEvaluator;
use stages::parts::word_vectors::Words;

#[path = "../../models/tests/common/mod.rs"]
mod fixtures;

use fixtures::{Array, Arrays, Gates, device, folders, name, shared};

/// Gate of one forward pass, from the fixtures' README.
const FORWARD: f64 = 3e-6;
/// Gate of a distance computed by the expanded square in f32, as in the fixtures.
const DISTANCE: f64 = 1e-5;
/// Gate of a metric of embeddings that differ by [`FORWARD`].
const METRIC: f64 = 1e-5;
/// Seed of the stages in this test.
const SEED: Seed = Seed(7);
/// Frames of a movement, and number of features that movements leave out.
const UNIT: usize = 4;
const CONTACTS: usize = 4;

/// Vectors in order of time.
type Rows = Vec<Vec<f64>>;

/// The evaluator's networks in plain loops.
struct Plain(Arrays);

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

fn leaky(rows: Rows) -> Rows {
    rows.into_iter().map(|row| row.into_iter().map(|v| if v < 0.0 { 0.2 * v } else { v }).collect()).collect()
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

impl Plain {
    /// A matrix times a vector, plus a bias.
    fn affine(&self, weight: &str, bias: &str, x: &[f64]) -> Vec<f64> {
        let (weight, bias) = (self.0.get(weight), self.0.get(bias));
        weight.values.chunks_exact(x.len()).zip(&bias.values).map(|(row, bias)| dot(row, x) + bias).collect()
    }

    fn linear(&self, layer: &str, rows: &Rows) -> Rows {
        rows.iter().map(|row| self.affine(&format!("{layer}.weight"), &format!("{layer}.bias"), row)).collect()
    }

    /// A convolution over four frames with stride 2 and one frame of zeros on either side.
    fn convolution(&self, layer: &str, rows: &Rows) -> Rows {
        let (weight, bias) = (self.0.get(&format!("{layer}.weight")), self.0.get(&format!("{layer}.bias")));
        let (inner, taps) = (weight.shape[1], weight.shape[2]);
        let at = |t: usize, out: usize| {
            let frames = (0..taps).filter_map(|k| Some((k, rows.get((2 * t + k).checked_sub(1)?)?)));
            let tap = |(k, row): (usize, &Vec<f64>)| -> f64 {
                let begin = out * inner * taps;
                (0..inner).map(|i| weight.values[begin + i * taps + k] * row[i]).sum()
            };
            bias.values[out] + frames.map(tap).sum::<f64>()
        };
        (0..rows.len() / 2).map(|t| (0..bias.values.len()).map(|out| at(t, out)).collect()).collect()
    }

    /// The last state of a GRU over `rows` in their order, which is that of the backward direction if `reverse`.
    fn state(&self, network: &str, rows: impl Iterator<Item = Vec<f64>>, reverse: bool) -> Vec<f64> {
        let end = if reverse { "_reverse" } else { "" };
        let gates = |what: &str, x: &[f64]| {
            let of = |part: &str| format!("{network}.gru.{part}_{what}_l0{end}");
            self.affine(&of("weight"), &of("bias"), x)
        };
        let hidden = self.0.get(&format!("{network}.hidden"));
        let width = hidden.shape[2];
        let mut state = hidden.values[usize::from(reverse) * width..][..width].to_vec();
        for row in rows {
            let (given, own) = (gates("ih", &row), gates("hh", &state));
            state = (0..width)
                .map(|i| {
                    let reset = sigmoid(given[i] + own[i]);
                    let kept = sigmoid(given[width + i] + own[width + i]);
                    let new = (given[2 * width + i] + reset * own[2 * width + i]).tanh();
                    (1.0 - kept) * new + kept * state[i]
                })
                .collect();
        }
        state
    }

    /// Embeds vectors.
    fn embedding(&self, network: &str, rows: &Rows) -> Vec<f64> {
        let rows = self.linear(&format!("{network}.input_emb"), rows);
        let mut both = self.state(network, rows.iter().cloned(), false);
        both.extend(self.state(network, rows.into_iter().rev(), true));
        let x = self.linear(&format!("{network}.output_net.0"), &vec![both]).remove(0);
        let n = x.len() as f64;
        let mean = x.iter().sum::<f64>() / n;
        let variance = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        let part = |what: &str| &self.0.get(&format!("{network}.output_net.1.{what}")).values;
        let scaled = x.iter().zip(part("weight")).zip(part("bias"));
        let normed = scaled.map(|((v, scale), shift)| (v - mean) / (variance + 1e-5).sqrt() * scale + shift).collect();
        self.linear(&format!("{network}.output_net.3"), &leaky(vec![normed])).remove(0)
    }

    /// Embeds a normalised motion; the first `length` frames are valid.
    fn motion(&self, rows: &[Vec<f64>], length: usize) -> Vec<f64> {
        let rows: Rows = rows.iter().map(|row| row[..row.len() - CONTACTS].to_vec()).collect();
        let x = leaky(self.convolution("movement_encoder.main.0", &rows));
        let x = leaky(self.convolution("movement_encoder.main.3", &x));
        let mut movements = self.linear("movement_encoder.out_net", &x);
        movements.truncate(length / UNIT);
        self.embedding("motion_encoder", &movements)
    }

    /// Embeds word vectors and their classes; the first `length` are valid.
    fn caption(&self, words: &[Vec<f64>], classes: &[Vec<f64>], length: usize) -> Vec<f64> {
        let places = self.linear("text_encoder.pos_emb", &classes[..length].to_vec());
        let sum = |(word, place): (&Vec<f64>, &Vec<f64>)| word.iter().zip(place).map(|(a, b)| a + b).collect();
        self.embedding("text_encoder", &words.iter().zip(&places).map(sum).collect())
    }
}

fn rows(values: &[f64], width: usize) -> Rows {
    values.chunks_exact(width).map(<[f64]>::to_vec).collect()
}

/// Row `b` of a batch [B, T, c].
fn rows_of(array: &Array, b: usize) -> Rows {
    rows(&fixtures::row(array, b).values, array.shape[2])
}

/// Imports the file of a fixture beside statistics, in the published layout.
fn import(bench: &mut Bench, fixture: &Path, format: DataFormat, [mean, std]: [&Path; 2]) -> Digest {
    let folder = tempfile::tempdir().expect("a test's own files");
    let (model, meta) = (folder.path().join("text_mot_match/model"), folder.path().join("Comp_v6_KLD01/meta"));
    [&model, &meta].into_iter().for_each(|folder| std::fs::create_dir_all(folder).expect("a test's own files"));
    for (from, to) in [
        (fixture.join("finest.tar"), model.join("finest.tar")),
        (mean.to_owned(), meta.join("mean.npy")),
        (std.to_owned(), meta.join("std.npy")),
    ] {
        std::fs::write(&to, std::fs::read(&from).expect("a file of the data")).expect("a test's own files");
    }
    let settings = ImportEvaluator { path: folder.path().display().to_string(), format, words: String::new() };
    bench.run("evaluator", &settings.into(), &[]).unwrap_or_else(|e| panic!("{e}")).output()
}

/// Writes statistics that normalise nothing to `folder`.
fn nothing(folder: &Path, features: usize) -> [std::path::PathBuf; 2] {
    [("mean.npy", 0.0), ("std.npy", 1.0)].map(|(name, value)| {
        let file = folder.join(name);
        motion::npy::write(&file, &[features], &vec![value; features]).expect("a test's own files");
        file
    })
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// The plain loops reproduce the fixtures, and the imported evaluator has the stored distances: matching score and
/// ranks.
#[test]
fn the_fixtures_numbers_come_out_of_plain_loops_and_of_what_is_imported() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["04_evaluator"]) {
        let (plain, io) =
            (Plain(Arrays::read(&folder.join("weights.safetensors"))), Arrays::read(&folder.join("io.safetensors")));
        let mut gates = Gates::default();
        let features = io.get("full/motions").shape[2];
        let formats = [DataFormat::Humanml3d, DataFormat::Kit];
        let format = formats.into_iter().find(|format| Skeleton::of(*format).features == features).expect("a format");
        let mut bench = Bench::new(device(), SEED.0, 1);
        let own = tempfile::tempdir().expect("a test's own files");
        let [mean, std] = nothing(own.path(), features);
        let imported = import(&mut bench, &folder, format, [&mean, &std]);
        let manifest = bench.manifest(imported).expect("stored");
        let trained = TrainedEvaluator::read(&*bench.blobs(), &manifest, &device()).expect("an evaluator");
        let device = device();
        let fresh = Evaluator::new(&trained.meta().config, &mut Init::blank(&device));
        let network = names::load(fresh, &trained.weights(), "").expect("its own weights");
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            let (lengths, words) = (stored("m_lens").usizes(), stored("cap_lens").usizes());
            let all = |one: &dyn Fn(usize) -> Vec<f64>| -> Vec<f32> {
                (0..lengths.len()).flat_map(one).map(|v| v as f32).collect()
            };
            let motions = all(&|b| plain.motion(&rows_of(stored("motions"), b), lengths[b]));
            let captions =
                all(&|b| plain.caption(&rows_of(stored("word_embs"), b), &rows_of(stored("pos_onehot"), b), words[b]));
            for (what, found, part) in [
                ("plain motion", motions, "motion_embedding_input_order"),
                ("plain text", captions, "text_embedding_input_order"),
            ] {
                gates.check(what, &*case, fixtures::error(&found, &stored(part).values), FORWARD);
            }

            let made = fixtures::values(network.motion(stored("motions").tensor(&device), &lengths));
            let told = network.text_encoder.forward(
                stored("word_embs").tensor(&device),
                stored("pos_onehot").tensor(&device),
                &words,
            );
            let (made, told) = (wide(&made), wide(&fixtures::values(told)));
            let found = in_groups(&told, &made, trained.width(), lengths.len());
            let distances = rows(&stored("euclidean_distance_text_motion_sorted").values, lengths.len());
            let own: Vec<f64> = distances.iter().enumerate().map(|(i, row)| row[i]).collect();
            let score = own.iter().sum::<f64>() / own.len() as f64;
            gates.check("matching score", &*case, fixtures::relative(found.matching_score, score), DISTANCE);
            for (k, top) in found.top.into_iter().enumerate() {
                let before = |(row, own): (&Vec<f64>, &f64)| row.iter().filter(|other| *other < own).count() <= k;
                let hits = distances.iter().zip(&own).filter(|pair| before(*pair)).count();
                gates.check("R-precision", &*case, (top - hits as f64 / own.len() as f64).abs(), 1e-12);
            }
        }
        gates.close(&name(&folder));
    }
}

/// The embeddings of a shard of the evaluation, by name, row by row.
fn shard(bench: &Bench, settings: &StageSettings, inputs: &BTreeMap<String, Digest>) -> BTreeMap<String, Vec<f32>> {
    let task = StageTask {
        run: RunId::new("test-1"),
        name: StageName::new("t2m"),
        settings: settings.clone(),
        inputs: inputs.clone(),
        seed: SEED,
        checkpoint: CheckpointPolicy::default(),
    };
    let mut cx = MemoryAttempt::new(task, bench.device(), bench.blobs());
    let outcome = kinds::run_part(&mut cx, Part::Shard { index: 0, of: 1 }).expect("it embeds");
    let Outcome::Finished { output, .. } = outcome else { panic!("nothing stops it") };
    let manifest = bench.manifest(output).expect("stored");
    let file = manifest.files.values().next().expect("a file");
    let bytes = bench.blobs().get(file.digest).expect("stored");
    let tensors = SafeTensors::deserialize(&bytes).expect("safetensors");
    let floats = |data: &[u8]| data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    tensors.iter().map(|(name, view)| (name.to_owned(), floats(view.data()))).collect()
}

/// Embeddings of all crops of an entry that the evaluation can draw: the largest number of movements or one less, from
/// any frame.
fn crops(plain: &Plain, dataset: &Dataset, entry: &Entry, [mean, std]: [&[f32]; 2]) -> Rows {
    let width = mean.len();
    let normalised: Rows = dataset
        .features(entry)
        .chunks_exact(width)
        .map(|row| row.iter().zip(mean).zip(std).map(|((v, mean), std)| f64::from((v - mean) / std)).collect())
        .collect();
    let longest = entry.len / UNIT * UNIT;
    let lengths = [longest, longest.saturating_sub(UNIT)].into_iter().filter(|length| *length > 0);
    let places = lengths.flat_map(|length| (0..=entry.len - length).map(move |start| (start, length)));
    places
        .map(|(start, length)| {
            // Padded with zeros as in the authors' loader; more than a movement of them changes nothing.
            let mut crop = normalised[start..start + length].to_vec();
            crop.resize(length + UNIT, vec![0.0; width]);
            plain.motion(&crop, length)
        })
        .collect()
}

/// The row of `candidates` nearest to `found`.
fn nearest(found: &[f32], candidates: Rows) -> Vec<f64> {
    let off = |row: &Vec<f64>| row.iter().zip(found).map(|(a, b)| (a - f64::from(*b)).abs()).fold(0.0, f64::max);
    candidates.into_iter().min_by(|a, b| off(a).total_cmp(&off(b))).expect("a candidate")
}

fn gaussian(rows: &Rows) -> (DMatrix<f64>, DMatrix<f64>) {
    let (n, width) = (rows.len(), rows[0].len());
    let all = DMatrix::from_fn(n, width, |i, j| rows[i][j]);
    let mean = DMatrix::from_fn(1, width, |_, j| all.column(j).mean());
    let centred = DMatrix::from_fn(n, width, |i, j| all[(i, j)] - mean[(0, j)]);
    (mean, centred.transpose() * centred / (n as f64 - 1.0))
}

/// FID, and the sum of all variances as its scale. The trace of the product's root is the sum of its eigenvalues'
/// roots.
fn fid(real: &Rows, made: &Rows) -> (f64, f64) {
    let ((a_mean, a), (b_mean, b)) = (gaussian(real), gaussian(made));
    let roots: f64 = (&a * &b).complex_eigenvalues().iter().map(|value| value.re.max(0.0).sqrt()).sum();
    ((a_mean - b_mean).norm_squared() + a.trace() + b.trace() - 2.0 * roots, a.trace() + b.trace())
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// `import.evaluator`, `data.open` and `evaluate.t2m` on the test clips, with one pool of all clips.
#[test]
fn the_evaluation_of_real_clips_agrees_with_plain_loops() {
    let (Some(parity), Some(clips)) = (shared("parity"), shared("humanml3d-mini")) else { return };
    let fixture = parity.join("04_evaluator_humanml");
    let mut bench = Bench::new(device(), SEED.0, 1);
    let imported =
        import(&mut bench, &fixture, DataFormat::Humanml3d, [&clips.join("Mean.npy"), &clips.join("Std.npy")]);
    let opened = DataOpen { path: clips.display().to_string(), format: DataFormat::Humanml3d };
    let data = bench.run("dataset", &opened.into(), &[]).unwrap_or_else(|e| panic!("{e}")).output();
    let dataset = artifacts::dataset(&*bench.blobs(), &bench.manifest(data).expect("stored")).expect("a dataset");
    let entries = dataset.entries_of(Split::Test);
    let n = entries.len();
    assert!(n >= 40, "{n} test clips");
    let inputs = [("dataset", data), ("evaluator", imported)];
    let settings = StageSettings::from(EvaluateT2m {
        real: true,
        repeats: 1,
        pools: vec![n],
        split: Split::Test,
        shards: 1,
        ..EvaluateT2m::default()
    });
    let ran = bench.run("t2m", &settings, &inputs).unwrap_or_else(|e| panic!("{e}"));
    let named = inputs.iter().map(|(field, digest)| ((*field).to_owned(), *digest)).collect();
    let embedded = shard(&bench, &settings, &named);

    let plain = Plain(Arrays::read(&fixture.join("weights.safetensors")));
    let manifest = bench.manifest(imported).expect("stored");
    let trained = TrainedEvaluator::read(&*bench.blobs(), &manifest, &device()).expect("an evaluator");
    let width = trained.width();
    let meta = trained.meta();
    let (mut text, mut made, mut real) = (Rows::new(), Rows::new(), Rows::new());
    for (i, entry) in entries.iter().map(|e| &dataset.entries[*e]).enumerate() {
        let row = |what: &str| &embedded[what][i * width..(i + 1) * width];
        let captions = entry.captions.iter().map(|caption| {
            let batch = Words::Hashed.batch([&dataset.captions[*caption]]);
            let (words, classes) = (rows(&wide(&batch.words), 300), rows(&wide(&batch.classes), 15));
            plain.caption(&words, &classes, batch.lengths[0])
        });
        text.push(nearest(row("text"), captions.collect()));
        let crops = crops(&plain, &dataset, entry, [&meta.mean, &meta.std]);
        made.push(nearest(row("made"), crops.clone()));
        real.push(nearest(row("real"), crops));
    }
    let mut gates = Gates::default();
    for (what, plain) in [("text", &text), ("made", &made), ("real", &real)] {
        assert_eq!(embedded[what].len(), n * width, "{what}");
        gates.check(what, format!("{n} embeddings"), fixtures::error(&embedded[what], &plain.concat()), FORWARD);
    }

    let metrics = ran.metrics();
    assert_eq!(metrics["samples"], n as f64);
    let own: Vec<f64> = text.iter().zip(&made).map(|(text, made)| distance(text, made)).collect();
    let mean = own.iter().sum::<f64>() / n as f64;
    gates.check("metrics", "MM-Dist", fixtures::relative(metrics["mm_dist"], mean), METRIC);
    let ranks = text.iter().zip(&own).map(|(text, own)| made.iter().filter(|m| distance(text, m) < *own).count());
    let ranks: Vec<usize> = ranks.collect();
    for k in 1..=3 {
        let hits = ranks.iter().filter(|rank| **rank < k).count();
        let found = metrics[&format!("r_precision_top{k}")];
        gates.check("metrics", format!("R-precision top {k}"), (found - hits as f64 / n as f64).abs(), 1e-12);
    }
    let (expected, variance) = fid(&real, &made);
    gates.check("metrics", "FID", (metrics["fid"] - expected).abs() / variance, METRIC);
    eprintln!("FID {expected:.3e} of variances {variance:.3e}, MM-Dist {mean:.4}, best ranks {:?}", &ranks[..8]);
    gates.close("evaluate.t2m on humanml3d-mini");
}
