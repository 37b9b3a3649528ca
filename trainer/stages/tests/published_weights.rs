//! Published weights through `import.model`: checkpoints of the fixtures (`01_*`, `02_control_*`, `05_*`, `06_*`, `07_mdm*`) against the outputs
//! that these store, and what is refused.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::Device;
use checkpoint::Blobs as _;
use checkpoint::model::Model;
use checkpoint::published::Layout;
use models::kernels::Dropout;
use models::names;
use models::networks::{
    Control, Denoiser, Evaluator, FlowUnet, Gpt, Hints, Init, MaskedTransformer, Mdm, Mmm, ResidualTransformer,
    TrajectoryEncoder,
};
use motion::{Skeleton, npy};
use protocol::artifact::Role;
use protocol::stage::{
    DataFormat, DataSynthetic, EncodeLatents, ImportEvaluator, ImportModel, ImportedPart, StageSettings,
};
use protocol::{ArtifactKind, Digest, Manifest};
use serde_json::Value;
use stages::artifacts::{self, DenoiserMeta, EmbeddingsMeta, MODEL_FILE, to_meta};
use stages::control::ControlMeta;
use stages::evaluator::TrainedEvaluator;
use stages::generate::Generator;
use stages::networks::Autoencoder;
use stages::published::{Checkpoint, sizes};
use stages::testing::{Bench, Ran};
use stages::text;
use stages::tokenizer::TrainedTokenizer;
use text_models::{StoredTensor, Weights};

#[path = "../../models/tests/common/mod.rs"]
mod fixtures;

use fixtures::{Array, Arrays, Gates, device, folders, json, name, shared};

/// One forward pass, as the fixtures' README has it.
const FORWARD: f64 = 3e-6;

/// Folders of fixtures that start with `prefix` and have the file `file`.
fn with_file(prefix: &str, file: &str) -> Vec<PathBuf> {
    let Some(root) = shared("parity") else { return Vec::new() };
    let found: Vec<PathBuf> = folders(&root, &[prefix]).into_iter().filter(|f| f.join(file).exists()).collect();
    assert!(!found.is_empty(), "no fixture {prefix}* has a file {file}");
    found
}

struct World {
    bench: Bench,
    /// Statistics that a stage reads.
    folder: tempfile::TempDir,
}

fn text_of(path: &Path) -> String {
    path.display().to_string()
}

impl World {
    fn new() -> Self {
        Self { bench: Bench::new(device(), 7, 1), folder: tempfile::tempdir().expect("a test's own files") }
    }

    /// A folder with statistics of `features` features.
    fn statistics(&self, features: usize) -> String {
        let folder = self.folder.path().join(features.to_string());
        std::fs::create_dir_all(&folder).expect("a test's own files");
        for (name, value) in [("mean.npy", 0.25), ("std.npy", 0.5)] {
            npy::write(&folder.join(name), &[features], &vec![value; features]).expect("a test's own files");
        }
        text_of(&folder)
    }

    /// Caption embeddings of an encoder that gives `dim` numbers.
    fn text(&self, dim: usize) -> Digest {
        let mut encoder = text::built_in();
        encoder.meta["dim"] = dim.into();
        let blobs = self.bench.blobs();
        let text = blobs.put(encoder.to_bytes()).expect("stored");
        let meta = to_meta(&EmbeddingsMeta { text, dim, captions: 1 });
        blobs.put(Manifest::new(ArtifactKind::Embeddings, meta).to_bytes()).expect("stored")
    }

    fn import(&mut self, settings: &ImportModel, inputs: &[(&str, Digest)]) -> Result<Ran, String> {
        let settings = StageSettings::ImportModel(settings.clone());
        self.bench.run("released", &settings, inputs).map_err(|e| e.to_string())
    }

    fn imported(&mut self, what: &str, settings: &ImportModel, inputs: &[(&str, Digest)]) -> Ran {
        self.import(settings, inputs).unwrap_or_else(|e| panic!("{what}: {e}"))
    }

    fn manifest(&self, digest: Digest) -> Manifest {
        self.bench.manifest(digest).expect("stored")
    }

    /// A part of a model.
    fn part(&self, model: Digest, role: &Role) -> Manifest {
        let model = Model::read(&self.manifest(model)).expect("a model");
        self.manifest(model.part(role).expect("a part"))
    }

    /// A network with the weights of an artifact.
    fn load<M: Module>(&self, network: M, part: &Manifest, prefix: &str) -> M {
        let bytes = artifacts::file(&*self.bench.blobs(), part, MODEL_FILE).expect("its weights");
        names::load(network, &bytes, prefix).expect("they fit")
    }

    /// Holds the file of an artifact against the fixture's own safetensors, name by name, bit by bit.
    fn expect_bits(&self, part: &Manifest, weights: &Path, theirs: &dyn Fn(&str) -> String) {
        let ours = artifacts::file(&*self.bench.blobs(), part, MODEL_FILE).expect("its weights");
        let stored = std::fs::read(weights).expect("a file of the fixture");
        let stored = safetensors::SafeTensors::deserialize(&stored).expect("safetensors");
        let ours = safetensors::SafeTensors::deserialize(&ours).expect("safetensors");
        assert!(!ours.is_empty());
        for (name, view) in ours.iter() {
            let other = stored.tensor(&theirs(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!((view.shape(), view.data()), (other.shape(), other.data()), "{}: {name}", weights.display());
        }
    }
}

/// The files of a layout, written below `folder`, by name.
fn exported(world: &World, digest: Digest, layout: Layout) -> BTreeMap<&'static str, PathBuf> {
    let (manifest, blobs) = (world.manifest(digest), world.bench.blobs());
    let folder = world.folder.path().join(format!("{}-{}", layout.name(), digest.short()));
    std::fs::create_dir_all(&folder).expect("a test's own files");
    let mut written = BTreeMap::new();
    for planned in layout.plan(&manifest).expect("a layout for it").files {
        let read = |name: &str| {
            let bytes = blobs.get(manifest.files[name].digest).expect("stored");
            (name.to_owned(), bytes.to_vec())
        };
        let bytes: BTreeMap<String, Vec<u8>> = planned.reads().map(read).collect();
        let path = folder.join(planned.name);
        if planned.write(|| std::fs::File::create(&path), &bytes).expect("it is written") > 0 {
            written.insert(planned.name, path);
        }
    }
    written
}

/// Keeps an exported file in the folder `STRIDE_EXPORTS`, if that is set, and notes there what it was imported from: `tests/torch_load.py` reads both.
fn keep(ours: &Path, theirs: &Path, without: &[&str]) {
    let Some(folder) = std::env::var_os("STRIDE_EXPORTS").map(PathBuf::from) else { return };
    // A layout's folder has the digest of what was exported in its name.
    let layout = ours.parent().expect("a folder of a layout");
    let kept = format!("{}-{}", name(layout), name(ours));
    std::fs::create_dir_all(&folder).expect("a folder that was asked for");
    std::fs::copy(ours, folder.join(&kept)).expect("a folder that was asked for");
    let row =
        [&[kept, text_of(theirs)][..], &without.iter().map(|begin| (*begin).to_owned()).collect::<Vec<_>>()].concat();
    let mut pairs = std::fs::OpenOptions::new();
    let mut pairs =
        pairs.create(true).append(true).open(folder.join("pairs.tsv")).expect("a folder that was asked for");
    pairs.write_all(format!("{}\n", row.join("\t")).as_bytes()).expect("a folder that was asked for");
}

/// Holds an exported file against the one that was imported: the same names and bits, but for names that begin with one of `without`.
fn expect_file(ours: &Path, theirs: &Path, without: &[&str]) {
    keep(ours, theirs, without);
    let open = |path: &Path| Weights::open_file(path).unwrap_or_else(|e| panic!("{e}"));
    let (ours_open, theirs_open) = (open(ours), open(theirs));
    let kept = |name: &&String| !without.iter().any(|begin| name.starts_with(begin));
    let names: Vec<&String> = theirs_open.tensors().keys().filter(kept).collect();
    assert!(!names.is_empty());
    assert_eq!(ours_open.tensors().keys().collect::<Vec<_>>(), names, "{}", theirs.display());
    for (name, tensor) in ours_open.tensors() {
        let other = &theirs_open.tensors()[name];
        assert_eq!(tensor.shape, other.shape, "{name}");
        let bits = |tensor: &StoredTensor| -> Vec<u32> {
            tensor.values().expect("numbers").into_iter().map(f32::to_bits).collect()
        };
        assert_eq!(bits(tensor), bits(other), "{}: {name}", theirs.display());
    }
}

fn format_of(features: usize) -> Option<DataFormat> {
    [DataFormat::Humanml3d, DataFormat::Kit].into_iter().find(|format| Skeleton::of(*format).features == features)
}

fn size(config: &Value, key: &str) -> usize {
    config[key].as_u64().unwrap_or_else(|| panic!("`{key}` is a number")) as usize
}

fn blank(device: &Device) -> Init<'_> {
    Init::blank(device)
}

/// The settings of a part of a fixture's file.
fn part(part: ImportedPart, file: &Path) -> ImportModel {
    ImportModel { part, path: text_of(file), ..ImportModel::default() }
}

/// The VAE of a file, with statistics of its own width.
fn vae(world: &mut World, file: &Path, config: &Value) -> Ran {
    let features = size(config, "nfeats");
    let settings = ImportModel {
        heads: size(config, "num_heads"),
        format: format_of(features).expect("a format with these features"),
        statistics: world.statistics(features),
        ..part(ImportedPart::Vae, file)
    };
    world.imported(&text_of(file), &settings, &[])
}

#[test]
fn vaes_give_what_they_were_published_with() {
    for folder in with_file("01_", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let config = json(&folder.join("config.json"));
        let constructor = &config["constructor"];
        let imported = vae(&mut world, &folder.join("weights.ckpt"), constructor).output();
        // The same under the same names in safetensors.
        assert_eq!(vae(&mut world, &folder.join("weights.safetensors"), constructor).output(), imported);
        let manifest = world.manifest(imported);
        world.expect_bits(&manifest, &folder.join("weights.safetensors"), &str::to_owned);
        for layout in [Layout::MotionLcm, Layout::Safetensors] {
            let files: Vec<PathBuf> = exported(&world, imported, layout).into_values().collect();
            assert_eq!(vae(&mut world, &files[0], constructor).output(), imported, "{}: out and in", layout.name());
            if layout == Layout::MotionLcm {
                expect_file(&files[0], &folder.join("weights.ckpt"), &[]);
            }
        }
        let trained = Autoencoder::read(&*world.bench.blobs(), &manifest, &device()).expect("a VAE");
        let io = Arrays::read(&folder.join("io.safetensors"));
        for case in io.cases().into_iter().filter(|case| case != "stats") {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            let lengths = stored("lengths").usizes();
            let (frames, width) = (stored("features").shape[1], stored("features").shape[2]);
            for (b, length) in lengths.iter().enumerate() {
                let cut = |array: &Array| array.values[b * frames * width..][..length * width].to_vec();
                let rows: Vec<f32> = cut(stored("features")).iter().map(|v| *v as f32).collect();
                let mu = trained.encode(rows, *length).mu;
                let own = fixtures::row(stored("mu"), b);
                gates.check("latent", format!("{case}/{b}"), fixtures::error(&mu, &own.values), FORWARD);
                let decoded = trained.decode(own.f32s(), *length);
                gates.check("decoded", &*case, fixtures::error(&decoded, &cut(stored("decoded_mu"))), FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

/// What a student's file and its folder give: the VAE, the model, and the model with its control part.
fn motion_lcm(world: &mut World, folder: &Path, file: &Path) -> (Digest, Digest, Ran) {
    let config = json(&folder.join("config.json"));
    let vae = vae(world, file, &config["vae"]).output();
    let text = world.text(size(&config["denoiser"], "text_dim"));
    let student = !config["denoiser"]["time_cond_proj_dim"].is_null();
    let kind = if student { ImportedPart::Lcm } else { ImportedPart::Mld };
    let heads = size(&config["denoiser"], "num_heads");
    let settings = ImportModel { heads, ..part(kind, file) };
    let lcm = world.imported("denoiser", &settings, &[("vae", vae), ("text", text)]).output();
    let io = Arrays::read(&folder.join("io.safetensors"));
    let hints = world.folder.path().join("hints");
    std::fs::create_dir_all(&hints).expect("a test's own files");
    for (name, key) in [("Mean_raw.npy", "stats/raw_mean"), ("Std_raw.npy", "stats/raw_std")] {
        let stored = io.get(key);
        npy::write(&hints.join(name), &stored.shape, &stored.f32s()).expect("a test's own files");
    }
    let heads = size(&config["traj_encoder"], "num_heads");
    let settings = ImportModel { heads, hint_statistics: text_of(&hints), ..part(ImportedPart::Control, file) };
    let controlled = world.imported("control", &settings, &[("model", lcm)]);
    (vae, lcm, controlled)
}

#[test]
fn motion_lcm_and_its_control_part_give_what_they_were_published_with() {
    for folder in with_file("02_control", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let file = folder.join("weights.ckpt");
        let (vae, lcm, controlled) = motion_lcm(&mut world, &folder, &file);
        let said = controlled.told.log.join("\n");
        assert!(said.contains("t2m_motionencoder` (") && said.contains("t2m_textencoder` ("), "{said}");
        assert!(!said.contains("denoiser"), "what was held against the model was read: {said}");
        let controlled = controlled.output();
        for layout in [Layout::MotionLcm, Layout::Safetensors] {
            let files: Vec<PathBuf> = exported(&world, controlled, layout).into_values().collect();
            let again = motion_lcm(&mut world, &folder, &files[0]);
            assert_eq!((again.0, again.1, again.2.output()), (vae, lcm, controlled), "{}: out and in", layout.name());
            if layout == Layout::MotionLcm {
                expect_file(&files[0], &file, &["state_dict.t2m_"]);
            }
        }
        let weights = folder.join("weights.safetensors");
        let (denoiser, control) = (world.part(lcm, &Role::DENOISER), world.part(controlled, &Role::CONTROL));
        world.expect_bits(&world.manifest(vae), &weights, &|name| format!("vae.{name}"));
        world.expect_bits(&denoiser, &weights, &|name| format!("denoiser.{name}"));
        world.expect_bits(&control, &weights, &str::to_owned);

        let meta: DenoiserMeta = artifacts::meta(&denoiser, "the denoiser").expect("its meta");
        let own: ControlMeta = artifacts::meta(&control, "the control part").expect("its meta");
        let device = device();
        let base = world.load(Denoiser::new(&meta.config(), &mut blank(&device)), &denoiser, "");
        let net: Denoiser = world.load(own.controlnet(&meta, &mut blank(&device)), &control, "controlnet.");
        let fresh: TrajectoryEncoder = own.trajectory(&meta, &mut blank(&device));
        let trajectory = world.load(fresh, &control, "traj_encoder.");
        let io = Arrays::read(&folder.join("io.safetensors"));
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            if io.find(&format!("{case}/denoiser_output")).is_none() {
                continue;
            }
            let given: Vec<bool> = stored("hint_mask").values.iter().map(|m| *m != 0.0).collect();
            let [batch, frames, joints] = stored("hint").shape[..3] else { panic!("a hint has four axes") };
            let hints = Hints::new(&stored("hint").f32s(), &given, (batch, frames, joints), &device);
            let off = &mut Dropout::off();
            let tokens = trajectory.forward(&hints, off);
            let (noisy, times) = (stored("noisy").tensor::<3>(&device), stored("timesteps").usizes());
            let text = stored("text").tensor::<3>(&device);
            let guidance = io.find(&format!("{case}/w_embedding")).map(|w| w.tensor::<2>(&device));
            let residuals = net.residuals(noisy.clone(), &times, text.clone(), guidance.clone(), tokens.clone(), off);
            gates.tensor("trajectory", &*case, tokens, stored("traj_embedding"), FORWARD);
            let run = Control { residuals: &residuals, scale: 1.0 };
            let out = base.forward_controlled(noisy, &times, text, guidance, run, off);
            gates.tensor("prediction", &*case, out, stored("denoiser_output"), FORWARD);
        }
        gates.close(&name(&folder));
        works(&mut world, vae, controlled, &meta);
    }
}

/// What is imported is encoded with, and drawn from.
fn works(world: &mut World, vae: Digest, model: Digest, meta: &DenoiserMeta) {
    let clips = StageSettings::DataSynthetic(DataSynthetic { clips: 12, ..DataSynthetic::default() });
    let data = world.bench.run("dataset", &clips, &[]).expect("the stage runs").output();
    let latents = StageSettings::EncodeLatents(EncodeLatents::default());
    world.bench.run("latents", &latents, &[("dataset", data), ("vae", vae)]).expect("a VAE like any other");
    if meta.text_dim != text::open(&text::built_in(), &*world.bench.blobs(), &device()).expect("built in").dim() {
        return;
    }
    let model = world.manifest(model);
    let generator = Generator::load(&model, &*world.bench.blobs(), &device()).expect("a model like any other");
    let drawn = generator.generate("a person walks forward.", Some(24), None, protocol::Seed(3)).expect("it draws");
    assert!(drawn.features.iter().all(|v| v.is_finite()));
}

/// A tokenizer of one of the fixtures, or one that fits a generator.
fn tokenizer(world: &mut World, file: &Path, features: usize) -> Digest {
    let settings = ImportModel {
        format: format_of(features).expect("a format with these features"),
        statistics: world.statistics(features),
        ..part(ImportedPart::Tokenizer, file)
    };
    world.imported(&text_of(file), &settings, &[]).output()
}

#[test]
fn tokenizers_give_what_they_were_published_with() {
    let all = [with_file("05_rvq", "weights.ckpt"), with_file("05_t2mgpt_vqvae", "weights.ckpt")].concat();
    for folder in all {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let io = Arrays::read(&folder.join("io.safetensors"));
        let features = io.get("full/motion").shape[2];
        let imported = tokenizer(&mut world, &folder.join("weights.ckpt"), features);
        assert_eq!(tokenizer(&mut world, &folder.join("weights.safetensors"), features), imported);
        let manifest = world.manifest(imported);
        let layout =
            if trained_single(&manifest) { (Layout::T2mGpt, "vqvae.pth") } else { (Layout::Momask, "rvq.tar") };
        let files = exported(&world, imported, layout.0);
        expect_file(&files[layout.1], &folder.join("weights.ckpt"), &[]);
        for file in
            [files[layout.1].clone(), exported(&world, imported, Layout::Safetensors)["model.safetensors"].clone()]
        {
            assert_eq!(tokenizer(&mut world, &file, features), imported, "out and in");
        }
        let trained = TrainedTokenizer::read(&*world.bench.blobs(), &manifest, &device()).expect("a tokenizer");
        let config = json(&folder.join("config.json"));
        assert_eq!(
            (trained.meta().codes, trained.meta().code_dim),
            (size(&config, "nb_code"), size(&config, "code_dim"))
        );
        assert_eq!(trained.meta().network.depth, size(&config, "depth"));
        for case in io.cases() {
            let Some(indices) = io.find(&format!("{case}/code_idx")) else { continue };
            let motion = io.get(&format!("{case}/motion"));
            let wanted = io.get(&format!("{case}/reconstruction"));
            for b in 0..motion.shape[0] {
                let ids = trained.encode(fixtures::row(motion, b).f32s());
                let stored: Vec<i64> = fixtures::row(indices, b).values.iter().map(|v| *v as i64).collect();
                assert_eq!(ids, stored, "{case}: ids");
                let decoded = trained.decode(&ids);
                let own = fixtures::row(wanted, b);
                gates.check("decoded", format!("{case}/{b}"), fixtures::error(&decoded, &own.values), FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

/// Whether a tokenizer has one codebook.
fn trained_single(manifest: &Manifest) -> bool {
    manifest.meta["quantizers"] == 1
}

/// A tokenizer of so many codebooks and codes, whose weights mean nothing.
fn stand_in(world: &World, codes: usize, quantizers: usize, code_dim: usize) -> Digest {
    let features = 263;
    let meta = serde_json::json!({
        "format": "humanml3d", "features": features, "codes": codes, "code_dim": code_dim, "quantizers": quantizers,
        "network": {"width": 8, "depth": 1, "growth": 3, "dropout": 0.0},
        "mean": vec![0.0; features], "std": vec![1.0; features],
    });
    world.bench.blobs().put(Manifest::new(ArtifactKind::Tokenizer, meta).to_bytes()).expect("stored")
}

#[test]
fn token_generators_give_what_they_were_published_with() {
    let device = device();
    for folder in with_file("05_t2mgpt_transformer", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let (file, heads) = (folder.join("weights.ckpt"), size(&config, "heads"));
        let inputs = [
            ("tokenizer", stand_in(&world, size(&config, "num_vq"), 1, 8)),
            ("text", world.text(size(&config, "clip_dim"))),
        ];
        let settings = ImportModel { heads, ..part(ImportedPart::T2mgpt, &file) };
        let model = world.imported("transformer", &settings, &inputs).output();
        let files = exported(&world, model, Layout::T2mGpt);
        expect_file(&files["transformer.pth"], &file, &[]);
        for file in [&files["transformer.pth"], &exported(&world, model, Layout::Safetensors)["model.safetensors"]] {
            let again = ImportModel { path: text_of(file), ..settings.clone() };
            assert_eq!(world.imported("again", &again, &inputs).output(), model, "out and in");
        }
        let generator = world.part(model, &Role::GENERATOR);
        assert_eq!(generator.meta["longest"], size(&config, "block_size") - 2);
        world.expect_bits(&generator, &folder.join("weights.safetensors"), &str::to_owned);
        let opened = Checkpoint::open(&file).expect("a checkpoint");
        let sizes = sizes::of_gpt(&sizes::gpt(&opened).expect("it"), 1, heads).expect("its sizes");
        let network = world.load(Gpt::new(&sizes, &mut blank(&device)), &generator, "");
        for case in ["full", "short"] {
            let wanted = io.get(&format!("{case}/logits"));
            let all = io.get("full/cond").tensor::<2>(&device);
            let text = all.clone().slice([0..wanted.shape[0], 0..all.dims()[1]]);
            let logits = network.forward(&io.get(&format!("{case}/ids")).usizes(), text, &mut Dropout::off());
            gates.tensor("logits", case, logits, wanted, FORWARD);
        }
        gates.close(&name(&folder));
    }
    for folder in with_file("05_momask", "masked.tar") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let heads = size(&config, "heads");
        let (masked, residual) = (folder.join("masked.tar"), folder.join("residual.tar"));
        let tokenizer = stand_in(&world, size(&config, "num_tokens"), size(&config, "num_quantizers"), 8);
        let inputs = [("tokenizer", tokenizer), ("text", world.text(size(&config, "clip_dim")))];
        let settings = ImportModel { heads, residual: text_of(&residual), ..part(ImportedPart::Momask, &masked) };
        let model = world.imported("transformers", &settings, &inputs).output();
        let generator = world.part(model, &Role::GENERATOR);
        world.expect_bits(&generator, &folder.join("weights.safetensors"), &str::to_owned);
        assert!(generator.files.contains_key("constants.safetensors"), "the table of positions is kept");
        let files = exported(&world, model, Layout::Momask);
        expect_file(&files["masked.tar"], &masked, &[]);
        expect_file(&files["residual.tar"], &residual, &[]);
        let one = &exported(&world, model, Layout::Safetensors)["model.safetensors"];
        for (path, residual) in [(&files["masked.tar"], &files["residual.tar"]), (one, one)] {
            let again = ImportModel { path: text_of(path), residual: text_of(residual), ..settings.clone() };
            assert_eq!(world.imported("again", &again, &inputs).output(), model, "out and in");
        }
        let alone = world.import(&ImportModel { residual: String::new(), ..settings }, &inputs).unwrap_err();
        assert!(alone.contains("set `residual`"), "{alone}");

        let opened = Checkpoint::open(&residual).expect("a checkpoint");
        let sizes = sizes::of_residual(&sizes::residual(&opened).expect("it"), heads).expect("its sizes");
        let first = world.load(MaskedTransformer::new(&sizes, &mut blank(&device)), &generator, "mask.");
        let above = world.load(ResidualTransformer::new(&sizes, true, &mut blank(&device)), &generator, "res.");
        let (text, lengths) = (io.get("cond").tensor::<2>(&device), io.get("m_lens").usizes());
        let off = &mut Dropout::off();
        let logits = first.forward(&io.get("mask/ids").usizes(), text.clone(), &lengths, off);
        gates.tensor("logits", "masked", logits.swap_dims(1, 2), io.get("mask/logits_cond"), FORWARD);
        let sums = io.get("res/history_sum").tensor::<3>(&device);
        let logits = above.forward(sums, &io.get("res/qids").usizes(), text, &lengths, off);
        gates.tensor("logits", "residual", logits.swap_dims(1, 2), io.get("res/logits"), FORWARD);
        gates.close(&name(&folder));
    }
}

#[test]
fn mmm_is_read_without_the_tokenizer_in_its_file() {
    for folder in with_file("05_mmm", "weights.safetensors") {
        let mut world = World::new();
        let file = folder.join("weights.safetensors");
        let opened = Checkpoint::open(&file).expect("a checkpoint");
        let found = sizes::mmm(&opened).expect("it");
        let sizes = sizes::of_mmm(&found, 1, 1).expect("its sizes");
        let inputs = [("tokenizer", stand_in(&world, sizes.codes, 1, sizes.dim)), ("text", world.text(sizes.text_dim))];
        let ran = world.imported("MMM", &ImportModel { heads: 1, ..part(ImportedPart::Mmm, &file) }, &inputs);
        let generator = world.part(ran.output(), &Role::GENERATOR);
        world.expect_bits(&generator, &file, &str::to_owned);
        let device = device();
        world.load(Mmm::new(&sizes, &mut blank(&device)), &generator, "");
    }
}

#[test]
fn mdm_gives_what_it_was_published_with() {
    let device = device();
    for folder in with_file("07_mdm", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let constructor = &config["constructor"];
        let (file, heads) = (folder.join("weights.ckpt"), size(constructor, "num_heads"));
        let features = size(constructor, "njoints");
        let opened = Checkpoint::open(&file).expect("a checkpoint");
        let found = sizes::mdm(&opened).expect("an MDM");
        let sizes = sizes::of_mdm(&found, heads).expect("its sizes");
        let text = world.text(size(constructor, "clip_dim"));
        let settings = ImportModel {
            heads,
            timesteps: size(&config["diffusion"], "steps"),
            mask_frames: constructor["mask_frames"].as_bool().expect("a flag"),
            format: format_of(features).unwrap_or(DataFormat::Humanml3d),
            statistics: world.statistics(features),
            ..part(ImportedPart::Mdm, &file)
        };
        let network = if format_of(features).is_some() {
            let model = world.imported("MDM", &settings, &[("text", text)]).output();
            let written = exported(&world, model, Layout::Mdm)["model.pt"].clone();
            expect_file(&written, &file, &[]);
            for file in [written, exported(&world, model, Layout::Safetensors)["model.safetensors"].clone()] {
                let again = ImportModel { path: text_of(&file), ..settings.clone() };
                assert_eq!(world.imported("again", &again, &[("text", text)]).output(), model, "out and in");
            }
            let denoiser = world.part(model, &Role::DENOISER);
            world.expect_bits(&denoiser, &folder.join("weights.safetensors"), &str::to_owned);
            world.load(Mdm::new(&sizes, &mut blank(&device)), &denoiser, "")
        } else {
            // No data set has features of this width, and so no stage gives a model of it.
            let refused = world.import(&settings, &[("text", text)]).unwrap_err();
            assert!(refused.contains("set `format`"), "{refused}");
            let network = Mdm::new(&sizes, &mut blank(&device));
            let taken = found.take(&models::flat::layout(&network), &str::to_owned).expect("a whole network");
            models::flat::write(network, &taken.values)
        };
        let masked = settings.mask_frames;
        for case in ["full", "ragged", "single"] {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            // [B, F, 1, T] as [B, T, F].
            let turned = |array: &Array| {
                let (batch, features, frames) = (array.shape[0], array.shape[1], array.shape[3]);
                let at = |b: usize, t: usize, f: usize| array.values[(b * features + f) * frames + t];
                let row = move |b: usize| (0..frames).flat_map(move |t| (0..features).map(move |f| (b, t, f)));
                let values = (0..batch).flat_map(row).map(|(b, t, f)| at(b, t, f)).collect();
                Array { shape: vec![batch, frames, features], values }
            };
            let frames = stored("mask").shape[3];
            let live = |row: &[f64]| row.iter().filter(|v| **v != 0.0).count();
            let lengths: Vec<usize> = stored("mask").values.chunks_exact(frames).map(live).collect();
            let text = stored("text_embed");
            let text = Array { shape: text.shape[1..].to_vec(), values: text.values.clone() }.tensor::<2>(&device);
            let out = network.forward(
                turned(stored("x_t")).tensor(&device),
                &stored("t").usizes(),
                text,
                masked.then_some(&lengths[..]),
                &mut Dropout::off(),
            );
            let wanted = turned(stored("output"));
            // Behind a motion's end there is nothing to be compared where frames are masked.
            let width = wanted.shape[2];
            let found = fixtures::values(out);
            for (b, length) in lengths.iter().enumerate() {
                let cut = b * frames * width..(b * frames + if masked { *length } else { frames }) * width;
                gates.check("output", case, fixtures::error(&found[cut.clone()], &wanted.values[cut]), FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

#[test]
fn discord_gives_what_it_was_published_with() {
    let device = device();
    for folder in with_file("06_discord_unet", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let file = folder.join("weights.ckpt");
        let tokenizer = stand_in(&world, 8, 2, size(&config["constructor"], "c_in_dim"));
        let heads = size(&config["constructor"], "attn_heads");
        let settings = ImportModel { heads, ..part(ImportedPart::Discord, &file) };
        let decoder = world.imported("decoder", &settings, &[("tokenizer", tokenizer)]).output();
        let written = exported(&world, decoder, Layout::Momask)["discord.pth"].clone();
        expect_file(&written, &file, &[]);
        for file in [written, exported(&world, decoder, Layout::Safetensors)["model.safetensors"].clone()] {
            let again = ImportModel { path: text_of(&file), ..settings.clone() };
            assert_eq!(world.imported("again", &again, &[("tokenizer", tokenizer)]).output(), decoder, "out and in");
        }
        let decoder = world.manifest(decoder);
        world.expect_bits(&decoder, &folder.join("weights.safetensors"), &str::to_owned);
        let opened = Checkpoint::open(&file).expect("a checkpoint");
        let sizes = sizes::of_unet(&sizes::unet(&opened).expect("it"), (heads, 32)).expect("its sizes");
        let network = world.load(FlowUnet::new(&sizes, &mut blank(&device)), &decoder, "");
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            if io.find(&format!("{case}/v")).is_none() {
                continue;
            }
            let tokens = stored("c").tensor::<3>(&device);
            let out = network.forward(stored("x_t").tensor(&device), &stored("t").f32s(), tokens, &mut Dropout::off());
            gates.tensor("velocity", &*case, out, stored("v"), FORWARD);
        }
        gates.close(&name(&folder));
    }
}

/// Tensors by name: shape and values.
type Named = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Tensors as a safetensors file, some of them changed.
fn changed(from: &Path, to: &Path, change: &dyn Fn(&mut Named)) {
    let bytes = std::fs::read(from).expect("a file of the fixture");
    let stored = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
    let floats = |data: &[u8]| data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let mut all =
        stored.iter().map(|(name, view)| (name.to_owned(), (view.shape().to_vec(), floats(view.data())))).collect();
    change(&mut all);
    let all = all
        .into_iter()
        .fold(artifacts::Tensors::default(), |all, (name, (shape, values))| all.with(&name, shape, values));
    std::fs::write(to, all.to_bytes().expect("tensors")).expect("a test's own files");
}

#[test]
fn what_makes_no_whole_network_is_refused_with_all_that_is_wrong() {
    let Some(folder) = with_file("01_vae_v2", "weights.ckpt").into_iter().next() else { return };
    let mut world = World::new();
    let (from, to) = (folder.join("weights.safetensors"), world.folder.path().join("changed.safetensors"));
    let config = json(&folder.join("config.json"));
    let settings = ImportModel {
        heads: size(&config["constructor"], "num_heads"),
        statistics: world.statistics(263),
        ..part(ImportedPart::Vae, &to)
    };
    let mut refused = |change: &dyn Fn(&mut Named), settings: &ImportModel| {
        changed(&from, &to, change);
        world.import(settings, &[]).map(|ran| ran.output()).unwrap_err()
    };
    let said = refused(
        &|all| {
            all.remove("decoder.norm.bias");
            all.insert("final_layer.bias".into(), (vec![5], vec![0.0; 5]));
            all.insert("encoder.input_blocks.0.norm9.bias".into(), (vec![2], vec![0.0; 2]));
        },
        &settings,
    );
    for part in [
        "changed.safetensors: ",
        "`decoder.norm.bias` [",
        "is missing",
        "`final_layer.bias` has shape [5], expected [263]",
        "`encoder.input_blocks.0.norm9.bias` [2] is not of this network",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let nan = refused(&|all| all.get_mut("final_layer.bias").expect("it").1[3] = f32::NAN, &settings);
    assert!(nan.contains("`final_layer.bias`: number 3 of 263 is not finite"), "{nan}");
    // A wide axis asks for a network that the file does not hold; nothing is made of it.
    let wide = refused(
        &|all| {
            let huge = (vec![3, 1 << 20], vec![0.0; 3 << 20]);
            all.insert("encoder.middle_block.self_attn.in_proj_weight".into(), huge);
        },
        &settings,
    );
    assert!(wide.contains("and ") && wide.contains(" more"), "{wide}");
    let heads = refused(&|_| {}, &ImportModel { heads: 7, ..settings.clone() });
    assert!(heads.contains("7 attention heads do not divide; set `heads`"), "{heads}");
    let kit = refused(&|_| {}, &ImportModel { format: DataFormat::Kit, ..settings.clone() });
    assert!(kit.contains("263 features") && kit.contains("set `format`"), "{kit}");
    let other = refused(&|_| {}, &ImportModel { part: ImportedPart::Tokenizer, ..settings.clone() });
    assert!(other.contains("it holds no tokenizer, which has a tensor `encoder.model.0.weight`"), "{other}");
    let extra = |all: &mut BTreeMap<String, (Vec<usize>, Vec<f32>)>| {
        all.insert("text_encoder.x".into(), (vec![1], vec![0.0]));
        all.insert("t2m_textencoder.hidden".into(), (vec![1], vec![0.0]));
    };
    changed(&from, &to, &extra);
    let ran = world.imported("with extra names", &settings, &[]);
    assert!(ran.told.log.join("").contains("`t2m_textencoder` (1), `text_encoder` (1)"), "{:?}", ran.told.log);
}

#[test]
fn nothing_of_a_file_is_run_and_none_but_weights_are_read() {
    let mut world = World::new();
    let owned = world.folder.path().join("owned");
    let command = format!("touch {}", owned.display());
    let length = u32::try_from(command.len()).expect("a short command").to_le_bytes();
    let pickle = [&b"cposix\nsystem\n(X"[..], &length, command.as_bytes(), b"tR."].concat();
    let long_header = [&(1_u64 << 60).to_le_bytes()[..], b"{}"].concat();
    for (name, bytes, words) in [
        ("pickle.tar", pickle, "expected a dict"),
        ("short.ckpt", b"PK".to_vec(), "has 2 bytes; expected a checkpoint"),
        ("long.safetensors", long_header, "header"),
        ("no.ckpt", b"PK\x03\x04 is no archive at all".to_vec(), "no.ckpt: "),
    ] {
        let file = world.folder.path().join(name);
        std::fs::write(&file, bytes).expect("a test's own files");
        let settings = ImportModel { statistics: world.statistics(263), ..part(ImportedPart::Vae, &file) };
        let said = world.import(&settings, &[]).map(|ran| ran.output()).unwrap_err();
        assert!(said.to_lowercase().contains(words) && said.contains(name), "{name}: {said}");
    }
    assert!(!owned.exists(), "a pickle was run");
}

#[test]
fn what_is_of_another_kind_or_of_another_vae_is_refused() {
    let Some(folder) = with_file("02_control", "weights.ckpt").into_iter().next() else { return };
    let mut world = World::new();
    let (file, config) = (folder.join("weights.ckpt"), json(&folder.join("config.json")));
    let (vae, _, _) = motion_lcm(&mut world, &folder, &file);
    let text = world.text(size(&config["denoiser"], "text_dim"));
    let settings = ImportModel { heads: size(&config["denoiser"], "num_heads"), ..part(ImportedPart::Lcm, &file) };
    let teacher = ImportModel { part: ImportedPart::Mld, ..settings.clone() };
    let said = world.import(&teacher, &[("vae", vae), ("text", text)]).unwrap_err();
    assert!(said.contains("write `part: lcm`"), "{said}");
    let narrow = world.text(12);
    let said = world.import(&settings, &[("vae", vae), ("text", narrow)]).unwrap_err();
    assert!(said.contains("768 numbers a caption, `text` gives 12"), "{said}");
    // Another VAE of the same size: one number is another.
    let (from, to) = (folder.join("weights.safetensors"), world.folder.path().join("other.safetensors"));
    changed(&from, &to, &|all| all.get_mut("vae.final_layer.bias").expect("it").1[0] += 1.0);
    let other = {
        let file = to;
        self::vae(&mut world, &file, &config["vae"]).output()
    };
    let said = world.import(&settings, &[("vae", other), ("text", text)]).unwrap_err();
    assert!(said.contains("the VAE in it") && said.contains("the numbers are others"), "{said}");
}

/// An evaluator's file beside statistics that change nothing, in the published layout.
fn evaluator(world: &mut World, folder: &Path, format: DataFormat) -> Digest {
    let (path, features) = (world.folder.path().join("evaluator"), Skeleton::of(format).features);
    let (model, meta) = (path.join("text_mot_match/model"), path.join("Comp_v6_KLD01/meta"));
    [&model, &meta].into_iter().for_each(|folder| std::fs::create_dir_all(folder).expect("a test's own files"));
    std::fs::copy(folder.join("finest.tar"), model.join("finest.tar")).expect("a file of the fixture");
    for (name, value) in [("mean.npy", 0.0), ("std.npy", 1.0)] {
        npy::write(&meta.join(name), &[features], &vec![value; features]).expect("a test's own files");
    }
    let settings = ImportEvaluator { path: text_of(&path), format, words: String::new() };
    world.bench.run("evaluator", &settings.into(), &[]).unwrap_or_else(|e| panic!("{e}")).output()
}

#[test]
fn evaluators_give_what_they_were_published_with() {
    for folder in with_file("04_evaluator", "finest.tar") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let io = Arrays::read(&folder.join("io.safetensors"));
        let width = io.get("full/motions").shape[2];
        let imported = evaluator(&mut world, &folder, format_of(width).expect("a format with these features"));
        let manifest = world.manifest(imported);
        let trained = TrainedEvaluator::read(&*world.bench.blobs(), &manifest, &device()).expect("an evaluator");
        // The network itself: what is measured with it pads motions, as loaders do, where the fixture ends them.
        let device = device();
        let fresh = Evaluator::new(&trained.meta().config, &mut blank(&device));
        let network = names::load(fresh, &trained.weights(), "").expect("its own weights");
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            let motions = network.motion(stored("motions").tensor(&device), &stored("m_lens").usizes());
            gates.tensor("motion", &*case, motions, stored("motion_embedding_input_order"), FORWARD);
            let (words, classes) =
                (stored("word_embs").tensor::<3>(&device), stored("pos_onehot").tensor::<3>(&device));
            let text = network.text_encoder.forward(words, classes, &stored("cap_lens").usizes());
            gates.tensor("text", &*case, text, stored("text_embedding_input_order"), FORWARD);
        }
        gates.close(&name(&folder));
    }
}
