//! The evaluator's stages: the same bytes for any division into shards, chance level where expected, and misfits
//! refused.

use std::collections::BTreeMap;
use std::path::Path;

use checkpoint::Blobs;
use checkpoint::model::{self, Parts};
use models::names::save;
use models::networks::{Denoiser, Init, Vae};
use motion::Dataset;
use motion::dataset::PackError;
use protocol::artifact::{FileEntry, Role};
use protocol::message::FailureClass;
use protocol::stage::Diffusion;
use protocol::stage::{
    Batch, DataFormat, DataSynthetic, EvaluateT2m, EvaluatorNetwork, Family, ImportEvaluator, LatentShape,
    MovementPhase, MultiModality, Network, Positions, Sampler, Split, StageSettings, TextEmbed, TrainEvaluator,
    TrainLength, Training,
};
use protocol::{ArtifactKind, Digest, Manifest, Seed, Steps};
use stage_lab::{Bench, Script};
use stages::artifacts::{self, DenoiserMeta, MODEL_FILE, VaeMeta, to_meta};
use stages::context::Outcome;
use stages::evaluation::REPORT_FILE;
use stages::parts::evaluator::{EvaluatorMeta, TrainedEvaluator};
use stages::parts::text;
use stages::parts::word_vectors::WordsMeta;

const LATENT: LatentShape = LatentShape { tokens: 2, dim: 4 };

fn bench(members: usize) -> Bench {
    Bench::new(burn::tensor::Device::flex(), 11, members)
}

fn dataset(bench: &mut Bench, clips: usize) -> Digest {
    let settings = DataSynthetic { clips, val: 0.1, test: 0.4, mirror: false };
    bench.run("dataset", &StageSettings::DataSynthetic(settings), &[]).expect("the stage runs").output()
}

/// An evaluator of widths 16 to 48.
fn settings(steps: u64, batch: Batch, width: usize) -> TrainEvaluator {
    TrainEvaluator {
        network: EvaluatorNetwork { movement: width, motion: width, text: width, embedding: width, dropout: 0.1 },
        movement: MovementPhase { until: 0.4, window: 24, batch: 0, ..MovementPhase::default() },
        training: Training { steps: Steps(steps), batch, lr: 1e-3, ..TrainEvaluator::default().training },
        ..TrainEvaluator::default()
    }
}

fn small() -> StageSettings {
    StageSettings::TrainEvaluator(settings(10, Batch { global: 12, slices: 4 }, 16))
}

#[test]
fn an_evaluator_is_the_same_bytes_with_any_members_and_after_any_stop() {
    let mut alone = bench(1);
    let data = dataset(&mut alone, 30);
    let expected = alone.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs");
    for name in ["loss", "reconstruction", "positive", "negative"] {
        assert!(expected.metrics()[name] > 0.0, "{name}: {:?}", expected.metrics());
    }

    let mut three = bench(3);
    assert_eq!(dataset(&mut three, 30), data);
    three.script = Script { lost: vec![(0, 3)], joins: vec![(5, 5)], ..Script::default() };
    let ran = three.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs");
    assert_eq!(ran.output(), expected.output(), "three members, of which the leader is lost and a fourth joins");

    // Stops inside the first phase, at its end, and inside the second.
    for stop in [1, 3, 6] {
        let mut cut = bench(2);
        dataset(&mut cut, 30);
        cut.script = Script { drain: Some(stop), ..Script::default() };
        let ran = cut.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs");
        assert_eq!(ran.outcome, Outcome::Yielded { at: stop + 1 });
        cut.script = Script::default();
        cut.members = 3;
        let ran = cut.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs");
        assert_eq!(ran.output(), expected.output(), "stopped after step {}", stop + 1);
    }
}

fn put(bench: &Bench, kind: ArtifactKind, meta: serde_json::Value, weights: Vec<u8>) -> Digest {
    let blobs = bench.blobs();
    let entry =
        FileEntry { bytes: weights.len() as u64, digest: blobs.put(weights).expect("stored"), chunks: Vec::new() };
    let mut manifest = Manifest::new(kind, meta);
    manifest.files.insert(MODEL_FILE.into(), entry);
    blobs.put(manifest.to_bytes()).expect("stored")
}

fn network() -> Network {
    Network { width: 16, layers: 3, heads: 2, feed_forward: 32, ..Network::default() }
}

fn untrained_vae(bench: &Bench) -> Digest {
    let device = bench.device();
    let meta = VaeMeta {
        format: DataFormat::Humanml3d,
        features: 263,
        latent: LATENT,
        network: network(),
        mean: vec![0.0; 263],
        std: vec![1.0; 263],
        projection: None,
    };
    let net = Vae::new(&meta.config(), &mut Init::new(Seed(1), "vae", Positions::Sinusoid, &device));
    put(bench, ArtifactKind::Vae, to_meta(&meta), save(&net))
}

/// An untrained model of a family.
fn untrained(bench: &Bench, family: Family) -> Digest {
    let text = text::built_in();
    bench.blobs().put(text.to_bytes()).expect("stored");
    let device = bench.device();
    let vae = untrained_vae(bench);
    let meta = DenoiserMeta {
        guidance_dim: if family == Family::Mld { 0 } else { 32 },
        family,
        latent: LATENT,
        network: network(),
        diffusion: Diffusion::default(),
        text_relu: false,
        text_dim: 768,
        fits: Parts::from([(Role::VAE, vae), (Role::TEXT, text.digest())]),
        projection: None,
        time_dim: None,
    };
    let net = Denoiser::new(&meta.config(), &mut Init::new(Seed(2), "denoiser", Positions::Uniform, &device));
    let denoiser = put(bench, ArtifactKind::Denoiser, to_meta(&meta), save(&net));
    let part = |digest| bench.manifest(digest).expect("stored");
    let parts = BTreeMap::from([(Role::DENOISER, part(denoiser)), (Role::VAE, part(vae)), (Role::TEXT, text)]);
    let model = model::assemble("latent-diffusion", DataFormat::Humanml3d, &parts).expect("they fit");
    bench.blobs().put(model.to_bytes()).expect("stored")
}

fn evaluate(shards: usize, of: EvaluateT2m) -> StageSettings {
    StageSettings::EvaluateT2m(EvaluateT2m { shards, ..of })
}

#[test]
fn t2m_is_the_same_however_the_motions_are_cut() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 100);
    let evaluator = bench.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs").output();
    let model = untrained(&bench, Family::Lcm { skip: 100, guidance: (0.5, 5.0) });
    let inputs = [("dataset", data), ("evaluator", evaluator), ("model", model)];
    let settings = EvaluateT2m {
        sampler: Sampler { steps: 2, guidance: 2.0, ..Sampler::default() },
        repeats: 3,
        multimodality: MultiModality { captions: 2, samples: 5, pairs: 3 },
        split: Split::Test,
        ..EvaluateT2m::default()
    };
    let mut reports = Vec::new();
    for shards in [1, 3, 8] {
        let ran = bench.run("eval", &evaluate(shards, settings.clone()), &inputs).expect("the stage runs");
        reports.push((ran.output(), ran.metrics().clone()));
    }
    assert_eq!(reports[0], reports[1]);
    assert_eq!(reports[0], reports[2]);
    let metrics = &reports[0].1;
    for name in [
        "fid",
        "r_precision_top1",
        "r_precision_top2",
        "r_precision_top3",
        "mm_dist",
        "diversity",
        "multimodality",
        "skating_ratio",
        "jerk",
        "penetration_mm",
        "bone_change_mm",
    ] {
        let (lower, mean, upper) =
            (metrics[&format!("{name}.lower")], metrics[name], metrics[&format!("{name}.upper")]);
        assert!(lower <= mean && mean <= upper && mean.is_finite() && mean >= 0.0, "{name}: {metrics:?}");
    }
    assert!(metrics["fid"] > 0.0 && metrics["multimodality"] > 0.0 && metrics["samples"] >= 40.0, "{metrics:?}");

    // The lineage names the inputs, the details the repeats of the interval.
    let manifest = bench.manifest(reports[0].0).unwrap();
    assert_eq!(manifest.meta["split"], "test");
    assert_eq!(manifest.meta["words"]["kind"], "hashed");
    assert_eq!(manifest.meta["evaluator"], serde_json::to_value(evaluator).unwrap());
    let report = artifacts::file(&*bench.blobs(), &manifest, REPORT_FILE).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
    assert_eq!(report["details"]["repeats"]["fid"].as_array().map(Vec::len), Some(3));
    assert!(report["details"]["note"].as_str().is_some_and(|note| note.contains("FID is taken of")), "{report}");
}

/// The metrics of `settings`, and the log.
fn measured(
    bench: &mut Bench,
    settings: &EvaluateT2m,
    inputs: &[(&str, Digest)],
) -> (BTreeMap<String, f64>, Vec<String>, serde_json::Value) {
    let cut: Vec<_> = [1, 3]
        .map(|shards| bench.run("eval", &evaluate(shards, settings.clone()), inputs).expect("the stage runs"))
        .into();
    assert_eq!(cut[0].output(), cut[1].output(), "however the motions are cut");
    let meta = bench.manifest(cut[0].output()).expect("stored").meta;
    (cut[0].metrics().clone(), cut[0].told.log.clone(), meta)
}

#[test]
fn pools_have_names_of_their_own_and_drop_last_leaves_out_what_fills_none() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 100);
    let evaluator = bench.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs").output();
    let inputs = [("dataset", data), ("evaluator", evaluator)];
    let entries = {
        let whole = artifacts::dataset(&*bench.blobs(), &bench.manifest(data).unwrap()).unwrap();
        whole.entries_of(Split::Test).len()
    };
    assert!(entries % 16 != 0 && entries > 32, "{entries} entries: nothing would be left out");
    let of = |pools: &[usize], drop_last| EvaluateT2m {
        real: true,
        split: Split::Test,
        repeats: 3,
        pools: pools.to_vec(),
        drop_last,
        ..EvaluateT2m::default()
    };
    let (both, log, meta) = measured(&mut bench, &of(&[16, 8], false), &inputs);
    assert_eq!(
        (&meta["pools"], log.iter().any(|line| line.contains("do not fill a pool"))),
        (&serde_json::json!([16, 8]), false)
    );
    let (eight, ..) = measured(&mut bench, &of(&[8], false), &inputs);
    for name in ["r_precision_top1", "r_precision_top2", "r_precision_top3", "mm_dist"] {
        for end in ["", ".lower", ".upper"] {
            assert_eq!(both[&format!("{name}_pool8{end}")], eight[&format!("{name}{end}")], "{name}{end}");
        }
    }
    assert!(both["r_precision_top3"] < both["r_precision_top3_pool8"], "among fewer it is easier: {both:?}");
    assert_eq!((both["fid"], both["diversity"], both["samples"]), (eight["fid"], eight["diversity"], entries as f64));

    let (dropped, log, _) = measured(&mut bench, &of(&[16, 8], true), &inputs);
    let left_out = entries % 16;
    assert_eq!(dropped["samples"], (entries - left_out) as f64);
    assert!(log.iter().any(|line| line.starts_with(&format!("{left_out} of {entries} entries"))), "{log:?}");
    assert_eq!(dropped["r_precision_top1"], both["r_precision_top1"], "retrieval always leaves them out");
    assert!(dropped["fid"] != both["fid"] && dropped["skating_ratio"] != both["skating_ratio"], "{dropped:?}");
    assert!(both["fid_halves"] > both["fid"], "other clips are further apart than other crops: {both:?}");
    // A pool of all entries leaves nothing over.
    let (whole, ..) = measured(&mut bench, &of(&[entries], false), &inputs);
    let (kept, ..) = measured(&mut bench, &of(&[entries], true), &inputs);
    assert_eq!(whole, kept);

    let refused = bench.run("eval", &evaluate(1, of(&[32, entries + 1], false)), &inputs).unwrap_err().to_string();
    assert!(refused.contains(&format!("pools of {}", entries + 1)) && refused.contains("smaller `pools`"), "{refused}");
}

#[test]
fn reconstructions_are_measured_against_what_they_are_of() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 100);
    let evaluator = bench.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs").output();
    let vae = untrained_vae(&bench);
    let common = EvaluateT2m { split: Split::Test, repeats: 2, ..EvaluateT2m::default() };
    let real = EvaluateT2m { real: true, ..common.clone() };
    let (real, ..) = measured(&mut bench, &real, &[("dataset", data), ("evaluator", evaluator)]);
    let of_vae = EvaluateT2m { vae: "vae".into(), ..common };
    let (found, _, meta) = measured(&mut bench, &of_vae, &[("dataset", data), ("evaluator", evaluator), ("vae", vae)]);
    assert!(found["fid"] > 2.0 * real["fid"], "an untrained VAE makes other motion: {found:?} against {real:?}");
    assert!(found["mm_dist"].is_finite() && !found.contains_key("multimodality"), "{found:?}");
    assert_eq!(
        (&meta["reconstructed"], &meta["real"], &meta["drawn"]),
        (&true.into(), &false.into(), &serde_json::Value::Null)
    );
}

#[test]
fn motions_are_as_long_as_an_estimator_draws_if_there_is_one() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 100);
    let evaluator = bench.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs").output();
    let text = StageSettings::TextEmbed(TextEmbed::default());
    let text = bench.run("text", &text, &[("dataset", data)]).expect("the stage runs").output();
    let batch = Batch { global: 4, slices: 2 };
    let training = Training { steps: Steps(3), batch, ..TrainLength::default().training };
    let length = StageSettings::TrainLength(TrainLength { training, ..TrainLength::default() });
    let length = bench.run("length", &length, &[("dataset", data), ("text", text)]).expect("the stage runs").output();
    let model = untrained(&bench, Family::Lcm { skip: 100, guidance: (0.5, 5.0) });
    let given = EvaluateT2m {
        sampler: Sampler { steps: 1, guidance: 2.0, ..Sampler::default() },
        repeats: 1,
        multimodality: MultiModality { captions: 2, samples: 4, pairs: 2 },
        split: Split::Test,
        ..EvaluateT2m::default()
    };
    let drawn = EvaluateT2m { length: "length".into(), ..given.clone() };
    let inputs = vec![("dataset", data), ("evaluator", evaluator), ("model", model)];
    let with = [&inputs[..], &[("length", length)]].concat();
    let (given, _, meta) = measured(&mut bench, &given, &inputs);
    assert_eq!(meta["drawn_lengths"], false);
    let (found, _, meta) = measured(&mut bench, &drawn, &with);
    assert_eq!(meta["drawn_lengths"], true);
    for name in ["fid", "mm_dist", "multimodality"] {
        assert!(found[name] != given[name] && found[name].is_finite(), "{name}: {found:?}");
    }

    let mut other = bench.manifest(length).expect("stored");
    other.meta["fits"]["text"] = serde_json::to_value(Digest::of(b"another encoder")).expect("a digest");
    let other = bench.blobs().put(other.to_bytes()).expect("stored");
    let with = [&inputs[..], &[("length", other)]].concat();
    let refused = bench.run("eval", &evaluate(1, drawn), &with).expect_err("another encoder");
    assert!(refused.to_string().contains("different text encoders"), "{refused}");
    assert_eq!(refused.class(), FailureClass::Input, "{refused}");
}

#[test]
fn real_motion_is_found_and_shuffled_captions_are_left_to_chance() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 240);
    let train = settings(400, Batch { global: 32, slices: 1 }, 48);
    let evaluator = bench.run("evaluator", &StageSettings::TrainEvaluator(train), &[("dataset", data)]).unwrap();
    println!("{:?}", evaluator.metrics());
    let inputs = [("dataset", data), ("evaluator", evaluator.output())];
    let real = EvaluateT2m { real: true, split: Split::Test, ..EvaluateT2m::default() };
    let shuffled = EvaluateT2m { shuffled: true, ..real.clone() };
    let mut run = |name: &str, settings| bench.run(name, &evaluate(4, settings), &inputs).unwrap().metrics().clone();
    let (real, shuffled) = (run("real", real), run("shuffled", shuffled));
    println!("real {real:?}\nshuffled {shuffled:?}");
    let chance = 3.0 / 32.0;
    assert!(real["r_precision_top3"] > 3.0 * chance, "{real:?}");
    assert!(real["r_precision_top1"] < real["r_precision_top3"]);
    // 20 repeats of 96 motions have a deviation of about .007.
    assert!((shuffled["r_precision_top3"] - chance).abs() < 0.03, "{shuffled:?}");
    assert_eq!(real["fid"], shuffled["fid"], "the motions are the same");
    assert!(real["mm_dist"] < shuffled["mm_dist"]);
}

/// A fixture's evaluator laid out as published.
fn published(fixture: &Path, file: &str, features: usize) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a test's own files");
    let model = dir.path().join("text_mot_match/model");
    let meta = dir.path().join("Comp_v6_KLD01/meta");
    std::fs::create_dir_all(&model).expect("a test's own files");
    std::fs::create_dir_all(&meta).expect("a test's own files");
    let bytes = std::fs::read(fixture.join(file)).expect("a test's own files");
    std::fs::write(model.join(file.replace("weights", "finest")), bytes).expect("a test's own files");
    for (name, value) in [("mean.npy", 0.25), ("std.npy", 0.5)] {
        motion::npy::write(&meta.join(name), &[features], &vec![value; features]).expect("a test's own files");
    }
    dir
}

#[test]
fn a_published_evaluator_is_read_from_its_pickle() {
    let Some(root) = fixtures::data("parity") else { return };
    for (fixture, format, features) in
        [("04_evaluator_humanml", DataFormat::Humanml3d, 263), ("04_evaluator_kit", DataFormat::Kit, 251)]
    {
        let mut bench = bench(1);
        let mut outputs = BTreeMap::new();
        for file in ["finest.tar", "weights.safetensors"] {
            let dir = published(&root.join(fixture), file, features);
            let path = dir.path().to_string_lossy().into_owned();
            let settings = ImportEvaluator { path, format, words: String::new() };
            let ran = bench.run("evaluator", &StageSettings::ImportEvaluator(settings), &[]);
            outputs.insert(file, ran.unwrap_or_else(|e| panic!("{fixture}/{file}: {e}")).output());
        }
        assert_eq!(outputs["finest.tar"], outputs["weights.safetensors"], "{fixture}: pickle and safetensors");
        let manifest = bench.manifest(outputs["finest.tar"]).unwrap();
        let trained = TrainedEvaluator::read(&*bench.blobs(), &manifest, &bench.device()).unwrap();
        assert_eq!((trained.meta().origin.as_str(), &trained.meta().words), ("imported", &WordsMeta::Hashed));
        assert_eq!(trained.meta().mean, vec![0.25; features]);
        // The values read equal those of the published file.
        let stored = std::fs::read(root.join(fixture).join("weights.safetensors")).unwrap();
        let (stored, ours) = (safetensors::SafeTensors::deserialize(&stored).unwrap(), trained.weights());
        let ours = safetensors::SafeTensors::deserialize(&ours).unwrap();
        assert_eq!(stored.names().len(), ours.names().len());
        for (name, view) in stored.iter() {
            assert_eq!(view.data(), ours.tensor(name).unwrap().data(), "{fixture}: {name}");
        }
        // The other skeleton's setting is refused, and so are missing statistics.
        let other = if format == DataFormat::Kit { DataFormat::Humanml3d } else { DataFormat::Kit };
        let dir = published(&root.join(fixture), "finest.tar", features);
        let path = dir.path().to_string_lossy().into_owned();
        let mut import = |format| {
            let settings = ImportEvaluator { path: path.clone(), format, words: String::new() };
            bench.run("evaluator", &StageSettings::ImportEvaluator(settings), &[]).map(|ran| ran.output())
        };
        let refused = import(other).unwrap_err();
        assert!(refused.to_string().contains("set `format`"), "{refused}");
        std::fs::remove_file(dir.path().join("Comp_v6_KLD01/meta/std.npy")).unwrap();
        let refused = import(format).unwrap_err();
        assert!(refused.to_string().contains("std.npy"), "{refused}");
    }
}

/// Stores a dataset that a test modified.
fn store(bench: &Bench, dataset: &Dataset, like: Digest) -> Digest {
    let blobs = bench.blobs();
    let mut manifest = Manifest::new(ArtifactKind::Dataset, bench.manifest(like).expect("a test's own files").meta);
    dataset
        .write_files::<PackError>(|name, bytes| {
            let entry =
                FileEntry { bytes: bytes.len() as u64, digest: blobs.put(bytes).expect("stored"), chunks: Vec::new() };
            manifest.files.insert(name, entry);
            Ok(())
        })
        .expect("a test's own files");
    blobs.put(manifest.to_bytes()).expect("stored")
}

#[test]
fn what_an_evaluator_does_not_fit_is_refused_with_the_reason() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 100);
    let evaluator = bench.run("evaluator", &small(), &[("dataset", data)]).expect("the stage runs").output();
    let whole = artifacts::dataset(&*bench.blobs(), &bench.manifest(data).unwrap()).unwrap();

    let changed = |change: &dyn Fn(&mut [f32])| {
        let mut changed = whole.clone();
        for clip in &mut changed.clips {
            let mut features = clip.features.to_vec();
            change(&mut features);
            clip.features = features.into();
        }
        changed
    };
    let normalised = changed(&|features| whole.normalise(features));
    let millimetres = changed(&|features| features.iter_mut().for_each(|v| *v *= 1000.0));
    let mut nothing = whole.clone();
    nothing.entries.retain(|entry| entry.split != motion::dataset::Split::Test);
    let few = EvaluateT2m { real: true, split: Split::Val, ..EvaluateT2m::default() };
    let test = EvaluateT2m { split: Split::Test, ..few.clone() };

    // An evaluator of the other skeleton: the same file, with another format in its meta.
    let mut manifest = bench.manifest(evaluator).unwrap();
    let mut meta: EvaluatorMeta = artifacts::meta(&manifest, "the evaluator").unwrap();
    meta.format = DataFormat::Kit;
    manifest.meta = to_meta(&meta);
    let kit = bench.blobs().put(manifest.to_bytes()).unwrap();

    for (data, evaluator, settings, reason) in [
        (store(&bench, &normalised, data), evaluator, &test, "do not have the evaluator's scale"),
        (store(&bench, &millimetres, data), evaluator, &test, "do not have the evaluator's scale"),
        (store(&bench, &nothing, data), evaluator, &test, "`test` has no entries"),
        (data, evaluator, &few, "needs pools of 32"),
        (data, kit, &test, "`kit` skeletons"),
        (data, data, &test, "is a dataset; expected"),
    ] {
        let inputs = [("dataset", data), ("evaluator", evaluator)];
        let refused = bench.run("eval", &evaluate(2, settings.clone()), &inputs).expect_err(reason);
        assert!(refused.to_string().contains(reason), "{refused}");
        assert!(!refused.to_string().contains("stage `"), "its caller names the stage: {refused}");
        assert_eq!(refused.class(), FailureClass::Input, "{refused}");
    }
    let inputs = [("dataset", data), ("evaluator", evaluator)];
    bench.run("eval", &evaluate(2, test), &inputs).expect("the data that it was trained on is fine");
    let all = EvaluateT2m { all_if_small: true, ..few };
    let ran = bench.run("eval", &evaluate(2, all), &inputs).expect("all clips stand in for a small split if asked for");
    assert_eq!(bench.manifest(ran.output()).unwrap().meta["split"], "all", "and the report says so");
}

/// A pickle of a dict from text to small numbers, protocol 3.
fn pickled(rows: &[(&str, u8)]) -> Vec<u8> {
    let mut bytes = vec![0x80, 3, b'}', b'('];
    for (word, row) in rows {
        bytes.push(b'X');
        bytes.extend(u32::try_from(word.len()).expect("a short word").to_le_bytes());
        bytes.extend(word.as_bytes());
        bytes.extend([b'K', *row]);
    }
    bytes.extend(*b"u.");
    bytes
}

#[test]
fn a_vocabulary_is_kept_with_the_evaluator_and_named() {
    let mut bench = bench(1);
    let data = dataset(&mut bench, 30);
    let dir = tempfile::tempdir().unwrap();
    let rows = [("sos", 0), ("eos", 1), ("unk", 2), ("walk", 3)];
    let vectors: Vec<f32> = (0..4 * 300).map(|i| (i as f32 * 0.37).sin()).collect();
    motion::npy::write(&dir.path().join("our_vab_data.npy"), &[4, 300], &vectors).unwrap();
    let index = dir.path().join("our_vab_idx.pkl");
    std::fs::write(&index, pickled(&rows)).unwrap();
    let StageSettings::TrainEvaluator(mut settings) = small() else { unreachable!() };
    settings.words = dir.path().to_string_lossy().into_owned();
    let settings = StageSettings::TrainEvaluator(settings);
    let ours = bench.run("evaluator", &settings, &[("dataset", data)]).expect("the stage runs").output();
    let hashed = bench.run("evaluator-2", &small(), &[("dataset", data)]).expect("the stage runs").output();
    let trained =
        |digest| TrainedEvaluator::read(&*bench.blobs(), &bench.manifest(digest).unwrap(), &bench.device()).unwrap();
    assert!(matches!(trained(ours).meta().words, WordsMeta::Vocabulary { words: 4, .. }));
    assert_eq!(trained(hashed).meta().words, WordsMeta::Hashed);

    std::fs::write(&index, pickled(&rows[..2])).unwrap();
    let refused = bench.run("evaluator-3", &settings, &[("dataset", data)]).unwrap_err().to_string();
    assert!(refused.contains("our_vab_idx.pkl") && refused.contains("`unk`"), "{refused}");
    std::fs::write(&index, pickled(&[("sos", 0), ("eos", 1), ("unk", 9)])).unwrap();
    let refused = bench.run("evaluator-3", &settings, &[("dataset", data)]).unwrap_err().to_string();
    // The word is out of the file, and so is not quoted.
    assert!(refused.contains("row 9") && refused.contains("4 rows"), "{refused}");
}
