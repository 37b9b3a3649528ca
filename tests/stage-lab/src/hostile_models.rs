//! `import.model` on arbitrary bytes for every part, for `tests/hostile.rs` and `fuzz/`, and small networks as seeds.
//!
//! Shapes decide the use of a file, and a mutated file hardly ever has shapes that agree with its length. So bytes are
//! also read as a list of names and shapes, from which a file of zeros with that content is made.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::io::Cursor;

use burn::module::Module;
use burn::tensor::Device;
use checkpoint::Blobs as _;
use checkpoint::torch;
use models::flat;
use models::networks::{
    Denoiser, DenoiserConfig, FlowUnet, Gpt, GptConfig, Init, MaskedTransformer, Mdm, MdmConfig, Mmm, MmmConfig,
    MomaskConfig, Projection, ResidualTransformer, TimeFeatures, Tokenizer, TrajectoryConfig, TrajectoryEncoder,
    UnetConfig, Vae, VaeConfig,
};
use motion::text::EMBEDDING_WIDTH;
use motion::{Stream, npy};
use protocol::artifact::Role;
use protocol::stage::{
    DataFormat, FlowSolver, ImportModel, ImportedPart, LatentShape, MdmNetwork, Network, Positions, Sampler,
    StageSettings, TokenNetwork, TokenizerNetwork,
};
use protocol::{ArtifactKind, Digest, Manifest, Seed};
use serde_json::json;

use super::Bench;
use super::hostile::{accepted, folder};
use stages::artifacts::{EmbeddingsMeta, to_meta};
use stages::context::StageError;
use stages::generate::Generator;
use stages::parts::flow_decoder::FlowDecoder;
use stages::parts::latent_networks::Autoencoder;
use stages::parts::text;
use stages::parts::tokenizer::{TokenizerMeta, TrainedTokenizer};

/// All parts, in the order of the byte that selects one.
pub const PARTS: [ImportedPart; 10] = [
    ImportedPart::Vae,
    ImportedPart::Mld,
    ImportedPart::Lcm,
    ImportedPart::Control,
    ImportedPart::Tokenizer,
    ImportedPart::T2mgpt,
    ImportedPart::Momask,
    ImportedPart::Mmm,
    ImportedPart::Mdm,
    ImportedPart::Discord,
];

/// Form of the bytes after the first two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// A torch file.
    Torch,
    /// A safetensors file.
    Safetensors,
    /// Lines of an element's type, a name and a shape.
    List,
}

const FORMS: [Form; 3] = [Form::Torch, Form::Safetensors, Form::List];

/// Number of features of a frame, and of joints.
const FEATURES: usize = 263;
const JOINTS: usize = 22;
/// Width of every layer whose width is free.
const WIDTH: usize = 4;
/// Number of frames that are encoded and generated.
const FRAMES: usize = 12;
/// Number of codebooks of MoMask's tokenizer.
const BOOKS: usize = 3;
/// Largest number of zero bytes after a list.
const ZEROS: usize = 4 << 20;
/// Bytes of imported artifacts after which all are dropped.
const KEPT: usize = 32 << 20;

/// Tensors by name: their shapes and numbers.
pub type Named = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn add<M: Module>(all: &mut Named, prefix: &str, network: &M) {
    let values = flat::read(network);
    let mut rest = values.as_slice();
    for entry in flat::layout(network) {
        let (own, later) = rest.split_at(entry.len());
        rest = later;
        all.insert(format!("{prefix}{}", entry.name), (entry.shape, own.to_vec()));
    }
}

/// A VAE, and a denoiser of its latents, which is a student's if it embeds `guidance`.
fn latent_diffusion(all: &mut Named, guidance: Option<usize>) -> DenoiserConfig {
    let device = Device::flex();
    let mut init = Init::new(Seed(0), "small", Positions::Uniform, &device);
    let width = WIDTH;
    let vae = VaeConfig {
        features: FEATURES,
        latent: LatentShape { tokens: 1, dim: width },
        network: Network { width, layers: 3, heads: 1, feed_forward: 2, ..Network::default() },
        projection: false,
    };
    add(all, "vae.", &Vae::new(&vae, &mut init));
    let denoiser = DenoiserConfig {
        latent: LatentShape { tokens: 1, dim: width },
        network: Network { width, layers: 3, heads: 1, feed_forward: 2, ..Network::default() },
        text_dim: EMBEDDING_WIDTH,
        time_dim: 4,
        text_relu: true,
        projection: false,
        guidance_dim: guidance,
    };
    add(all, "denoiser.", &Denoiser::new(&denoiser, &mut init));
    denoiser
}

fn tokenizer(books: usize) -> Named {
    let meta = TokenizerMeta {
        format: DataFormat::Humanml3d,
        features: FEATURES,
        codes: 2,
        code_dim: WIDTH,
        quantizers: books,
        network: TokenizerNetwork { width: WIDTH, depth: 1, growth: 3, ..TokenizerNetwork::default() },
        mean: Vec::new(),
        std: Vec::new(),
    };
    let device = Device::flex();
    let mut all = Named::new();
    add(&mut all, "", &Tokenizer::new(&meta.config(), &mut Init::new(Seed(0), "small", Positions::Uniform, &device)));
    for book in 0..books {
        all.insert(format!("quantizer.layers.{book}.codebook"), (vec![2, WIDTH], vec![0.5; 2 * WIDTH]));
    }
    all
}

/// A small network of a part, under published names.
pub fn small(part: ImportedPart) -> Named {
    let device = Device::flex();
    let mut init = Init::new(Seed(1), "small", Positions::Uniform, &device);
    let init = &mut init;
    let mut all = Named::new();
    let (width, layers, heads, text_dim, codes, feed_forward) = (WIDTH, 1, 1, EMBEDDING_WIDTH, 2, 2);
    let network = |feed_forward| TokenNetwork {
        width,
        layers,
        heads,
        feed_forward,
        embedding: width,
        word_blocks: 1,
        ..TokenNetwork::default()
    };
    match part {
        ImportedPart::Vae => {
            latent_diffusion(&mut all, None);
            all.retain(|name, _| name.starts_with("vae."));
        }
        ImportedPart::Mld => _ = latent_diffusion(&mut all, None),
        ImportedPart::Lcm => _ = latent_diffusion(&mut all, Some(4)),
        ImportedPart::Control => {
            let denoiser = latent_diffusion(&mut all, Some(4));
            add(&mut all, "controlnet.", &Denoiser::controlnet(&denoiser, 3, false, init));
            let trajectory = TrajectoryConfig {
                joints: JOINTS,
                latent: LatentShape { tokens: 1, dim: width },
                network: Network { width, layers: 3, heads, feed_forward, ..Network::default() },
                projection: false,
            };
            add(&mut all, "traj_encoder.", &TrajectoryEncoder::new(&trajectory, init));
        }
        ImportedPart::Tokenizer => return tokenizer(1),
        ImportedPart::T2mgpt => {
            let config = GptConfig { codes, network: network(WIDTH), block: 51, text_dim };
            add(&mut all, "trans.", &Gpt::new(&config, init));
        }
        ImportedPart::Momask => {
            let config = MomaskConfig { codes, quantizers: BOOKS, network: network(feed_forward), text_dim };
            add(&mut all, "mask.", &MaskedTransformer::new(&config, init));
            add(&mut all, "res.", &ResidualTransformer::new(&config, true, init));
        }
        ImportedPart::Mmm => {
            let config = MmmConfig { codes, dim: WIDTH, network: network(WIDTH), block: 51, text_dim };
            add(&mut all, "trans.", &Mmm::new(&config, init));
        }
        ImportedPart::Mdm => {
            let network = MdmNetwork { width, layers, heads, feed_forward, ..MdmNetwork::default() };
            let config = MdmConfig { features: FEATURES, network, text_dim };
            add(&mut all, "", &Mdm::new(&config, init));
        }
        ImportedPart::Discord => {
            let config = UnetConfig {
                features: FEATURES,
                width: 8,
                multiples: vec![1, 2],
                token_dim: WIDTH,
                condition_dim: 4,
                blocks: 1,
                projection: Projection::Repeat,
                attention: None,
                time: TimeFeatures::Sinusoid,
                theta: 10_000.0,
                learned_variance: false,
            };
            add(&mut all, "", &FlowUnet::new(&config, init));
        }
    }
    all
}

/// Serialises tensors as bytes for [`model`].
///
/// # Panics
/// If they cannot be serialised.
pub fn marked(part: ImportedPart, form: Form, all: &Named) -> Vec<u8> {
    let bytes: BTreeMap<&String, Vec<u8>> =
        all.iter().map(|(name, (_, values))| (name, values.iter().flat_map(|v| v.to_le_bytes()).collect())).collect();
    let content = match form {
        Form::Torch => {
            let tensor = |(name, (shape, _)): (&String, &(Vec<usize>, Vec<f32>))| {
                (name.clone(), torch::Tensor { shape: shape.clone(), bytes: &bytes[name] })
            };
            let mut out = Cursor::new(Vec::new());
            torch::write(&mut out, None, &all.iter().map(tensor).collect()).expect("in memory");
            out.into_inner()
        }
        Form::Safetensors => {
            let lines = list(all);
            let header = header(&lines);
            [
                &(header.len() as u64).to_le_bytes()[..],
                header.as_bytes(),
                &bytes.into_values().collect::<Vec<_>>().concat(),
            ]
            .concat()
        }
        Form::List => {
            // Parts that the network is used with do not have zero weights.
            let others: &[&str] = match part {
                ImportedPart::Mld | ImportedPart::Lcm => &["vae."],
                ImportedPart::Control => &["vae.", "denoiser."],
                _ => &[],
            };
            let mut own = all.clone();
            own.retain(|name, _| !others.iter().any(|other| name.starts_with(other)));
            list(&own).into_bytes()
        }
    };
    let which = PARTS.iter().position(|other| *other == part).expect("a part");
    [&[which as u8, form as u8], &content[..]].concat()
}

fn list(all: &Named) -> String {
    all.iter().fold(String::new(), |mut text, (name, (shape, _))| {
        let shape: Vec<String> = shape.iter().map(usize::to_string).collect();
        writeln!(text, "F32 {name} {}", shape.join(" ")).expect("a text");
        text
    })
}

/// The safetensors header that a list describes, and the length of the tensors.
fn described(lines: &str) -> (String, u64) {
    let (mut header, mut end) = (serde_json::Map::new(), 0_u64);
    for line in lines.lines() {
        let mut words = line.split(' ');
        let (Some(element), Some(name)) = (words.next(), words.next()) else { continue };
        let shape: Vec<u64> = words.map_while(|word| word.parse().ok()).collect();
        let width = match element {
            "F64" | "I64" => 8,
            "F16" | "BF16" => 2,
            "U8" | "BOOL" => 1,
            _ => 4,
        };
        let begin = end;
        end = shape.iter().fold(width, |all: u64, axis| all.saturating_mul(*axis)).saturating_add(begin);
        header.insert(name.to_owned(), json!({"dtype": element, "shape": shape, "data_offsets": [begin, end]}));
    }
    (serde_json::Value::Object(header).to_string(), end)
}

fn header(lines: &str) -> String {
    described(lines).0
}

/// Inputs of the parts besides their files.
struct World {
    bench: Bench,
    text: Digest,
    vae: Digest,
    lcm: Digest,
    /// Tokenizers with one codebook and with [`BOOKS`].
    tokenizers: [Digest; 2],
}

/// A folder of statistics that normalise nothing.
fn statistics() -> String {
    let folder = folder("statistics");
    for (name, count, value) in [
        ("mean.npy", FEATURES, 0.0),
        ("std.npy", FEATURES, 1.0),
        ("Mean_raw.npy", 3 * JOINTS, 0.0),
        ("Std_raw.npy", 3 * JOINTS, 1.0),
    ] {
        let file = folder.join(name);
        if !file.exists() {
            npy::write(&file, &[count], &vec![value; count]).expect("a file of ours");
        }
    }
    folder.display().to_string()
}

fn settings(part: ImportedPart, form: Form, bytes: &[u8]) -> ImportModel {
    let file = folder("models").join(if form == Form::Torch { "weights.ckpt" } else { "weights.safetensors" });
    fs::write(&file, bytes).expect("a file of ours");
    let path = file.display().to_string();
    let residual = if part == ImportedPart::Momask { path.clone() } else { String::new() };
    let statistics = statistics();
    ImportModel {
        part,
        path,
        residual,
        heads: 1,
        hint_statistics: statistics.clone(),
        statistics,
        solver: FlowSolver::Euler,
        solver_steps: 1,
        timesteps: 4,
        ..ImportModel::default()
    }
}

impl World {
    fn new() -> Self {
        let mut bench = Bench::new(Device::flex(), 1, 1);
        let blobs = bench.blobs();
        let encoder = blobs.put(text::built_in().to_bytes()).expect("in memory");
        let meta = to_meta(&EmbeddingsMeta { text: encoder, dim: EMBEDDING_WIDTH, captions: 1 });
        let text = blobs.put(Manifest::new(ArtifactKind::Embeddings, meta).to_bytes()).expect("in memory");
        let mut import = |part, all: &Named, inputs: &[(&str, Digest)]| {
            let bytes = marked(part, Form::Safetensors, all);
            let settings = settings(part, Form::Safetensors, &bytes[2..]);
            let ran = bench.run("released", &StageSettings::ImportModel(settings), inputs);
            ran.unwrap_or_else(|e| panic!("{}: {e}", part.name())).output()
        };
        let vae = import(ImportedPart::Vae, &small(ImportedPart::Vae), &[]);
        let lcm = import(ImportedPart::Lcm, &small(ImportedPart::Lcm), &[("vae", vae), ("text", text)]);
        let tokenizers = [1, BOOKS].map(|books| import(ImportedPart::Tokenizer, &tokenizer(books), &[]));
        Self { bench, text, vae, lcm, tokenizers }
    }

    fn inputs(&self, part: ImportedPart) -> Vec<(&'static str, Digest)> {
        let [one, many] = self.tokenizers;
        let text = ("text", self.text);
        match part {
            ImportedPart::Vae | ImportedPart::Tokenizer => Vec::new(),
            ImportedPart::Mld | ImportedPart::Lcm => vec![("vae", self.vae), text],
            ImportedPart::Control => vec![("model", self.lcm)],
            ImportedPart::T2mgpt | ImportedPart::Mmm => vec![("tokenizer", one), text],
            ImportedPart::Momask => vec![("tokenizer", many), text],
            ImportedPart::Mdm => vec![text],
            ImportedPart::Discord => vec![("tokenizer", one)],
        }
    }

    /// Opens the imported artifact and uses it, as the stages and commands do.
    fn open(&self, part: ImportedPart, digest: Digest) -> Result<(), StageError> {
        let (blobs, device) = (self.bench.blobs(), self.bench.device());
        let manifest = self.bench.manifest(digest)?;
        let tokenizer = |manifest: &Manifest| TrainedTokenizer::read(&*blobs, manifest, &device);
        match part {
            ImportedPart::Vae => {
                let vae = Autoencoder::read(&*blobs, &manifest, &device)?;
                let frames = vae.max_frames().min(FRAMES);
                let z = vae.encode(vec![0.5; frames * FEATURES], frames).mu;
                assert_eq!(vae.decode(z, frames).len(), frames * FEATURES);
            }
            ImportedPart::Tokenizer => {
                let tokenizer = tokenizer(&manifest)?;
                let ids = tokenizer.encode(vec![0.5; FRAMES * FEATURES]);
                assert_eq!(tokenizer.decode(&ids).len(), FRAMES * FEATURES);
            }
            ImportedPart::Discord => {
                let tokenizer = tokenizer(&self.bench.manifest(self.tokenizers[0])?)?;
                let role = (&Role::TOKENIZER, self.tokenizers[0]);
                let decoder = FlowDecoder::read(&*blobs, &manifest, role, &device)?;
                let rows = decoder.decode(&tokenizer, &[0, 1, 0], &mut Stream::new(Seed(0), "noise", 0, 0));
                assert_eq!(rows.len(), 12 * FEATURES);
            }
            _ => {
                let generator = Generator::load(&manifest, &*blobs, &device)?;
                let frames = generator.longest().min(FRAMES);
                // The smallest number of steps with a sampler.
                let few = Sampler { steps: 2, ..generator.sampler() };
                let sampler = if generator.check_sampler(&few).is_ok() { few } else { generator.sampler() };
                let drawn = generator.generate("a person walks", Some(frames), Some(&sampler), Seed(0));
                // Arbitrary weights may lead to values that are no motion; only a fault of ours is an error.
                accepted(drawn);
            }
        }
        Ok(())
    }
}

thread_local! {
    static WORLD: RefCell<Option<World>> = const { RefCell::new(None) };
}

/// Runs `import.model`: the first byte selects the part, the second the [`Form`] of the others.
///
/// # Panics
/// If it fails in another way than refusing them, or if its result cannot be opened.
pub fn model(bytes: &[u8]) -> bool {
    let [part, form, content @ ..] = bytes else { return false };
    let part = PARTS[usize::from(*part) % PARTS.len()];
    let form = FORMS[usize::from(*form) % FORMS.len()];
    let made = (form == Form::List).then(|| {
        let (header, length) = described(&String::from_utf8_lossy(content));
        // A list of more than the limit gives a file that is shorter than it declares.
        let zeros = usize::try_from(length).ok().filter(|length| *length <= ZEROS).unwrap_or_default();
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &vec![0; zeros]].concat()
    });
    let kept = WORLD.take().filter(|world| world.bench.blobs().total_bytes() < KEPT);
    let mut world = kept.unwrap_or_else(World::new);
    let settings = settings(part, form, made.as_deref().unwrap_or(content));
    let inputs = world.inputs(part);
    let ran = world.bench.run("released", &StageSettings::ImportModel(settings), &inputs);
    let imported = ran.as_ref().ok().map(super::Ran::output);
    let good = accepted(ran);
    if let Some(digest) = imported {
        world.open(part, digest).unwrap_or_else(|e| panic!("{} was imported and does not open: {e}", part.name()));
    }
    WORLD.set(Some(world));
    good
}
