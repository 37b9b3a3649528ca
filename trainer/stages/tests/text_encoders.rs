//! Published text encoders from their folders (fixtures `09_text_clip*`, `09_text_t5*`): their vectors, from the folder
//! and from an artifact, and models that are trained and sampled with them.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use burn::tensor::Device;
use protocol::message::StageTask;
use protocol::stage::{
    Batch, CheckpointPolicy, ClipIds, ClipOutput, DataSynthetic, Sampler, StableMoFusionNetwork, StageSettings,
    TextEmbed, TextEncoder, TrainStableMoFusion, Training,
};
use protocol::{ArtifactKind, Digest, Manifest, RunId, Seed, StageName, Steps};
use serde_json::{Value, json};
use stage_lab::{Bench, MemoryAttempt, MemoryBlobs};
use stages::artifacts::{Embeddings, Tensors};
use stages::external;
use stages::generate::Generator;
use stages::parts::text::{self, Named};

mod common;

/// Gate of one forward pass, from the fixtures' README.
const GATE: f64 = 3e-6;

fn captions(folder: &Path) -> Vec<String> {
    let bytes = std::fs::read(folder.join("captions.json")).expect("a file of the fixture");
    serde_json::from_slice(&bytes).expect("a list of captions")
}

/// The fixture's arrays.
fn arrays(folder: &Path) -> Tensors {
    let bytes = std::fs::read(folder.join("io.safetensors")).expect("a file of the fixture");
    Tensors::from_bytes(bytes.into(), "io").expect("floats and integers")
}

fn clip(folder: &Path, ids: ClipIds, output: ClipOutput, max_tokens: usize) -> TextEmbed {
    let path = folder.display().to_string();
    TextEmbed { encoder: TextEncoder::Clip, path, output, ids, max_tokens, ..TextEmbed::default() }
}

fn t5(folder: &Path, encoder: TextEncoder) -> TextEmbed {
    TextEmbed { encoder, path: folder.display().to_string(), ..TextEmbed::default() }
}

fn close(what: &str, found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let largest = expected.iter().fold(0.0_f64, |most, v| most.max(f64::from(v.abs())));
    let off = found.iter().zip(expected).fold(0.0_f64, |most, (a, b)| most.max((f64::from(*a) - f64::from(*b)).abs()));
    assert!(off <= GATE * largest, "{what}: off by {:e} of the largest", off / largest);
}

/// The encoder in a folder, and an attempt at embedding with it.
fn named(settings: &TextEmbed, blobs: &Arc<MemoryBlobs>) -> (Named, MemoryAttempt) {
    let task = StageTask {
        run: RunId::new("test-1"),
        name: StageName::new("text"),
        settings: settings.clone().into(),
        inputs: BTreeMap::new(),
        seed: Seed(1),
        checkpoint: CheckpointPolicy::default(),
    };
    let mut cx = MemoryAttempt::new(task, Device::flex(), Arc::clone(blobs));
    let named = external::read(&mut cx, |_, given| Named::open(settings, given)).unwrap_or_else(|e| panic!("{e}"));
    (named, cx)
}

/// The encoder in a folder.
fn ready(settings: &TextEmbed) -> Box<dyn text::TextEncoder> {
    let (named, _) = named(settings, &Arc::default());
    named.ready(settings, &Device::flex()).unwrap_or_else(|e| panic!("{e}"))
}

/// That of the artifact which is made of the folder.
fn stored(settings: &TextEmbed) -> Box<dyn text::TextEncoder> {
    let blobs = Arc::new(MemoryBlobs::default());
    let (named, mut cx) = named(settings, &blobs);
    let manifest = named.upload(&mut cx).unwrap_or_else(|e| panic!("{e}"));
    text::open(&manifest, &*blobs, &Device::flex()).unwrap_or_else(|e| panic!("{e}"))
}

fn same_out_of_an_artifact(settings: &TextEmbed, encoder: &dyn text::TextEncoder, captions: &[&str]) {
    let stored = stored(settings);
    assert_eq!((stored.dim(), stored.token_dim()), (encoder.dim(), encoder.token_dim()));
    assert_eq!(stored.pooled(captions).expect("embeds"), encoder.pooled(captions).expect("embeds"));
    assert_eq!(stored.tokens(captions).expect("embeds"), encoder.tokens(captions).expect("embeds"));
}

#[test]
fn parity_of_clip_from_its_folder() {
    for folder in fixtures::parity(&["09_text_clip"]) {
        let owned = captions(&folder);
        let captions: Vec<&str> = owned.iter().map(String::as_str).collect();
        let mut io = arrays(&folder);
        let listed: Vec<usize> =
            io.take_integers("states_of_captions", 1, "io").expect("rows").values.iter().map(|i| *i as usize).collect();
        let mut tried = 0;
        // The inputs of the published models; the two ways of padding have the same pooled vector and different words.
        for (case, ids, most) in
            [("hf77", ClipIds::HuggingFace, 0), ("openai77", ClipIds::OpenAi, 0), ("mdm22", ClipIds::OpenAi, 22)]
        {
            for (name, output) in [("text_embeds", ClipOutput::Projected), ("pooled", ClipOutput::Pooled)] {
                let Ok(expected) = io.take(&format!("{case}/{name}"), 2, "io") else { continue };
                let settings = clip(&folder, ids, output, most);
                let encoder = ready(&settings);
                assert_eq!(encoder.dim(), expected.row_len());
                let what = format!("{}: {case}/{name}", folder.display());
                close(&what, &encoder.pooled(&captions).expect("embeds"), &expected.values);
                same_out_of_an_artifact(&settings, &*encoder, &captions[..2]);
                tried += 1;
                if name == "pooled" {
                    continue;
                }
                let Ok(expected) = io.take(&format!("{case}/last_hidden_state"), 3, "io") else { continue };
                for (at, i) in listed.iter().enumerate() {
                    let found = encoder.tokens(&captions[*i..=*i]).expect("embeds").remove(0);
                    assert_eq!(found.len() % encoder.token_dim(), 0);
                    close(&format!("{what}: words of caption {i}"), &found, expected.row(at));
                }
            }
        }
        assert!(tried >= 5, "{tried} cases in {}", folder.display());
    }
}

#[test]
fn parity_of_t5_from_its_folder() {
    for folder in fixtures::parity(&["09_text_t5"]) {
        let owned = captions(&folder);
        let captions: Vec<&str> = owned.iter().map(String::as_str).collect();
        let mut io = arrays(&folder);
        let listed: Vec<usize> =
            io.take_integers("states_of_captions", 1, "io").expect("rows").values.iter().map(|i| *i as usize).collect();
        let sentence = std::fs::read(folder.join("sentence_bert_config.json")).expect("a file of the fixture");
        let sentence: Value = serde_json::from_slice(&sentence).expect("JSON");
        let longest = sentence["max_seq_length"].as_u64().expect("a number") as usize;
        // The gated network has no tokenizer of its own.
        let gated = tempfile::tempdir().expect("a folder");
        for (from, name) in [
            ("gated/config.json", "config.json"),
            ("gated/model.safetensors", "model.safetensors"),
            ("tokenizer.json", "tokenizer.json"),
        ] {
            std::fs::copy(folder.join(from), gated.path().join(name)).expect("a file of the fixture");
        }
        for (settings, pooled, states) in [
            (t5(&folder, TextEncoder::SentenceT5), "sentence/embedding", "states"),
            (t5(&folder, TextEncoder::T5), "sentence/pooled", ""),
            (t5(gated.path(), TextEncoder::T5), "gated/pooled", "states_gated"),
        ] {
            // All are stored at the length of the sentence encoder; T5 itself would cut later.
            let settings = TextEmbed { max_tokens: longest, ..settings };
            let encoder = ready(&settings);
            let what = format!("{}: {pooled}", folder.display());
            let expected = io.take(pooled, 2, "io").expect("vectors");
            assert_eq!(encoder.dim(), expected.row_len());
            close(&what, &encoder.pooled(&captions).expect("embeds"), &expected.values);
            same_out_of_an_artifact(&settings, &*encoder, &captions[..2]);
            for i in listed.iter().filter(|_| !states.is_empty()) {
                let expected = io.take(&format!("caption_{i}/{states}"), 2, "io").expect("states");
                let found = encoder.tokens(&captions[*i..=*i]).expect("embeds").remove(0);
                close(&format!("{what}: words of caption {i}"), &found, &expected.values);
            }
        }
    }
}

fn run(bench: &mut Bench, name: &str, settings: StageSettings, inputs: &[(&str, Digest)]) -> Digest {
    bench.run(name, &settings, inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output()
}

/// The vectors do not depend on the division into shards, and equal texts are embedded once.
#[test]
fn shards_change_no_byte() {
    let mut bench = Bench::new(Device::flex(), 7, 1);
    let data = DataSynthetic { clips: 12, ..DataSynthetic::default() };
    let dataset = run(&mut bench, "dataset", data.into(), &[]);
    let mut all = vec![TextEmbed::default()];
    all.extend(
        fixtures::parity(&["09_text_clip"]).iter().map(|path| clip(path, ClipIds::OpenAi, ClipOutput::Projected, 0)),
    );
    all.extend(fixtures::parity(&["09_text_t5"]).iter().map(|path| t5(path, TextEncoder::SentenceT5)));
    for settings in all {
        let mut embed = |shards: usize| {
            let settings = TextEmbed { shards, ..settings.clone() };
            bench.run("text", &settings.into(), &[("dataset", dataset)]).unwrap_or_else(|e| panic!("{e}"))
        };
        let (one, many) = (embed(1), embed(5));
        assert_eq!(one.output(), many.output(), "{settings:?}");
        assert!(one.metrics()["texts"] <= one.metrics()["captions"] + 1.0);
        let manifest = bench.manifest(one.output()).expect("stored");
        let embeddings = Embeddings::read(&*bench.blobs(), &manifest).expect("embeddings");
        let encoder = ready(&settings);
        assert_eq!(embeddings.null, encoder.pooled(&[""]).expect("embeds"), "{settings:?}");
        assert_eq!(embeddings.meta.dim, encoder.dim());
    }
    let nowhere = t5(Path::new("/nowhere/at/all"), TextEncoder::SentenceT5);
    let said = bench.run("text", &nowhere.into(), &[("dataset", dataset)]).unwrap_err().to_string();
    assert!(said.contains("/nowhere/at/all: no such folder"), "{said}");
}

/// A few steps of a latent model and of one that reads words, and motions of both, with encoders from folders that are
/// deleted by then.
#[test]
fn models_are_trained_and_drawn_with_encoders_of_folders() {
    let clips = fixtures::parity(&["09_text_clip"]);
    let t5s = fixtures::parity(&["09_text_t5"]);
    let (Some(clip_folder), Some(t5_folder)) = (clips.first(), t5s.first()) else { return };
    for settings in
        [clip(clip_folder, ClipIds::OpenAi, ClipOutput::Projected, 0), t5(t5_folder, TextEncoder::SentenceT5)]
    {
        let mut bench = Bench::new(Device::flex(), 7, 1);
        let mut outputs: BTreeMap<&str, Digest> = BTreeMap::new();
        for (name, chained, inputs) in common::chain(2, [2, 3, 2, 2]) {
            if !["dataset", "text", "vae", "latents", "mld", "eval-mld"].contains(&name) {
                continue;
            }
            let chained = if name == "text" { settings.clone().into() } else { chained };
            let inputs: Vec<(&str, Digest)> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
            outputs.insert(name, run(&mut bench, name, chained, &inputs));
        }
        // Enough steps for the zero-initialised layers to have an effect.
        let training = Training {
            batch: Batch { global: 4, slices: 2 },
            steps: Steps(6),
            lr: 1e-2,
            warmup: Steps(0),
            ..TrainStableMoFusion::default().training
        };
        let network = StableMoFusionNetwork {
            width: 32,
            multipliers: vec![1, 1],
            time: 16,
            text: 16,
            text_feed_forward: 16,
            text_heads: 2,
            text_layers: 1,
            ..StableMoFusionNetwork::default()
        };
        let words = TrainStableMoFusion { network, ema: 0.0, training, ..TrainStableMoFusion::default() };
        let inputs = [("dataset", outputs["dataset"]), ("text", outputs["text"])];
        outputs.insert("words", run(&mut bench, "words", words.into(), &inputs));

        let encoder = ready(&settings);
        for (name, width) in [("mld", encoder.dim()), ("words", encoder.token_dim())] {
            let manifest = bench.manifest(outputs[name]).expect("stored");
            let denoiser: Value = {
                let entry = &manifest.files["denoiser/manifest.json"];
                let bytes = checkpoint::Blobs::get(&*bench.blobs(), entry.digest).expect("a part");
                serde_json::from_slice(&bytes).expect("JSON")
            };
            assert_eq!(denoiser["meta"]["text_dim"], width, "{name}");
            assert!(manifest.files.contains_key("text/model.safetensors"), "a model holds its encoder");
            let generator = Generator::load(&manifest, &*bench.blobs(), &Device::flex()).expect("it opens");
            let sampler = Sampler { steps: 2, ..generator.sampler() };
            let draw =
                |caption: &str| generator.generate(caption, Some(40), Some(&sampler), Seed(3)).expect("it draws");
            let drawn = draw("a person walks forward.");
            assert!(drawn.features.iter().all(|v| v.is_finite()), "{name}");
            assert!(drawn.features == draw("a person walks forward.").features, "{name}: one seed, one motion");
            assert!(drawn.features != draw("someone jumps and turns").features, "{name}: the caption counts");
        }
    }
}

#[test]
fn an_encoder_is_opened_by_its_manifest_alone() {
    let blobs = MemoryBlobs::default();
    let open = |manifest: &Manifest| text::open(manifest, &blobs, &Device::flex());
    let encoder = open(&text::built_in()).expect("built in");
    let captions = ["a man walks", ""];
    let pooled = encoder.pooled(&captions).expect("built in");
    assert_eq!(pooled.len(), 2 * encoder.dim());
    let tokens = encoder.tokens(&captions).expect("built in");
    assert_eq!(
        tokens.iter().map(|rows| rows.len() / encoder.token_dim()).collect::<Vec<_>>(),
        [4, 1],
        "words and the end"
    );
    assert_eq!(tokens[1], pooled[encoder.dim()..], "an empty caption is its end alone");
    assert_ne!(tokens[0], encoder.tokens(&["a walks man"]).expect("built in")[0], "in order");

    let other = Manifest::new(ArtifactKind::TextEncoder, json!({"encoder": "bert", "dim": 512}));
    let refused = open(&other).expect_err("this build has no text encoder").to_string();
    assert!(refused.contains("`bert`") && refused.contains("hashed, clip, t5, sentence-t5"), "{refused}");
    let bare = Manifest::new(ArtifactKind::TextEncoder, json!({"encoder": "clip", "dim": 512}));
    let refused = open(&bare).expect_err("no sizes").to_string();
    assert!(refused.contains("cannot parse its manifest"), "{refused}");
    let refused = open(&Manifest::new(ArtifactKind::Vae, json!({}))).expect_err("a VAE").to_string();
    assert_eq!(refused, "the text encoder is a VAE; expected a text encoder");
}
