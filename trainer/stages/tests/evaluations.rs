//! Map stages on untrained networks: their outputs do not depend on the division into shards, and misfits are refused.

use std::collections::BTreeMap;
use std::rc::Rc;

use checkpoint::Blobs;
use checkpoint::model::{self, Parts};
use models::names::save;
use models::networks::{Denoiser, Init, Vae};
use protocol::artifact::{FileEntry, Role};
use protocol::stage::Diffusion;
use protocol::stage::{
    Activity, Batch, CheckpointPolicy, DataFormat, DataSynthetic, DrawMotions, EncodeLatents, EvaluateLatentFid,
    EvaluateRecognition, EvaluateReconstruction, EvaluateSpectrum, Family, Keep, LatentShape, Network, Positions,
    Sampler, Split, StageSettings, TextEmbed, TrainLength, TrainVae, Training,
};
use protocol::{ArtifactKind, Digest, Manifest, Seed, Steps};
use stage_lab::Bench;
use stages::artifacts::{self, DenoiserMeta, Latents, MODEL_FILE, VaeMeta, to_meta};
use stages::generate::Generator;
use stages::generate::generator::{self, Batch as Motions};
use stages::generate::timing::{Times, WARM_UP, sentences, time};
use stages::parts::text;

const LATENT: LatentShape = LatentShape { tokens: 2, dim: 4 };

fn network() -> Network {
    Network { width: 16, layers: 3, heads: 2, feed_forward: 32, ..Network::default() }
}

fn bench() -> Bench {
    Bench::new(burn::tensor::Device::flex(), 11, 1)
}

fn put(bench: &Bench, kind: ArtifactKind, meta: serde_json::Value, weights: Vec<u8>) -> Digest {
    let blobs = bench.blobs();
    let entry =
        FileEntry { bytes: weights.len() as u64, digest: blobs.put(weights).expect("stored"), chunks: Vec::new() };
    let mut manifest = Manifest::new(kind, meta);
    manifest.files.insert(MODEL_FILE.into(), entry);
    blobs.put(manifest.to_bytes()).expect("stored")
}

fn untrained_vae(bench: &Bench) -> Digest {
    vae_of(bench, 1.0)
}

fn other_vae(bench: &Bench) -> Digest {
    vae_of(bench, 2.0)
}

/// A VAE of features with this standard deviation.
fn vae_of(bench: &Bench, std: f32) -> Digest {
    let meta = VaeMeta {
        format: DataFormat::Humanml3d,
        features: 263,
        latent: LATENT,
        network: network(),
        mean: vec![0.0; 263],
        std: vec![std; 263],
        projection: None,
    };
    let device = bench.device();
    let vae = Vae::new(&meta.config(), &mut Init::new(Seed(1), "vae", Positions::Sinusoid, &device));
    put(bench, ArtifactKind::Vae, to_meta(&meta), save(&vae))
}

/// A model of latent diffusion.
fn untrained_model(bench: &Bench, vae: Digest, family: Family, latent: LatentShape) -> Digest {
    let text = text::built_in();
    bench.blobs().put(text.to_bytes()).expect("stored");
    let meta = DenoiserMeta {
        guidance_dim: if family == Family::Mld { 0 } else { 32 },
        family,
        latent,
        network: network(),
        diffusion: Diffusion::default(),
        text_relu: false,
        text_dim: 768,
        fits: Parts::from([(Role::VAE, vae), (Role::TEXT, text.digest())]),
        projection: None,
        time_dim: None,
    };
    let device = bench.device();
    let denoiser = Denoiser::new(&meta.config(), &mut Init::new(Seed(2), "denoiser", Positions::Uniform, &device));
    let denoiser = put(bench, ArtifactKind::Denoiser, to_meta(&meta), save(&denoiser));
    let part = |digest| bench.manifest(digest).expect("stored");
    let parts = BTreeMap::from([(Role::DENOISER, part(denoiser)), (Role::VAE, part(vae)), (Role::TEXT, text)]);
    let model = model::assemble("latent-diffusion", DataFormat::Humanml3d, &parts).expect("they fit");
    bench.blobs().put(model.to_bytes()).expect("stored")
}

fn untrained(bench: &Bench, vae: Digest, family: Family) -> Digest {
    untrained_model(bench, vae, family, LATENT)
}

/// Dataset and VAE.
fn data(bench: &mut Bench) -> (Digest, Digest) {
    let settings = DataSynthetic { clips: 40, val: 0.1, test: 0.2, mirror: false };
    let dataset = bench.run("dataset", &StageSettings::DataSynthetic(settings), &[]).expect("the stage runs").output();
    (dataset, untrained_vae(bench))
}

fn encode(bench: &mut Bench, shards: usize, dataset: Digest, vae: Digest) -> Digest {
    let settings = StageSettings::EncodeLatents(EncodeLatents { crops: 3, shards, ..EncodeLatents::default() });
    bench.run("latents", &settings, &[("dataset", dataset), ("vae", vae)]).expect("the stage runs").output()
}

#[test]
fn latents_are_the_same_bytes_however_the_entries_are_cut() {
    let mut bench = bench();
    let (dataset, vae) = data(&mut bench);
    let whole = encode(&mut bench, 1, dataset, vae);
    for shards in [2, 4, 7, 64] {
        assert_eq!(encode(&mut bench, shards, dataset, vae), whole, "{shards} shards");
    }
    let latents = Latents::read(&*bench.blobs(), &bench.manifest(whole).unwrap()).unwrap();
    assert_eq!(latents.mu.shape, [120, 2, 4]);
    assert_eq!(latents.meta.lengths.len(), 120);
    assert!(latents.meta.lengths.iter().all(|l| l % 4 == 0));
    assert!(latents.sigma.values.iter().all(|s| *s > 0.0));
    // Another stage name draws other crops.
    let settings = StageSettings::EncodeLatents(EncodeLatents { crops: 3, ..EncodeLatents::default() });
    let other =
        bench.run("latents-2", &settings, &[("dataset", dataset), ("vae", vae)]).expect("the stage runs").output();
    assert_ne!(other, whole);
}

#[test]
fn reconstruction_is_the_same_however_the_clips_are_cut() {
    let mut bench = bench();
    let (dataset, vae) = data(&mut bench);
    let mut reports = Vec::new();
    for shards in [1, 3, 50] {
        let settings = EvaluateReconstruction { shards, split: Split::All, ..EvaluateReconstruction::default() };
        let settings = StageSettings::EvaluateReconstruction(settings);
        let ran = bench.run("reconstruction", &settings, &[("dataset", dataset), ("vae", vae)]).unwrap();
        reports.push((ran.output(), ran.metrics().clone()));
    }
    assert_eq!(reports[0], reports[1]);
    assert_eq!(reports[0], reports[2]);
    let metrics = &reports[0].1;
    println!("{metrics:?}");
    assert_eq!(metrics["millimetres_per_unit"], 1000.0);
    for prefix in ["", "mu_", "clip_mean_"] {
        for name in [
            "mpjpe_mm",
            "pa_mpjpe_mm",
            "mpjpe_local_mm",
            "mpjpe_global_mm",
            "acceleration_mm",
            "feature_error",
            "feature_smooth_l1",
        ] {
            assert!(metrics[&format!("{prefix}{name}")] > 0.0, "{prefix}{name}");
        }
        let of = |name: &str| metrics[&format!("{prefix}{name}")];
        assert!(of("pa_mpjpe_mm") < of("mpjpe_global_mm"), "an alignment that makes worse: {metrics:?}");
        assert!((of("sjpe_noise") + of("sjpe_static") - of("sjpe")).abs() < 1e-12 && of("sjpe") <= 1.0, "{metrics:?}");
        assert!((0.0..=1.0).contains(&of("skating_ratio")));
    }
    assert!(metrics["clip_mean_sjpe_static"] > 0.9, "the held mean does not move its wrists: {metrics:?}");
    assert!(metrics["sjpe_noise"] > 0.5, "an untrained VAE shakes: {metrics:?}");
    assert!((0.0..0.2).contains(&metrics["real_skating_ratio"]), "synthetic clips hardly skate: {metrics:?}");
    assert!((0.2..0.6).contains(&metrics["real_still_ratio"]), "their feet stand still: {metrics:?}");
    assert!(metrics["clip_mean_mpjpe_mm"] < metrics["mpjpe_mm"], "an untrained VAE is no better than the clip's mean");
}

fn latent_fid(shards: usize, sampler: Sampler, teacher: bool) -> StageSettings {
    StageSettings::EvaluateLatentFid(EvaluateLatentFid {
        teacher: if teacher { "mld".into() } else { String::new() },
        sampler,
        repeats: 2,
        components: 4,
        split: Split::All,
        shards,
        ..EvaluateLatentFid::default()
    })
}

#[test]
fn latent_fid_is_the_same_however_the_samples_are_cut() {
    let mut bench = bench();
    let (dataset, vae) = data(&mut bench);
    let latents = encode(&mut bench, 2, dataset, vae);
    let guidance = (0.5, 5.0);
    let teacher = untrained(&bench, vae, Family::Mld);
    let lcm = untrained(&bench, vae, Family::Lcm { skip: 100, guidance });
    let pcm = untrained(&bench, vae, Family::Pcm { skip: 100, guidance, phases: 2 });
    for (model, steps) in [(teacher, 3), (lcm, 2), (pcm, 2)] {
        let inputs = [("model", model), ("latents", latents), ("dataset", dataset), ("teacher", teacher)];
        let sampler = Sampler { steps, guidance: 2.0, ..Sampler::default() };
        let mut reports = Vec::new();
        for shards in [1, 3, 8] {
            let ran = bench.run("eval", &latent_fid(shards, sampler.clone(), true), &inputs).unwrap();
            reports.push((ran.output(), ran.metrics().clone()));
        }
        println!("{:?}", reports[0].1);
        assert_eq!(reports[0], reports[1]);
        assert_eq!(reports[0], reports[2]);
        let metrics = &reports[0].1;
        for name in [
            "latent_fid",
            "latent_fid_sd",
            "latent_fid_floor",
            "latent_fid_halves",
            "latent_fid_train",
            "latent_fid_val_floor",
            "latent_fid_test",
            "latent_fid_test_sd",
            "latent_fid_test_floor",
            "latent_fid_test_halves",
            "latent_std",
            "latent_std_real",
            "match",
            "match_other_noise",
            "latent_r_precision_top1",
            "latent_r_precision_top3",
            "latent_r_precision_top3_test",
        ] {
            assert!(metrics.get(name).is_some_and(|v| v.is_finite() && *v >= 0.0), "{name}: {metrics:?}");
        }
    }
    let all = bench.run(
        "eval",
        &latent_fid(2, Sampler { steps: 1, guidance: 2.0, ..Sampler::default() }, false),
        &[("model", lcm), ("latents", latents), ("dataset", dataset)],
    );
    let all = all.unwrap().metrics().clone();
    assert!(all["latent_fid_test_floor"] < all["latent_fid_test_halves"], "the same clips are nearer: {all:?}");
    // The teacher's own 50 steps match themselves exactly.
    let inputs = [("model", teacher), ("latents", latents), ("dataset", dataset), ("teacher", teacher)];
    let own = Sampler { steps: 50, guidance: 2.0, ..Sampler::default() };
    let ran = bench.run("eval", &latent_fid(2, own.clone(), true), &inputs).unwrap();
    assert_eq!(ran.metrics()["match"], 0.0);
    let ran = bench.run("eval", &latent_fid(2, own, false), &inputs[..3]).unwrap();
    assert!(!ran.metrics().contains_key("match"));
}

#[test]
fn what_does_not_fit_is_refused_with_the_reason() {
    let mut bench = bench();
    let (dataset, vae) = data(&mut bench);
    let latents = encode(&mut bench, 2, dataset, vae);
    let other_shape = untrained_model(&bench, vae, Family::Mld, LatentShape { tokens: 3, dim: 4 });
    let other_vae = untrained(&bench, other_vae(&bench), Family::Mld);
    let good = untrained(&bench, vae, Family::Mld);
    let sampler = Sampler { steps: 3, guidance: 2.0, ..Sampler::default() };
    for (model, kind_of, reason) in [
        (other_shape, latents, "3x4"),
        (other_vae, latents, "is not the VAE of `latents`"),
        (good, dataset, "is a dataset; expected latents"),
    ] {
        let inputs = [("model", model), ("latents", kind_of), ("dataset", dataset)];
        let refused = bench.run("eval", &latent_fid(1, sampler.clone(), false), &inputs).unwrap_err();
        assert!(refused.to_string().contains(reason), "{refused}");
        assert_eq!(refused.class(), protocol::message::FailureClass::Input, "{refused}");
    }
    let mut manifest = bench.manifest(vae).unwrap();
    manifest.files = BTreeMap::new();
    let empty = bench.blobs().put(manifest.to_bytes()).unwrap();
    let settings = StageSettings::EncodeLatents(EncodeLatents::default());
    let refused = bench.run("latents", &settings, &[("dataset", dataset), ("vae", empty)]).unwrap_err().to_string();
    assert!(refused.contains(MODEL_FILE), "{refused}");
}

#[test]
fn an_empty_split_is_refused_by_its_name() {
    let mut bench = bench();
    let settings = DataSynthetic { clips: 12, val: 0.0, test: 0.25, mirror: false };
    let dataset = bench.run("dataset", &StageSettings::DataSynthetic(settings), &[]).expect("the stage runs").output();
    let vae = untrained_vae(&bench);
    let latents = encode(&mut bench, 1, dataset, vae);
    let model = untrained(&bench, vae, Family::Mld);
    let reconstruction = EvaluateReconstruction { split: Split::Val, ..EvaluateReconstruction::default() };
    let sampler = Sampler { steps: 1, guidance: 2.0, ..Sampler::default() };
    let StageSettings::EvaluateLatentFid(fid) = latent_fid(1, sampler, false) else { unreachable!() };
    let fid = EvaluateLatentFid { split: Split::Val, ..fid };
    let inputs = [("dataset", dataset), ("vae", vae), ("model", model), ("latents", latents)];
    for settings in [StageSettings::EvaluateReconstruction(reconstruction), StageSettings::EvaluateLatentFid(fid)] {
        let refused = bench.run("eval", &settings, &inputs).unwrap_err();
        assert!(refused.to_string().contains("the split `val` has no entries; set `split`"), "{refused}");
        assert!(!refused.to_string().contains("stage `"), "its caller names the stage: {refused}");
        assert_eq!(refused.class(), protocol::message::FailureClass::Input, "{refused}");
    }
}

#[test]
fn a_metric_to_keep_checkpoints_by_that_is_not_saved_is_refused_before_a_step() {
    let mut bench = bench();
    let (dataset, _) = data(&mut bench);
    let batch = Batch { global: 4, slices: 2 };
    let training = Training { steps: Steps(3), batch, warmup: Steps(0), ..TrainVae::default().training };
    let vae = TrainVae { latent: LATENT, network: network(), training, ..TrainVae::default() };
    let vae = StageSettings::TrainVae(vae);
    let keep = Keep { best: 1, metric: "fid".into(), ..Keep::default() };
    bench.checkpoint = CheckpointPolicy { every: Steps(1), keep: keep.clone() };
    let refused = bench.run("vae", &vae, &[("dataset", dataset)]).expect_err("no such metric");
    assert_eq!(refused.class(), protocol::message::FailureClass::Input, "{refused}");
    let refused = refused.to_string();
    for part in ["`checkpoint.keep.metric` is `fid`", "loss", "joint", "gradient_norm", "lr"] {
        assert!(refused.contains(part), "`{part}` is missing: {refused}");
    }
    assert!(bench.checkpoints("vae").is_empty(), "nothing was saved, so nothing can be lost");
    bench.checkpoint.keep = Keep { metric: "joint".into(), ..keep };
    bench.run("vae", &vae, &[("dataset", dataset)]).expect("`joint` is saved");
    assert_eq!(bench.checkpoints("vae").len(), 3);
}

#[test]
fn a_model_generates_as_it_was_measured_and_repeats_itself() {
    let bench = bench();
    let vae = untrained_vae(&bench);
    let family = Family::Pcm { skip: 100, guidance: (0.5, 5.0), phases: 2 };
    let pcm = untrained(&bench, vae, family);
    let manifest = |digest| bench.manifest(digest).unwrap();
    let load = |model: &Manifest| Generator::load(model, &*bench.blobs(), &bench.device());
    let generator = load(&manifest(pcm)).expect("it loads");
    assert_eq!(generator.sampler(), Sampler { steps: 2, guidance: 2.0, ..Sampler::default() }, "nobody measured it");
    // After an evaluation the model uses that sampler, and so generates other motions.
    let teacher = manifest(untrained(&bench, vae, Family::Mld));
    let measured = Sampler { steps: 2, guidance: 4.5, ..Sampler::default() };
    let registered = model::extend(&teacher, Some(&measured), &BTreeMap::new()).expect("it is a model");
    let (teacher, registered) = (load(&teacher).expect("it loads"), load(&registered).expect("it loads"));
    assert_eq!((teacher.sampler().steps, registered.sampler()), (50, measured.clone()));
    let drawn = |generator: &Generator, sampler| {
        generator.generate("a jump", Some(40), sampler, Seed(3)).expect("a motion").features
    };
    assert!(drawn(&registered, None) == drawn(&teacher, Some(&measured)));
    assert!(drawn(&registered, None) != drawn(&teacher, None));
    let prompt = "a person walks in a circle";
    let first = generator.generate(prompt, None, None, Seed(1)).expect("a motion");
    assert_eq!((first.frames, first.features.len(), first.joints.len()), (120, 120 * 263, 120 * 22 * 3));
    let again = generator.generate(prompt, None, None, Seed(1)).expect("a motion");
    assert_eq!((&first.features, &first.joints), (&again.features, &again.joints));
    let other = generator.generate(prompt, Some(40), None, Seed(2)).expect("a motion");
    assert_eq!(other.frames, 40);
    assert_ne!(first.features[..40 * 263], other.features[..]);
    let refused = generator.generate(prompt, Some(5000), None, Seed(1)).expect_err("too long").to_string();
    assert!(refused.contains("5000 frames"), "{refused}");
    let sampler = Sampler { steps: 1, guidance: 2.0, ..Sampler::default() };
    let refused = generator.generate(prompt, None, Some(&sampler), Seed(1)).expect_err("other phases").to_string();
    assert!(refused.contains("2 phases"), "{refused}");
    let meta: VaeMeta = artifacts::meta(&manifest(vae), "the VAE").unwrap();
    assert_eq!(generator.format(), meta.format);

    // Timed against itself: a time for every sentence and model; the warm-up runs and is not counted.
    let own = &generator.sampler();
    let mut motions = 0;
    let times = time(&[(&generator, own), (&generator, own)], &sentences(4), Some(40), &mut || motions += 1).unwrap();
    assert_eq!(times.iter().map(Vec::len).collect::<Vec<_>>(), [4, 4]);
    assert_eq!(motions, 2 * (4 + WARM_UP));
    let times = Times::of(&times[0]).expect("four sentences");
    assert!(times.sampling > 0.0 && times.decoding > 0.0 && times.median <= times.p95, "{times:?}");
    assert!((times.text + times.sampling + times.decoding - times.mean).abs() < 1e-9, "{times:?}");
    let refused = time(&[(&generator, &sampler)], &sentences(1), None, &mut || ()).expect_err("other phases");
    assert!(refused.to_string().contains("2 phases"), "{refused}");
}

#[test]
fn a_model_with_a_length_estimator_says_how_long_a_motion_is() {
    let mut bench = bench();
    let (dataset, vae) = data(&mut bench);
    let text = StageSettings::TextEmbed(TextEmbed::default());
    let text = bench.run("text", &text, &[("dataset", dataset)]).expect("the stage runs").output();
    let batch = Batch { global: 4, slices: 2 };
    let training = Training { steps: Steps(3), batch, ..TrainLength::default().training };
    let settings = StageSettings::TrainLength(TrainLength { training, ..TrainLength::default() });
    let length = bench.run("length", &settings, &[("dataset", dataset), ("text", text)]).expect("the stage runs");
    let part = bench.manifest(length.output()).expect("stored");
    let model = bench.manifest(untrained(&bench, vae, Family::Mld)).expect("stored");
    let load = |model: &Manifest| Generator::load(model, &*bench.blobs(), &bench.device()).expect("it loads");
    let with = |part: &Manifest| model::extend(&model, None, &BTreeMap::from([(Role::LENGTH, part.clone())]));
    let (without, with_it) = (load(&model), load(&with(&part).expect("they fit")));
    let frames = |generator: &Generator, seed| generator.frames("a person walks", Seed(seed)).expect("a length");
    assert_eq!((0..8).map(|seed| frames(&without, seed)).collect::<Vec<_>>(), [120; 8]);
    let drawn: Vec<usize> = (0..8).map(|seed| frames(&with_it, seed)).collect();
    assert!(drawn.iter().all(|frames| (4..=196).contains(frames) && frames % 4 == 0), "{drawn:?}");
    assert!(drawn.iter().any(|frames| *frames != drawn[0]), "one seed is like another: {drawn:?}");
    let sampler = Sampler { steps: 1, guidance: 2.0, ..Sampler::default() };
    let motion = with_it.generate("a person walks", None, Some(&sampler), Seed(1)).expect("a motion");
    assert_eq!(motion.frames, drawn[1]);
    let motion = with_it.generate("a person walks", Some(40), Some(&sampler), Seed(1)).expect("a motion");
    assert_eq!(motion.frames, 40, "a length that is asked for counts");

    let mut other = part;
    other.meta["fits"]["text"] = serde_json::to_value(Digest::of(b"another encoder")).expect("a digest");
    let refused = with(&other).expect_err("another encoder").to_string();
    assert!(refused.contains("`length` was trained with the `text`"), "{refused}");
}

/// A student's prediction in its last step equals the generated motion, and all steps of a teacher are reported.
#[test]
fn each_step_of_the_sampler_is_seen_down_to_the_motion_that_is_drawn() {
    let bench = bench();
    let vae = untrained_vae(&bench);
    let lcm = || Family::Lcm { skip: 100, guidance: (0.5, 5.0) };
    for (family, steps, exact) in [(lcm(), 1, true), (lcm(), 4, true), (Family::Mld, 5, false)] {
        let manifest = bench.manifest(untrained(&bench, vae, family.clone())).expect("stored");
        let model = generator::open(&manifest, &*bench.blobs(), &bench.device()).expect("it opens");
        let sampler = Sampler { steps, guidance: 2.0, ..Sampler::default() };
        let texts: Vec<_> = model.embed(&["a jump"]).expect("built in").into_iter().map(Rc::new).collect();
        let seeds = |k: usize, i: usize| motion::Stream::new(Seed(5), "spectrum", k as u64, i as u64);
        let batch = Motions { texts: &texts, lengths: &[44], seeds: &seeds, control: None };
        let seen = model.predictions(batch, &sampler).expect("it denoises");
        let drawn = generator::motions(&*model, batch, &sampler, &mut |_| ()).expect("a motion").concat();
        assert_eq!(seen.len(), steps, "{family:?}");
        assert!(seen.windows(2).all(|pair| pair[0].0 > pair[1].0), "timesteps fall");
        assert!(seen.iter().all(|(_, motion)| motion.len() == drawn.len()));
        let (_, last) = seen.last().expect("a step");
        assert_eq!(*last == drawn, exact, "{family:?}: DDIM of a teacher ends a step above the data");
    }
}

#[test]
fn energy_by_band_is_measured_in_every_step() {
    let mut bench = bench();
    let (dataset, vae) = data(&mut bench);
    let model = untrained(&bench, vae, Family::Mld);
    let settings = EvaluateSpectrum {
        bands: vec![0.5, 2.0],
        sampler: Sampler { steps: 3, guidance: 2.0, ..Sampler::default() },
        motions: 3,
        split: Split::Test,
        ..EvaluateSpectrum::default()
    };
    let inputs = [("dataset", dataset), ("model", model)];
    let ran = bench.run("spectrum", &settings.clone().into(), &inputs).expect("the stage runs");
    let metrics = ran.metrics();
    assert_eq!(metrics.len(), 2 * 3 * 3, "two values, three bands, three steps: {metrics:?}");
    for band in 1..=3 {
        assert!(metrics[&format!("energy/{band}/1")] >= 0.0);
        assert_eq!(metrics[&format!("settled/{band}/3")], 1.0, "the last step is what the others are compared with");
        assert!(metrics[&format!("settled/{band}/1")] < 1.0);
    }
    let again = bench.run("spectrum", &settings.clone().into(), &inputs).expect("the stage runs");
    assert_eq!(ran.output(), again.output());
    let other = EvaluateSpectrum { motions: 2, ..settings };
    let other = bench.run("spectrum", &other.into(), &inputs).expect("the stage runs");
    assert_ne!(other.metrics(), metrics);
}

#[test]
fn real_clips_are_recognised_and_those_of_an_untrained_model_are_not() {
    let mut bench = bench();
    let settings = DataSynthetic { clips: 120, val: 0.1, test: 0.3, mirror: false };
    let dataset = bench.run("dataset", &StageSettings::DataSynthetic(settings), &[]).expect("the stage runs").output();
    let vae = untrained_vae(&bench);
    let model = untrained(&bench, vae, Family::Mld);
    let activity = |name: &str, words: &[&str]| Activity {
        name: name.into(),
        words: words.iter().map(|w| (*w).to_owned()).collect(),
        sheet: name == "sit",
    };
    let settings = EvaluateRecognition {
        activities: vec![
            activity("crawl", &["crawls", "crawling"]),
            activity("sit", &["sits", "sitting"]),
            activity("run", &["runs", "running", "jogs"]),
        ],
        sampler: Sampler { steps: 2, guidance: 1.0, ..Sampler::default() },
        motions: 9,
        ..EvaluateRecognition::default()
    };
    let inputs = [("dataset", dataset), ("model", model)];
    let ran = bench.run("recognised", &settings.clone().into(), &inputs).expect("the stage runs");
    let metrics = ran.metrics();
    assert_eq!(metrics["real_accuracy"], 1.0, "{metrics:?}");
    assert!(metrics["reconstructed_accuracy"] < 1.0, "an untrained VAE keeps not every activity: {metrics:?}");
    assert!(metrics["accuracy"] <= 0.5, "an untrained model draws one and the same: {metrics:?}");
    assert!(metrics.contains_key("accuracy/run") && metrics["real_skating_ratio"] < 0.2, "{metrics:?}");
    let manifest = bench.manifest(ran.output()).expect("stored");
    let sheet = artifacts::file(&*bench.blobs(), &manifest, "contact-sheet.png").expect("a sheet");
    assert!(sheet.starts_with(b"\x89PNG"));
    let again = bench.run("recognised", &settings.clone().into(), &inputs).expect("the stage runs");
    assert_eq!(ran.output(), again.output());
    let mut other = settings;
    other.activities.push(activity("fly", &["flies"]));
    let refused = bench.run("recognised", &other.into(), &inputs).expect_err("nobody flies").to_string();
    assert!(refused.contains("no clip of the split `train` shows `fly`"), "{refused}");
}

#[test]
fn sentences_are_drawn_in_the_viewers_form_and_by_the_seed_alone() {
    let mut bench = bench();
    let vae = untrained_vae(&bench);
    let model = untrained(&bench, vae, Family::Mld);
    let settings = DrawMotions {
        sentences: vec!["a person walks".into(), "a person jumps".into()],
        seconds: 2.5,
        seed: Seed(4),
        steps: 2,
        ..DrawMotions::default()
    };
    let inputs = [("model", model)];
    let ran = bench.run("drawn", &settings.clone().into(), &inputs).expect("the stage runs");
    assert!((0.0..=1.0).contains(&ran.metrics()["skating_ratio"]), "{:?}", ran.metrics());
    let manifest = bench.manifest(ran.output()).expect("stored");
    let motions = artifacts::file(&*bench.blobs(), &manifest, "motions.json").expect("motions");
    let motions: serde_json::Value = serde_json::from_slice(&motions).expect("JSON");
    assert_eq!(motions["captions"], serde_json::json!(settings.sentences));
    assert_eq!(motions["bodies"].as_array().map(Vec::len), Some(1));
    let drawn = motions["motions"].as_array().expect("a list");
    assert_eq!(drawn.iter().map(|motion| motion["frames"].as_u64()).collect::<Vec<_>>(), [Some(50), Some(50)]);
    // Neither the stage's name nor the pipeline's seed changes what is drawn.
    let mut again = Bench::new(burn::tensor::Device::flex(), 12, 1);
    let vae = untrained_vae(&again);
    let same = untrained(&again, vae, Family::Mld);
    let other = again.run("other", &settings.clone().into(), &[("model", same)]).expect("the stage runs");
    assert_eq!(ran.output(), other.output());
    let seed = DrawMotions { seed: Seed(5), ..settings.clone() };
    let seeded = bench.run("drawn", &seed.into(), &inputs).expect("the stage runs");
    assert_ne!(ran.output(), seeded.output());
    let long = DrawMotions { seconds: 60.0, ..settings.clone() };
    let refused = bench.run("drawn", &long.into(), &inputs).expect_err("too long").to_string();
    assert!(refused.contains("`seconds` is 60; the model draws 0.05 to"), "{refused}");

    // Several motions of one sentence have consecutive seeds and one length, which is the model's without `seconds`.
    let several = DrawMotions { count: 2, seconds: 0.0, ..settings.clone() };
    let ran = bench.run("drawn", &several.into(), &inputs).expect("the stage runs");
    let several = bench.manifest(ran.output()).expect("stored");
    let blobs = bench.blobs();
    let file = |manifest: &protocol::Manifest, name: &str| artifacts::file(&*blobs, manifest, name).expect("a file");
    let motions: serde_json::Value = serde_json::from_slice(&file(&several, "motions.json")).expect("JSON");
    assert_eq!(
        motions["captions"],
        serde_json::json!(["a person walks", "a person walks", "a person jumps", "a person jumps"])
    );
    let drawn = motions["motions"].as_array().expect("a list");
    let jerks: Vec<f64> = drawn.iter().filter_map(|motion| motion["measures"]["jerk"].as_f64()).collect();
    assert!(jerks.len() == 4 && jerks.iter().all(|jerk| *jerk > 0.0), "{jerks:?}");
    let second = DrawMotions { seed: Seed(5), seconds: 0.0, ..settings };
    let ran = bench.run("drawn", &second.into(), &inputs).expect("the stage runs");
    let second = bench.manifest(ran.output()).expect("stored");
    assert_eq!(file(&several, "motion-01.npy"), file(&second, "motion-00.npy"));
    assert_ne!(file(&several, "motion-00.npy"), file(&several, "motion-01.npy"));
    assert!(file(&second, "motion-00.bvh").starts_with(b"HIERARCHY"));
    assert!(file(&second, "motion-00.glb").starts_with(b"glTF"));
    assert!(file(&second, "motions.html").starts_with(b"<!DOCTYPE html>"));
}
