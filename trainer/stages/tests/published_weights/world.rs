//! Common part of the tests of published weights: stages that import on one worker, and the smaller parts of the
//! fixtures.

use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::Device;
use checkpoint::Blobs as _;
use checkpoint::model::Model;
use models::names;
use models::networks::Init;
use motion::{Skeleton, npy};
use protocol::artifact::Role;
use protocol::stage::{DataFormat, ImportModel, ImportedPart, StageSettings};
use protocol::{ArtifactKind, Digest, Manifest};
use serde_json::Value;
use stage_lab::{Bench, Ran};
use stages::artifacts::{self, EmbeddingsMeta, MODEL_FILE, to_meta};
use stages::parts::text;

use crate::fixtures::{device, folders, shared};

/// Gate of one forward pass, from the fixtures' README.
pub(crate) const FORWARD: f64 = 3e-6;

/// Folders of fixtures with the prefix `prefix` that contain the file `file`.
pub(crate) fn with_file(prefix: &str, file: &str) -> Vec<PathBuf> {
    let Some(root) = shared("parity") else { return Vec::new() };
    let found: Vec<PathBuf> = folders(&root, &[prefix]).into_iter().filter(|f| f.join(file).exists()).collect();
    assert!(!found.is_empty(), "no fixture {prefix}* has a file {file}");
    found
}

pub(crate) struct World {
    pub(crate) bench: Bench,
    /// Folder of the statistics that stages read.
    pub(crate) folder: tempfile::TempDir,
}

pub(crate) fn text_of(path: &Path) -> String {
    path.display().to_string()
}

impl World {
    pub(crate) fn new() -> Self {
        Self { bench: Bench::new(device(), 7, 1), folder: tempfile::tempdir().expect("a test's own files") }
    }

    /// Writes a folder with statistics of `features` features.
    pub(crate) fn statistics(&self, features: usize) -> String {
        let folder = self.folder.path().join(features.to_string());
        std::fs::create_dir_all(&folder).expect("a test's own files");
        for (name, value) in [("mean.npy", 0.25), ("std.npy", 0.5)] {
            npy::write(&folder.join(name), &[features], &vec![value; features]).expect("a test's own files");
        }
        text_of(&folder)
    }

    /// Caption embeddings of an encoder with `dim` numbers.
    pub(crate) fn text(&self, dim: usize) -> Digest {
        let mut encoder = text::built_in();
        encoder.meta["dim"] = dim.into();
        let blobs = self.bench.blobs();
        let text = blobs.put(encoder.to_bytes()).expect("stored");
        let meta = to_meta(&EmbeddingsMeta { text, dim, captions: 1 });
        blobs.put(Manifest::new(ArtifactKind::Embeddings, meta).to_bytes()).expect("stored")
    }

    pub(crate) fn import(&mut self, settings: &ImportModel, inputs: &[(&str, Digest)]) -> Result<Ran, String> {
        let settings = StageSettings::ImportModel(settings.clone());
        self.bench.run("released", &settings, inputs).map_err(|e| e.to_string())
    }

    pub(crate) fn imported(&mut self, what: &str, settings: &ImportModel, inputs: &[(&str, Digest)]) -> Ran {
        self.import(settings, inputs).unwrap_or_else(|e| panic!("{what}: {e}"))
    }

    pub(crate) fn manifest(&self, digest: Digest) -> Manifest {
        self.bench.manifest(digest).expect("stored")
    }

    /// Manifest of a part of a model.
    pub(crate) fn part(&self, model: Digest, role: &Role) -> Manifest {
        let model = Model::read(&self.manifest(model)).expect("a model");
        self.manifest(model.part(role).expect("a part"))
    }

    /// Loads the weights of an artifact into a network.
    pub(crate) fn load<M: Module>(&self, network: M, part: &Manifest, prefix: &str) -> M {
        let bytes = artifacts::file(&*self.bench.blobs(), part, MODEL_FILE).expect("its weights");
        names::load(network, &bytes, prefix).expect("they fit")
    }

    /// Compares the file of an artifact with the fixture's own safetensors, name by name, bit by bit.
    pub(crate) fn expect_bits(&self, part: &Manifest, weights: &Path, theirs: &dyn Fn(&str) -> String) {
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

pub(crate) fn size(config: &Value, key: &str) -> usize {
    config[key].as_u64().unwrap_or_else(|| panic!("`{key}` is a number")) as usize
}

pub(crate) fn blank(device: &Device) -> Init<'_> {
    Init::blank(device)
}

/// Settings to import a part of a fixture's file.
pub(crate) fn part(part: ImportedPart, file: &Path) -> ImportModel {
    ImportModel { part, path: text_of(file), ..ImportModel::default() }
}

pub(crate) fn format_of(features: usize) -> Option<DataFormat> {
    [DataFormat::Humanml3d, DataFormat::Kit].into_iter().find(|format| Skeleton::of(*format).features == features)
}

/// Imports the VAE of a file, with statistics of its own width.
pub(crate) fn vae(world: &mut World, file: &Path, config: &Value) -> Ran {
    let features = size(config, "nfeats");
    let settings = ImportModel {
        heads: size(config, "num_heads"),
        format: format_of(features).expect("a format with these features"),
        statistics: world.statistics(features),
        ..part(ImportedPart::Vae, file)
    };
    world.imported(&text_of(file), &settings, &[])
}

/// Stores the manifest of a tokenizer with this number of codebooks and codes, without weights.
pub(crate) fn stand_in(world: &World, codes: usize, quantizers: usize, code_dim: usize) -> Digest {
    let features = 263;
    let meta = serde_json::json!({
        "format": "humanml3d", "features": features, "codes": codes, "code_dim": code_dim, "quantizers": quantizers,
        "network": {"width": 8, "depth": 1, "growth": 3, "dropout": 0.0},
        "mean": vec![0.0; features], "std": vec![1.0; features],
    });
    world.bench.blobs().put(Manifest::new(ArtifactKind::Tokenizer, meta).to_bytes()).expect("stored")
}
