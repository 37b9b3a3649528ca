//! Files of a repository that an encoder reads: exactly the files that `text_models::EncoderFolder` opens.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use motion::DataPath;
use serde::Deserialize;

use crate::error::HubError;

/// Largest size of a file that lists others, in bytes.
const LISTING_BYTES: u64 = 16 << 20;
/// Largest number of files of sharded weights.
const SHARDS: usize = 256;
/// Largest number of modules of a sentence encoder.
const MODULES: usize = 16;

/// The encoder in a repository, which decides the files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoder {
    /// CLIP's text tower, whose tokenizer may be in parts.
    Clip,
    /// T5's encoder alone.
    T5,
    /// T5's encoder with the later modules of `modules.json`.
    SentenceT5,
}

/// A repository's files, from the cache or the hub.
pub(crate) trait Repository {
    /// All names, folders separated by `/`.
    fn names(&self) -> &BTreeSet<String>;

    /// Returns one of the names as a file on this machine.
    fn get(&mut self, name: &str) -> Result<PathBuf, Failure>;
}

/// A file that cannot be returned.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The hub cannot be reached.
    Away(String),
    /// Any other error, for the user.
    Said(HubError),
    /// The repository is not such an encoder.
    Content(String),
}

/// Gets all files that an encoder reads.
pub(crate) fn get_all(repository: &mut dyn Repository, encoder: Encoder) -> Result<(), Failure> {
    let modules = modules(repository, encoder)?;
    let (root, behind) = modules.split_first().map_or(("", &[][..]), |(first, behind)| (first.as_str(), behind));
    repository_file(repository, &below(root, "config.json"))?;
    let at_root = |name: &str| below(root, name);
    let tokenizer = at_root("tokenizer.json");
    if repository.names().contains(&tokenizer) {
        repository.get(&tokenizer)?;
    } else if encoder == Encoder::Clip {
        repository_file(repository, &at_root("vocab.json"))?;
        repository_file(repository, &at_root("merges.txt"))?;
    } else {
        return Err(Failure::Content(format!("has no `{tokenizer}`")));
    }
    for name in ["tokenizer_config.json", "special_tokens_map.json", "sentence_bert_config.json"] {
        if repository.names().contains(&at_root(name)) {
            repository.get(&at_root(name))?;
        }
    }
    weights(repository, root)?;
    for folder in behind {
        // A module that only normalises has neither.
        if repository.names().contains(&below(folder, "config.json")) {
            repository.get(&below(folder, "config.json"))?;
            let is_there = |name: &str| repository.names().contains(&below(folder, name));
            if is_there("model.safetensors") || is_there("pytorch_model.bin") {
                weights(repository, folder)?;
            }
        }
    }
    Ok(())
}

fn below(folder: &str, name: &str) -> String {
    if folder.is_empty() { name.to_owned() } else { format!("{folder}/{name}") }
}

fn repository_file(repository: &mut dyn Repository, name: &str) -> Result<PathBuf, Failure> {
    if repository.names().contains(name) {
        return repository.get(name);
    }
    Err(Failure::Content(format!("has no `{name}`")))
}

fn json<T: serde::de::DeserializeOwned>(repository: &mut dyn Repository, name: &str) -> Result<T, Failure> {
    let file = repository_file(repository, name)?;
    let bytes = DataPath::local(file).read(LISTING_BYTES).map_err(|e| Failure::Content(format!("`{name}` {e}")))?;
    serde_json::from_slice(&bytes).map_err(|e| Failure::Content(format!("`{name}`: {e}")))
}

/// The folders that `modules.json` lists, the network's first; empty without such a file.
fn modules(repository: &mut dyn Repository, encoder: Encoder) -> Result<Vec<String>, Failure> {
    #[derive(Deserialize)]
    struct Module {
        path: String,
    }
    if !repository.names().contains("modules.json") {
        return match encoder {
            Encoder::SentenceT5 => {
                Err(Failure::Content("has no `modules.json`, which the layout of sentence-transformers needs".into()))
            }
            Encoder::Clip | Encoder::T5 => Ok(Vec::new()),
        };
    }
    let listed: Vec<Module> = json(repository, "modules.json")?;
    let is_below =
        |module: &Module| Path::new(&module.path).components().all(|part| matches!(part, Component::Normal(_)));
    if listed.len() > MODULES || !listed.iter().all(is_below) {
        return Err(Failure::Content("`modules.json` lists paths outside the repository".into()));
    }
    Ok(listed.into_iter().map(|module| module.path).collect())
}

/// Gets the weights of a folder: safetensors, whole or sharded, are preferred to pickles.
fn weights(repository: &mut dyn Repository, folder: &str) -> Result<(), Failure> {
    #[derive(Deserialize)]
    struct Index {
        weight_map: BTreeMap<String, String>,
    }
    let at = |name: &str| below(folder, name);
    let whole = at("model.safetensors");
    let index = at("model.safetensors.index.json");
    let pickle = at("pytorch_model.bin");
    if repository.names().contains(&whole) {
        return repository.get(&whole).map(drop);
    }
    if repository.names().contains(&index) {
        let listed: Index = json(repository, &index)?;
        let shards: BTreeSet<String> = listed.weight_map.into_values().collect();
        if shards.len() > SHARDS {
            return Err(Failure::Content(format!("`{index}` names {} files; expected at most {SHARDS}", shards.len())));
        }
        return shards.iter().try_for_each(|shard| repository_file(repository, &at(shard)).map(drop));
    }
    if repository.names().contains(&pickle) {
        return repository.get(&pickle).map(drop);
    }
    Err(Failure::Content(format!("has none of `{whole}`, `{index}` and `{pickle}`")))
}
