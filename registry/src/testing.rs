//! Valid bundles, and the import of arbitrary bytes, for the tests of bundles and for `fuzz/`.
//!
//! Every file of a bundle is checked against a digest, so almost no changed file gets past that check. Changed bytes
//! are therefore also used as the archive before compression, and as a manifest whose digest the rest of the bundle
//! has. Then the parsers behind the check must refuse them.

pub mod slow;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use std::sync::OnceLock;

use checkpoint::BlobError;
use checkpoint::model::{Model, assemble, extend};
use protocol::artifact::{Chunk, FileEntry, Role};
use protocol::stage::{DataFormat, Sampler};
use protocol::{ArtifactKind, Digest, Manifest, ModelName};
use serde_json::{Value, json};
use tar::{EntryType, Header};
use tokio::runtime::Runtime;

use crate::bundle::{self, Bundle, FORMAT, Head, ImportError, Sink, card};
use crate::lock::Holder;
use crate::store::Store;

use crate::WriteError;

/// An entry of an archive: name, type, content.
pub type Entry = (String, EntryType, Vec<u8>);

/// A version of a model with three parts.
#[derive(Debug, Clone)]
pub struct Whole {
    /// Head of its bundle.
    pub head: Head,
    /// The model's manifest.
    pub manifest: Manifest,
    /// The files that the manifest lists, by their digests.
    pub files: BTreeMap<Digest, Vec<u8>>,
}

fn listed(bytes: &[u8]) -> FileEntry {
    FileEntry::of_blob(Digest::of(bytes), bytes.len() as u64)
}

fn part(kind: ArtifactKind, meta: Value, weights: FileEntry) -> Manifest {
    let mut manifest = Manifest::new(kind, meta);
    manifest.list([("model.safetensors".to_owned(), weights)]);
    manifest
}

impl Whole {
    /// Makes a version whose VAE has these bytes as weights.
    ///
    /// # Panics
    /// Panics if the parts form no model, which would be an error in this function.
    pub fn of(weights: Vec<u8>) -> Self {
        let entry = listed(&weights);
        Self::with(weights, entry)
    }

    /// Makes a version whose VAE has these bytes as weights, in blobs of `chunk` bytes.
    pub fn in_chunks(weights: Vec<u8>, chunk: usize) -> Self {
        let cut = weights.chunks(chunk).map(|part| Chunk { digest: Digest::of(part), bytes: part.len() as u64 });
        let entry = FileEntry { chunks: cut.collect(), ..listed(&weights) };
        Self::with(weights, entry)
    }

    fn with(weights: Vec<u8>, entry: FileEntry) -> Self {
        let other = b"some weights".to_vec();
        let vae = part(ArtifactKind::Vae, json!({"features": 263, "mean": [0.5], "std": [1.0]}), entry);
        let text = Manifest::new(ArtifactKind::TextEncoder, json!({"encoder": "hashed", "dim": 4}));
        let fits = json!({"vae": vae.digest(), "text": text.digest()});
        let denoiser = part(ArtifactKind::Denoiser, json!({"fits": fits}), listed(&other));
        let parts = BTreeMap::from([(Role::VAE, vae), (Role::TEXT, text), (Role::DENOISER, denoiser)]);
        let manifest = assemble("latent-diffusion", DataFormat::Humanml3d, &parts).expect("parts that fit");
        let sampled = extend(&manifest, Some(&Sampler::default()), &BTreeMap::new());
        let manifest = sampled.expect("parts that fit");
        let mut files: BTreeMap<Digest, Vec<u8>> =
            parts.values().map(|part| (part.digest(), part.to_bytes())).collect();
        files.extend([weights, other].map(|bytes| (Digest::of(&bytes), bytes)));
        let metrics = BTreeMap::from([("fid".to_owned(), Some(0.25)), ("odd".to_owned(), None)]);
        let source = json!({"run": "r-1", "stage": "lcm", "metric": "fid", "mode": "min"});
        let model = ModelName::new("quick");
        let head = Head { format: FORMAT, model, version: 3, artifact: manifest.digest(), metrics, source };
        Self { head, manifest, files }
    }

    /// Returns the entries of its bundle in order, to be changed by a test.
    ///
    /// # Panics
    /// Panics if its head cannot be serialised, which would be an error in this function.
    pub fn entries(&self) -> Vec<Entry> {
        let head = serde_json::to_vec(&self.head).expect("a head is JSON");
        let file = |(name, entry): (&String, &FileEntry)| regular(name, self.files[&entry.digest].clone());
        let first = [
            regular("bundle.json", head),
            regular("manifest.json", self.manifest.to_bytes()),
            regular("card.md", b"# a card\n".to_vec()),
        ];
        first.into_iter().chain(self.manifest.files.iter().map(file)).collect()
    }

    /// Returns the entries with other bytes as the model's manifest, and their digest in the head.
    fn with_manifest(&self, manifest: Vec<u8>) -> Vec<Entry> {
        let mut changed = self.clone();
        changed.head.artifact = Digest::of(&manifest);
        let mut entries = changed.entries();
        entries[1].2 = manifest;
        entries
    }

    /// Returns the entries with other bytes as the denoiser's manifest, and their digest in the model's.
    fn with_denoiser(&self, part: Vec<u8>) -> Vec<Entry> {
        let mut changed = self.clone();
        changed.manifest.meta["parts"]["denoiser"] = json!(Digest::of(&part));
        changed.manifest.files.insert("denoiser/manifest.json".into(), listed(&part));
        changed.files.insert(Digest::of(&part), part);
        changed.head.artifact = changed.manifest.digest();
        changed.entries()
    }
}

/// Makes an archive entry of a regular file.
pub fn regular(name: &str, content: Vec<u8>) -> Entry {
    (name.to_owned(), EntryType::Regular, content)
}

/// Makes an archive of entries without checking their names.
pub fn archive(entries: &[Entry]) -> Vec<u8> {
    let mut tar = Vec::new();
    for (name, kind, content) in entries {
        let mut header = Header::new_ustar();
        header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
        header.set_entry_type(*kind);
        header.set_size(content.len() as u64);
        header.set_cksum();
        tar.extend_from_slice(header.as_bytes());
        tar.extend_from_slice(content);
        tar.resize(tar.len().next_multiple_of(512), 0);
    }
    tar.resize(tar.len() + 1024, 0);
    tar
}

/// Compresses an archive.
///
/// # Panics
/// Panics if memory is exhausted.
pub fn compressed(archive: &[u8]) -> Vec<u8> {
    zstd::encode_all(archive, 1).expect("in memory")
}

/// Interpretation of the bytes for [`bundle`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// The bytes of a whole bundle.
    File,
    /// An archive to be compressed.
    Archive,
    /// The model's manifest, in a bundle whose head has its digest.
    Manifest,
    /// The denoiser's manifest, in a bundle whose model has its digest.
    Denoiser,
}

impl Form {
    const ALL: [Self; 4] = [Self::File, Self::Archive, Self::Manifest, Self::Denoiser];

    /// Puts the byte of this form before the bytes.
    pub fn marked(self, bytes: &[u8]) -> Vec<u8> {
        [&[self as u8], bytes].concat()
    }

    fn file(self, bytes: &[u8]) -> Vec<u8> {
        let whole = || Whole::of(vec![7; 3000]);
        match self {
            Self::File => bytes.to_vec(),
            Self::Archive => compressed(bytes),
            Self::Manifest => compressed(&archive(&whole().with_manifest(bytes.to_vec()))),
            Self::Denoiser => compressed(&archive(&whole().with_denoiser(bytes.to_vec()))),
        }
    }
}

/// A sink in memory that asserts the guarantees of [`Sink`]'s caller.
#[derive(Debug, Default)]
struct Held {
    open: Option<(Digest, u64, Vec<u8>)>,
    files: BTreeMap<Digest, Vec<u8>>,
}

impl Sink for Held {
    fn begin(&mut self, digest: Digest, bytes: u64) -> Result<(), BlobError> {
        let before = self.open.replace((digest, bytes, Vec::new()));
        assert!(before.is_none(), "a file began before the last one ended");
        Ok(())
    }

    fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        let (_, _, content) = self.open.as_mut().expect("a file was begun");
        content.extend_from_slice(piece);
        Ok(())
    }

    fn end(&mut self, digest: Digest) -> Result<(), BlobError> {
        let (announced, bytes, content) = self.open.take().expect("a file was begun");
        assert_eq!((announced, bytes), (digest, content.len() as u64), "another file was announced");
        assert_eq!(Digest::of(&content), digest, "a file of another digest");
        self.files.insert(digest, content);
        Ok(())
    }
}

impl Held {
    /// Asserts that all files of an accepted bundle were passed, and that it can be shown and exported again.
    fn expect_whole(&self, found: &Bundle) {
        let manifest = &found.manifest;
        assert_eq!(self.files.get(&manifest.digest()), Some(&manifest.to_bytes()));
        for Chunk { digest, bytes } in manifest.blobs() {
            let given = self.files.get(&digest).unwrap_or_else(|| panic!("{digest} was not given"));
            assert_eq!(given.len() as u64, bytes, "{digest}");
        }
        let model = Model::read(manifest).expect("it was read");
        let given: BTreeSet<&Role> = model.parts.keys().collect();
        let read = |digest: &Digest| serde_json::from_slice(&self.files[digest]).expect("it was read");
        let parts: BTreeMap<Role, Manifest> =
            model.parts.iter().map(|(role, digest)| (role.clone(), read(digest))).collect();
        assert_eq!(given, parts.keys().collect());
        let metrics = found.head.metrics.iter().map(|(name, value)| (name.clone(), value.unwrap_or(f64::NAN)));
        let version = crate::Version {
            model: found.head.model.clone(),
            version: found.head.version,
            artifact: found.head.artifact,
            metrics: metrics.collect(),
            source: found.head.source.clone(),
            created_ms: 0,
            aliases: Vec::new(),
        };
        let card = card(&version, manifest, &model, &parts);
        assert!(card.chars().all(|c| c == '\n' || !c.is_control()), "{card:?}");
    }
}

/// A store of this process, and the path of the imported file.
struct World {
    runtime: Runtime,
    store: Store,
    file: PathBuf,
}

fn world() -> &'static World {
    static WORLD: OnceLock<World> = OnceLock::new();
    WORLD.get_or_init(|| {
        let folder = std::env::temp_dir().join(format!("stride-bundles-{}", std::process::id()));
        let runtime = Runtime::new().expect("threads");
        let opened = runtime.block_on(Store::open(&folder.join("store"), Holder::this_process("test")));
        World { runtime, store: opened.expect("a store of ours"), file: folder.join("bundle.tar.zst") }
    })
}

/// Imports bytes into a store of this process; the first byte is their [`Form`]. Returns true if they were accepted.
///
/// # Panics
/// Panics if a guarantee is broken.
pub fn bundle(bytes: &[u8]) -> bool {
    let Some((form, bytes)) = bytes.split_first() else { return false };
    let file = Form::ALL[usize::from(*form) % Form::ALL.len()].file(bytes);
    let mut held = Held::default();
    let read = bundle::read(&file[..], &mut held);
    if let Ok(found) = &read {
        held.expect_whole(found);
    }
    let World { runtime, store, file: path } = world();
    fs::write(path, &file).expect("a file of ours");
    match runtime.block_on(store.import_bundle(path, None)) {
        Ok(version) => {
            let found = read.expect("what is not whole is not imported");
            assert_eq!((version.artifact, &version.model), (found.manifest.digest(), &found.head.model));
            assert!(bundle::origin(&version.source).is_some(), "{}", version.source);
            true
        }
        Err(ImportError::Bundle(_)) => {
            assert!(read.is_err(), "one reading accepts it and another does not");
            false
        }
        // The store has its own rules for versions.
        Err(ImportError::Write(WriteError::Conflict(_) | WriteError::NotFound(_))) => false,
        Err(other) => panic!("{other}"),
    }
}
