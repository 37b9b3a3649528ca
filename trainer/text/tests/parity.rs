//! The tokenizers and folders of the fixtures `09_text_clip*` and `09_text_t5*`: ids of every caption, cut and padded
//! as in published models.
//!
//! The fixtures drive the tests: every folder with these prefixes, every set of ids that its arrays name, with lengths
//! and padding from their shapes.

use motion::DataPath;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use safetensors::SafeTensors;
use serde_json::Value;
use text_models::{EncoderFolder, Kind, Network, Request, TokenIds, WeightsFile};

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("a file of the fixture")).expect("JSON")
}

fn captions(folder: &Path) -> Vec<String> {
    serde_json::from_value(json(&folder.join("captions.json"))).expect("a list of captions")
}

/// Reads the stored rows of ids by case.
fn ids(folder: &Path) -> BTreeMap<String, Vec<Vec<u32>>> {
    let bytes = std::fs::read(folder.join("io.safetensors")).expect("a file of the fixture");
    let stored = SafeTensors::deserialize(&bytes).expect("safetensors");
    let cases = stored.iter().filter_map(|(name, view)| Some((name.strip_suffix("/input_ids")?, view)));
    let rows = |data: &[u8], width: usize| -> Vec<Vec<u32>> {
        let all: Vec<u32> =
            data.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().expect("eight bytes")) as u32).collect();
        all.chunks(width).map(<[u32]>::to_vec).collect()
    };
    cases.map(|(case, view)| (case.to_owned(), rows(view.data(), view.shape()[1]))).collect()
}

fn clip(ids: TokenIds, most: usize) -> Request {
    Request { kind: Kind::Clip, ids, most }
}

/// Number of ids that the case `hf77`, `openai77` or `mdm22` is cut at, from the end of its name.
fn cut_at(case: &str) -> usize {
    let digits = case.trim_start_matches(|c: char| !c.is_ascii_digit());
    digits.parse().unwrap_or_else(|_| panic!("`{case}` ends with a number"))
}

#[test]
fn captions_become_clips_ids() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_clip"]) {
        let captions = captions(&folder);
        let mut tried = 0;
        for (case, expected) in ids(&folder) {
            let way = if case.starts_with("hf") { TokenIds::HuggingFace } else { TokenIds::OpenAi };
            let opened = EncoderFolder::open(&DataPath::local(&folder), &clip(way, cut_at(&case)))
                .unwrap_or_else(|e| panic!("{e}"));
            let tokenizer = opened.tokenizer().expect("it was opened");
            for (i, (caption, expected)) in captions.iter().zip(&expected).enumerate() {
                let (found, own) = tokenizer.padded(caption, expected.len()).unwrap_or_else(|e| panic!("{e}"));
                assert_eq!(found, *expected, "{}: {case}: caption {i}, {caption:?}", folder.display());
                assert_eq!(found[own - 1], tokenizer.rules().end);
                tried += 1;
            }
        }
        assert!(tried >= 2 * captions.len(), "{tried} captions in {}", folder.display());
        eprintln!("{}: {tried} captions", folder.display());
    }
}

#[test]
fn a_folder_without_its_tokenizer_file_is_read_from_vocabulary_and_merges() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_clip"]) {
        let copy = copy_of(&folder, &["tokenizer.json"]);
        let request = clip(TokenIds::HuggingFace, 0);
        let (whole, parts) = (
            EncoderFolder::open(&DataPath::local(&folder), &request),
            EncoderFolder::open(&DataPath::local(copy.path()), &request),
        );
        let (whole, parts) = (whole.expect("a fixture"), parts.unwrap_or_else(|e| panic!("{e}")));
        assert_eq!(whole.description, parts.description);
        let (whole, parts) = (whole.tokenizer().unwrap(), parts.tokenizer().unwrap());
        for caption in captions(&folder) {
            assert_eq!(whole.ids(&caption).unwrap(), parts.ids(&caption).unwrap(), "{caption:?}");
        }
        // The limit is the folder's own `model_max_length`, 77 in published folders.
        assert_eq!(whole.rules().most, json(&folder.join("tokenizer_config.json"))["model_max_length"]);
        let said =
            EncoderFolder::open(&DataPath::local(&folder), &clip(TokenIds::OpenAi, 10_000)).unwrap_err().to_string();
        assert!(said.contains("10000 tokens are requested"), "{said}");
        let said = EncoderFolder::open(&DataPath::local(&folder), &Request { kind: Kind::T5, ..request })
            .unwrap_err()
            .to_string();
        assert!(said.contains("`model_type` is `clip`; expected `t5`"), "{said}");
        std::fs::remove_file(copy.path().join("merges.txt")).unwrap();
        let said = EncoderFolder::open(&DataPath::local(copy.path()), &request).unwrap_err().to_string();
        assert!(said.contains("no `tokenizer.json`, and no `vocab.json` with `merges.txt`"), "{said}");
    }
}

#[test]
fn the_vision_tower_is_passed_over() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_clip"]) {
        let opened = EncoderFolder::open(&DataPath::local(&folder), &clip(TokenIds::OpenAi, 0)).expect("a fixture");
        let said = opened.skipped_line().expect("a vision tower");
        assert!(
            said.contains("vision_model*") && said.contains("logit_scale*") && said.contains("text_model* (1)"),
            "{said}"
        );
        let pieces = opened.weights().expect("weights");
        let whole = std::fs::metadata(folder.join("model.safetensors")).unwrap().len() as usize;
        assert!(pieces.iter().map(Vec::len).sum::<usize>() < whole, "less than with it");
        assert_eq!(opened.digest(&pieces), opened.digest(&opened.weights().unwrap()));
    }
}

#[test]
fn captions_become_t5s_ids() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_t5"]) {
        let captions = captions(&folder);
        let request = Request { kind: Kind::SentenceT5, ids: TokenIds::HuggingFace, most: 0 };
        let opened = EncoderFolder::open(&DataPath::local(&folder), &request).unwrap_or_else(|e| panic!("{e}"));
        let tokenizer = opened.tokenizer().expect("it was opened");
        let sentence = json(&folder.join("sentence_bert_config.json"));
        assert_eq!(tokenizer.rules().most, sentence["max_seq_length"]);
        let stored = ids(&folder);
        let expected = &stored["tokens"];
        assert_eq!(expected.len(), captions.len());
        for (i, (caption, expected)) in captions.iter().zip(expected).enumerate() {
            let (found, own) = tokenizer.padded(caption, expected.len()).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!(found, *expected, "{}: caption {i}, {caption:?}", folder.display());
            assert_eq!(found[own - 1], tokenizer.rules().end);
        }
        let dense = json(&folder.join("2_Dense/config.json"));
        let head = opened.description.head.clone().expect("a head");
        assert_eq!(head.width, dense["out_features"]);
        assert!(head.dense && head.normalise && !head.bias);
        eprintln!("{}: {} captions", folder.display(), captions.len());
    }
}

/// The dense layer is the same from safetensors and from torch's pickle.
#[test]
fn a_dense_layer_is_read_from_either_file() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_t5"]) {
        let request = Request { kind: Kind::SentenceT5, ids: TokenIds::HuggingFace, most: 0 };
        let pickled = copy_of(&folder, &["2_Dense/model.safetensors"]);
        let values = |path: &Path| {
            let opened = EncoderFolder::open(&DataPath::local(path), &request).unwrap_or_else(|e| panic!("{e}"));
            let (Network::T5(sizes), Some(head)) = (&opened.description.network, &opened.description.head) else {
                panic!("{:?}", opened.description)
            };
            let mut values = vec![0.0; sizes.d_model * head.width];
            let file = WeightsFile::open(Pieces(opened.weights().expect("weights").concat())).expect("a file of ours");
            file.read("dense.linear.weight", &mut values).expect("a dense layer");
            values
        };
        assert_eq!(values(&folder), values(pickled.path()));
    }
}

/// The older layout, with the network in its own folder and sharded weights, is the same encoder.
#[test]
fn shards_in_a_folder_below_are_the_same_encoder() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_t5"]) {
        let request = Request { kind: Kind::SentenceT5, ids: TokenIds::HuggingFace, most: 0 };
        let copy = copy_of(&folder, &["model.safetensors", "modules.json"]);
        let below = copy.path().join("0_Transformer");
        std::fs::create_dir(&below).expect("a folder");
        for file in std::fs::read_dir(copy.path()).expect("a folder").map(|entry| entry.expect("an entry").path()) {
            if file.is_file() {
                std::fs::rename(&file, below.join(file.file_name().expect("a name"))).expect("it moves");
            }
        }
        let mut modules = json(&folder.join("modules.json"));
        modules[0]["path"] = "0_Transformer".into();
        std::fs::write(copy.path().join("modules.json"), modules.to_string()).expect("a file");

        let bytes = std::fs::read(folder.join("model.safetensors")).expect("a file of the fixture");
        let stored = SafeTensors::deserialize(&bytes).expect("safetensors");
        let mut shards = [Vec::new(), Vec::new()];
        let mut places = serde_json::Map::new();
        for (i, (name, view)) in stored.iter().enumerate() {
            shards[i % 2].push((name, view));
            places.insert(name.to_owned(), format!("model-{}.safetensors", i % 2).into());
        }
        for (i, shard) in shards.into_iter().enumerate() {
            let bytes = safetensors::serialize(shard, None).expect("safetensors");
            std::fs::write(below.join(format!("model-{i}.safetensors")), bytes).expect("a file");
        }
        let index = serde_json::json!({"metadata": {}, "weight_map": places});
        std::fs::write(below.join("model.safetensors.index.json"), index.to_string()).expect("a file");

        let opened =
            |path: &Path| EncoderFolder::open(&DataPath::local(path), &request).unwrap_or_else(|e| panic!("{e}"));
        let (whole, parts) = (opened(&folder), opened(copy.path()));
        assert_eq!(whole.digest(&whole.weights().unwrap()), parts.digest(&parts.weights().unwrap()));
    }
}

#[test]
fn folders_that_lack_something_say_what() {
    protocol::show_excerpts();
    for folder in fixtures::parity(&["09_text_t5"]) {
        let request = Request { kind: Kind::SentenceT5, ids: TokenIds::HuggingFace, most: 0 };
        let refused = |without: &[&str], change: &dyn Fn(&Path)| {
            let copy = copy_of(&folder, without);
            change(copy.path());
            EncoderFolder::open(&DataPath::local(copy.path()), &request).unwrap_err().to_string()
        };
        let with =
            |file: &'static str, text: &'static str| move |path: &Path| std::fs::write(path.join(file), text).unwrap();
        let nothing = |_: &Path| ();
        for (said, part) in [
            (refused(&["tokenizer.json"], &nothing), "`spiece.model` alone is not supported: create one with"),
            (refused(&["modules.json"], &nothing), "no `modules.json`; expected the layout of sentence-transformers"),
            (refused(&["config.json"], &nothing), "config.json: "),
            (refused(&["model.safetensors"], &nothing), "no `model.safetensors`, "),
            (refused(&["2_Dense/model.safetensors", "2_Dense/pytorch_model.bin"], &nothing), "2_Dense: no `model"),
            (refused(&[], &with("config.json", "{\"model_type\": \"t5\"}")), "the weights do not match"),
            (
                refused(&[], &with("modules.json", "[{\"path\": \"../x\", \"type\": \"a\"}]")),
                "not a folder below this one",
            ),
            (refused(&[], &with("modules.json", "[{\"path\": \"\", \"type\": \"a\"}]")), "expected Pooling"),
            (refused(&[], &with("1_Pooling/config.json", "{\"pooling_mode_cls_token\": true}")), "expected the mean"),
            (refused(&[], &with("2_Dense/config.json", "{}")), "`in_features` is null"),
            (refused(&[], &with("tokenizer.json", "{}")), "tokenizer.json: "),
            (refused(&[], &with("model.safetensors", "")), "shorter than a header"),
        ] {
            assert!(said.contains(part), "expected `{part}`: {said}");
        }
    }
}

#[derive(Debug)]
struct Pieces(Vec<u8>);

impl text_models::ReadAt for Pieces {
    fn bytes(&self) -> u64 {
        self.0.len() as u64
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        self.0[..].read_at(offset, out)
    }
}

/// Copies the files of a folder and of the folders one level below, except for some.
fn copy_of(folder: &Path, without: &[&str]) -> tempfile::TempDir {
    let copy = tempfile::tempdir().expect("a folder");
    let files = |path: &Path| -> Vec<PathBuf> {
        std::fs::read_dir(path).expect("a folder").map(|entry| entry.expect("an entry").path()).collect()
    };
    let below = files(folder).into_iter().filter(|path| path.is_dir()).flat_map(|path| files(&path));
    for file in files(folder).into_iter().filter(|path| path.is_file()).chain(below) {
        let name = file.strip_prefix(folder).expect("it lies there");
        if without.iter().any(|other| Path::new(other) == name) {
            continue;
        }
        let to = copy.path().join(name);
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
        std::fs::write(to, std::fs::read(&file).expect("a file")).expect("a file");
    }
    copy
}
