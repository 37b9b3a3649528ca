//! A folder with a published encoder, in the layout of Hugging Face or of sentence-transformers.
//!
//! These files are read: `config.json`; `tokenizer.json`, or for CLIP `vocab.json` and `merges.txt`; the weights;
//! `tokenizer_config.json` and `special_tokens_map.json` for lengths and special tokens. For sentence-transformers,
//! `modules.json` lists the folders of the parts. For Sentence-T5 `sentence_bert_config.json`, the pooling and the
//! dense layer are read too. Everything else, such as CLIP's vision tower, is skipped.

use std::collections::BTreeMap;
use std::path::{Component, Path};

use motion::DataPath;
use protocol::{Digest, excerpt, excerpts, json_mistake};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::EncoderError;
use crate::network::{Network, TensorSpec, WIDEST};
use crate::rules::Rules;
use crate::tokenizer::{TOKENIZER_BYTES, Tokenizer, clip_from_parts};
use crate::weights::{StoredTensor, Weights, packed};

/// Largest size of a configuration, in bytes.
const CONFIG_BYTES: u64 = 4 << 20;
/// Default number of tokens of a T5 caption: the number in its training.
const T5_TOKENS: usize = 512;
/// Prefix of the names of the dense layer's weights.
pub const DENSE: &str = "dense.";

/// The encoder in a folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// CLIP's text tower.
    Clip,
    /// T5's encoder alone.
    T5,
    /// T5's encoder with mean pooling, a dense layer and a norm.
    SentenceT5,
}

/// Conversion of captions to CLIP's ids.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TokenIds {
    /// The folder's tokenizer, with its own padding.
    HuggingFace,
    /// The rules of OpenAI's package: captions are repaired first, and padded with zeros.
    OpenAi,
}

/// Requested properties of an encoder folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request {
    pub kind: Kind,
    /// Conversion of captions to ids; only for CLIP.
    pub ids: TokenIds,
    /// Largest number of ids of a caption; 0 means the folder's own.
    pub most: usize,
}

/// The layers of a sentence encoder after the mean over a caption's tokens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Head {
    /// Width of the caption's vector.
    pub width: usize,
    /// True if there is a dense layer.
    pub dense: bool,
    /// True if the dense layer has a bias.
    pub bias: bool,
    /// True if the vector is divided by its length.
    pub normalise: bool,
}

impl Head {
    /// The tensors of the dense layer for states of `width`.
    pub fn tensors(&self, width: usize) -> Vec<TensorSpec> {
        let spec = |name: &str, shape: &[usize]| TensorSpec { name: name.into(), shape: shape.to_vec() };
        let weight = self.dense.then(|| spec("linear.weight", &[self.width, width]));
        let bias = (self.dense && self.bias).then(|| spec("linear.bias", &[self.width]));
        weight.into_iter().chain(bias).collect()
    }
}

/// The description of an encoder, without its tokenizer and its weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Description {
    #[serde(flatten)]
    pub network: Network,
    /// The layers after the network of a sentence encoder.
    #[serde(default)]
    pub head: Option<Head>,
    /// Rules for converting captions to ids.
    pub rules: Rules,
}

impl Description {
    /// Refuses sizes that no network has, and rules for captions longer than the network's limit.
    ///
    /// # Errors
    /// The defect.
    pub fn check(&self) -> Result<(), String> {
        self.network.check()?;
        let most = self.rules.most;
        let positions = self.network.positions();
        if most > positions {
            return Err(format!("captions have up to {most} tokens, but the network has {positions} positions"));
        }
        match &self.head {
            Some(Head { width, .. }) if !(1..=WIDEST).contains(width) => {
                Err(format!("captions have vectors of {width} numbers; expected 1 to {WIDEST}"))
            }
            _ => Ok(()),
        }
    }
}

/// An encoder folder with its weights not yet read.
#[derive(Debug)]
pub struct EncoderFolder {
    path: DataPath,
    /// Description of the encoder.
    pub description: Description,
    /// The tokenizer in the form of `tokenizer.json`.
    pub tokenizer_json: Vec<u8>,
    tensors: BTreeMap<String, StoredTensor>,
    /// Names of tensors in the folder that are not the encoder's.
    pub skipped: Vec<String>,
}

impl EncoderFolder {
    /// Reads everything except the weights' values.
    ///
    /// # Errors
    /// The missing or invalid file, with the remedy.
    pub fn open(path: &DataPath, request: &Request) -> Result<Self, EncoderError> {
        if !path.is_folder() {
            let what = if path.exists() { "is not a folder" } else { "no such folder" };
            return Err(EncoderError::at(path, format!("{what}; expected a folder with a published text encoder")));
        }
        let modules = Modules::read(path)?;
        let root = modules.as_ref().map_or_else(|| path.clone(), |modules| modules.first.clone());
        let file = root.join("config.json");
        let config = json(&file)?;
        let network = match request.kind {
            Kind::Clip => Network::clip(&config),
            Kind::T5 | Kind::SentenceT5 => Network::t5(&config),
        };
        let network = network.map_err(|what| EncoderError::at(&file, what))?;
        let (place, tokenizer_json) = tokenizer(&root, request.kind)?;
        let rules = rules(&root, request, &network, (&place, &tokenizer_json))?;
        Tokenizer::new(&place, &tokenizer_json, &rules, network.rows())?;

        let mut weights = Weights::open(&root)?;
        // One table with two names; a file may have either.
        weights.alias("encoder.embed_tokens.weight", "shared.weight");
        let mut tensors = weights.take(&root, &network.tensors(), "")?;
        let mut skipped = weights.left();
        let head = match request.kind {
            Kind::Clip | Kind::T5 => None,
            Kind::SentenceT5 => {
                let modules = modules.ok_or_else(|| {
                    let what = "no `modules.json`; expected the layout of sentence-transformers, or set `encoder: t5`";
                    EncoderError::at(path, what)
                })?;
                let Behind { head, weights, left } = modules.behind(network.width())?;
                tensors.extend(weights);
                skipped.extend(left);
                Some(head)
            }
        };
        let description = Description { network, head, rules };
        Ok(Self { path: path.clone(), description, tokenizer_json, tensors, skipped })
    }

    /// Creates the tokenizer under the description's rules.
    ///
    /// # Errors
    /// As [`Tokenizer::new`].
    pub fn tokenizer(&self) -> Result<Tokenizer, EncoderError> {
        let Description { network, rules, .. } = &self.description;
        Tokenizer::new(&self.path.display().to_string(), &self.tokenizer_json, rules, network.rows())
    }

    /// Reads the encoder's weights as the pieces of one safetensors file, in their stored type.
    ///
    /// # Errors
    /// The file that cannot be read.
    pub fn weights(&self) -> Result<Vec<Vec<u8>>, EncoderError> {
        packed(&self.path, &self.tensors)
    }

    /// Digest of everything that captions' vectors depend on; `weights` are the weights.
    pub fn digest(&self, weights: &[Vec<u8>]) -> Digest {
        let parts = [&self.tokenizer_json].into_iter().chain(weights);
        let parts: Vec<Digest> = parts.map(|part| Digest::of(part)).collect();
        protocol::canonical::digest(&(&self.description, parts))
    }

    /// Says how many tensors were passed over, and the first parts of their names.
    pub fn skipped_line(&self) -> Option<String> {
        let mut parts: BTreeMap<&str, usize> = BTreeMap::new();
        for name in &self.skipped {
            *parts.entry(name.split('.').next().unwrap_or(name)).or_default() += 1;
        }
        let parts: Vec<String> = parts.iter().map(|(part, count)| format!("{part}* ({count})")).collect();
        (!parts.is_empty()).then(|| {
            let count = self.skipped.len();
            let names = excerpts(parts.iter().map(String::as_str), 8);
            format!("{}: skipped {count} tensors that are not part of the text encoder: {names}", self.path.display())
        })
    }
}

fn json(file: &DataPath) -> Result<Value, EncoderError> {
    let refuse = |what: String| EncoderError::at(file, what);
    let bytes = file.read(CONFIG_BYTES).map_err(|e| refuse(e.to_string()))?;
    serde_json::from_slice(&bytes).map_err(|e| refuse(json_mistake(&e)))
}

/// Reads a JSON file, or returns null if it does not exist.
fn json_if_there(file: &DataPath) -> Result<Value, EncoderError> {
    if file.has_entry() { json(file) } else { Ok(Value::Null) }
}

/// The bytes of a `tokenizer.json`, and the file's name for errors.
fn tokenizer(root: &DataPath, kind: Kind) -> Result<(String, Vec<u8>), EncoderError> {
    let read = |name: &str| {
        let file = root.join(name);
        file.read(TOKENIZER_BYTES).map_err(|e| EncoderError::at(&file, e.to_string()))
    };
    let is_there = |name: &str| root.join(name).has_entry();
    let shown = |name: &str| root.join(name).display().to_string();
    if is_there("tokenizer.json") {
        return Ok((shown("tokenizer.json"), read("tokenizer.json")?));
    }
    if kind == Kind::Clip && is_there("vocab.json") && is_there("merges.txt") {
        let vocab = read("vocab.json")?;
        let merges = read("merges.txt")?;
        let json = clip_from_parts((&shown("vocab.json"), &vocab), (&shown("merges.txt"), &merges))?;
        return Ok((shown("vocab.json"), json));
    }
    let folder = root.display();
    let make = format!(
        "create one with `python -c \"from transformers import AutoTokenizer as A; \
         A.from_pretrained('{folder}').save_pretrained('{folder}')\"`"
    );
    let what = match kind {
        Kind::Clip => {
            format!("no `tokenizer.json`, and no `vocab.json` with `merges.txt`; download one of them, or {make}")
        }
        _ if is_there("spiece.model") => format!("no `tokenizer.json`; `spiece.model` alone is not supported: {make}"),
        _ => format!("no `tokenizer.json`; download it, or {make}"),
    };
    Err(EncoderError::at(root, what))
}

/// The rules by which published models convert captions to ids.
fn rules(
    root: &DataPath,
    request: &Request,
    network: &Network,
    tokenizer: (&str, &[u8]),
) -> Result<Rules, EncoderError> {
    let config = json_if_there(&root.join("tokenizer_config.json"))?;
    let special = json_if_there(&root.join("special_tokens_map.json"))?;
    let word = |key: &str, fallback: &str| {
        let found =
            [&special[key], &config[key]].into_iter().find_map(|value| value["content"].as_str().or(value.as_str()));
        found.unwrap_or(fallback).to_owned()
    };
    let id = |word: &str| Tokenizer::id(tokenizer.0, tokenizer.1, word);
    // Files without a limit have 1e30.
    let own = |value: &Value| value.as_f64().filter(|most| (1.0..1e6).contains(most)).map(|most| most as usize);
    let own_most = own(&config["model_max_length"]);
    let most = |own: usize, highest: usize| match request.most {
        0 => Ok(own.min(highest)),
        asked if asked <= highest => Ok(asked),
        asked => Err(EncoderError::at(root, format!("has {highest} positions, but {asked} tokens are requested"))),
    };
    match network {
        Network::Clip(sizes) => {
            let end_word = word("eos_token", "<|endoftext|>");
            let first = id(&word("bos_token", "<|startoftext|>"))?;
            let end = id(&end_word)?;
            if ![2, end as usize].contains(&sizes.eos_token_id) {
                let said = sizes.eos_token_id;
                let is = excerpt(&end_word);
                let what = format!("`eos_token_id` is {said}; expected 2, or {end}, the id of `{is}` in the tokenizer");
                return Err(EncoderError::at(&root.join("config.json"), what));
            }
            let is_openai = request.ids == TokenIds::OpenAi;
            let pad = if is_openai { 0 } else { id(&word("pad_token", &end_word))? };
            let positions = network.positions();
            let most = most(own_most.unwrap_or(positions), positions)?;
            Ok(Rules { repair: is_openai, strip: false, lower: false, first: Some(first), end, pad, most })
        }
        Network::T5(sizes) => {
            let file = root.join("sentence_bert_config.json");
            let sentence = if request.kind == Kind::SentenceT5 { json_if_there(&file)? } else { Value::Null };
            let own = own(&sentence["max_seq_length"]).or(own_most).unwrap_or(T5_TOKENS);
            let lower = sentence["do_lower_case"].as_bool().unwrap_or(false);
            let end = id(&word("eos_token", "</s>"))?;
            let pad = sizes.pad_token_id;
            Ok(Rules {
                repair: false,
                strip: true,
                lower,
                first: None,
                end,
                pad,
                most: most(own, network.positions())?,
            })
        }
    }
}

/// The layers after a network, with their weights.
struct Behind {
    head: Head,
    /// Weights of the dense layer.
    weights: BTreeMap<String, StoredTensor>,
    /// Names of tensors in its folder that are not the dense layer's.
    left: Vec<String>,
}

/// The modules in `modules.json`.
#[derive(Debug)]
struct Modules {
    file: DataPath,
    /// Folder of the network.
    first: DataPath,
    /// The later modules, as class and folder.
    others: Vec<(String, DataPath)>,
}

impl Modules {
    /// Reads `modules.json`; `None` if the folder has none.
    fn read(path: &DataPath) -> Result<Option<Self>, EncoderError> {
        #[derive(Deserialize)]
        struct Module {
            path: String,
            #[serde(rename = "type")]
            class: String,
        }
        let file = path.join("modules.json");
        let value = json_if_there(&file)?;
        if value.is_null() {
            return Ok(None);
        }
        let refuse = |what: String| EncoderError::at(&file, what);
        let listed: Vec<Module> = serde_json::from_value(value)
            .map_err(|e| refuse(format!("{}; expected a list of modules with `path` and `type`", json_mistake(&e))))?;
        let mut all = Vec::new();
        for Module { path: below, class } in listed {
            if !Path::new(&below).components().all(|part| matches!(part, Component::Normal(_))) {
                return Err(refuse(format!("`{}` is not a folder below this one", excerpt(&below))));
            }
            let class = class.rsplit('.').next().unwrap_or_default().to_owned();
            all.push((class, path.join_quoted(&below)));
        }
        if all.is_empty() || all.len() > 16 {
            return Err(refuse(format!("lists {} modules; expected 1 to 16", all.len())));
        }
        let (_, first) = all.remove(0);
        Ok(Some(Self { file, first, others: all }))
    }

    /// Reads the layers after states of `width`.
    fn behind(&self, width: usize) -> Result<Behind, EncoderError> {
        let refuse = |what: String| EncoderError::at(&self.file, what);
        let mut head = Head { width, dense: false, bias: false, normalise: false };
        let mut weights = BTreeMap::new();
        let mut left = Vec::new();
        let classes: Vec<&str> = self.others.iter().map(|(class, _)| class.as_str()).collect();
        let known =
            [&["Pooling"][..], &["Pooling", "Normalize"], &["Pooling", "Dense"], &["Pooling", "Dense", "Normalize"]];
        if !known.contains(&&classes[..]) {
            let found = classes.join(", ");
            return Err(refuse(format!(
                "lists {} after the network; expected Pooling, then optionally Dense, then optionally Normalize",
                excerpt(&found)
            )));
        }
        for (class, folder) in &self.others {
            match class.as_str() {
                "Pooling" => check_pooling(&folder.join("config.json"), width)?,
                "Dense" => {
                    let file = folder.join("config.json");
                    let config = json(&file)?;
                    (head.width, head.bias) = dense(&config, width).map_err(|what| EncoderError::at(&file, what))?;
                    head.dense = true;
                    let mut stored = Weights::open(folder)?;
                    weights = stored.take(folder, &head.tensors(width), DENSE)?;
                    left = stored.left();
                }
                _ => head.normalise = true,
            }
        }
        Ok(Behind { head, weights, left })
    }
}

/// Refuses any pooling except the mean over tokens.
fn check_pooling(file: &DataPath, width: usize) -> Result<(), EncoderError> {
    let config = json(file)?;
    let refuse = |what: String| EncoderError::at(file, what);
    let modes = config.as_object().into_iter().flatten().filter(|(key, _)| key.starts_with("pooling_mode"));
    let on: Vec<&str> = modes
        .filter(|(_, value)| value.as_bool() == Some(true) || value.is_string())
        .map(|(key, value)| value.as_str().unwrap_or(key))
        .collect();
    if on != ["pooling_mode_mean_tokens"] && on != ["mean"] {
        let on = on.join(", ");
        return Err(refuse(format!("pools with `{}`; expected the mean of the tokens", excerpt(&on))));
    }
    match config["word_embedding_dimension"].as_u64() {
        Some(said) if said != width as u64 => Err(refuse(format!(
            "pools {said} numbers, but the network returns {width}; download the whole folder again"
        ))),
        _ => Ok(()),
    }
}

/// Width and bias of the dense layer.
fn dense(config: &Value, width: usize) -> Result<(usize, bool), String> {
    let number =
        |key: &str| config[key].as_u64().and_then(|n| usize::try_from(n).ok()).filter(|n| (1..=WIDEST).contains(n));
    if number("in_features") != Some(width) {
        return Err(format!(
            "`in_features` is {}; expected {width}, the width of the network",
            excerpt(&config["in_features"].to_string())
        ));
    }
    let out = number("out_features").ok_or("`out_features` is missing; expected 1 to 65536")?;
    let activation = config["activation_function"].as_str().unwrap_or("Identity");
    if !activation.ends_with("Identity") {
        let found = excerpt(activation);
        return Err(format!("`activation_function` is `{found}`; expected `torch.nn.modules.linear.Identity`"));
    }
    Ok((out, config["bias"].as_bool().unwrap_or(true)))
}
