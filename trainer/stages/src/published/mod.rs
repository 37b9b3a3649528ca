//! Weights that others have published: files of torch or of safetensors, the networks in them, and what of a file is left out.
//!
//! The file is somebody else's. Nothing in a pickle is run, an archive is not unpacked if that makes more of it than it is, and no network is made
//! before each of its tensors was found in the file with its shape: sizes are read off shapes, and the names and shapes of a network of these sizes
//! need no memory ([`Init::shapes`](models::networks::Init::shapes)).
//!
//! Files of one network differ in what stands before its names: torch files in the key of a dict (`state_dict`, `vq_model`), and in the module's
//! name in whatever class was saved (`vae.`, `vqvae.`). Our own exports have the part's role there. Each network knows the beginnings that are in use
//! and a name that it has in all of them.

pub mod sizes;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use models::flat::Entry;
use text_models::{StoredTensor, Weights};

use crate::context::StageError;

/// Tensors in a file; an optimizer's state triples those of a large network, which has a thousand.
const TENSORS: usize = 20_000;
/// Names in an error.
const SHOWN: usize = 20;

/// What networks have in their files and never read, or fill with numbers that follow from its size: tables of positions, masks of causality,
/// counters. All begin or end like this.
const CONSTANTS: [&str; 6] = [
    "position_enc.pe",
    "sequence_pos_encoder.pe",
    ".attn.mask",
    "pos_embedding.weight",
    "pos_embed.embed",
    "time_mlp.0.pe",
];
/// What is of another network although it stands among its names, and counters that are no floats.
const FOREIGN: [&str; 2] = ["trans_base.vqvae.", ".num_batches_tracked"];

/// A file with weights, of which nothing but names and shapes is read yet.
#[derive(Debug)]
pub struct Checkpoint {
    file: PathBuf,
    weights: Weights,
}

/// A network's tensors in a file.
#[derive(Debug, Clone)]
pub struct Found<'a> {
    checkpoint: &'a Checkpoint,
    /// What stands before its names.
    prefix: String,
}

/// A network's values, and what else its file has.
#[derive(Debug, Clone, PartialEq)]
pub struct Taken {
    /// In the order of the network's entries.
    pub values: Vec<f32>,
    /// What the published network has besides, and ours needs not: names, shapes, values.
    pub constants: Vec<(Entry, Vec<f32>)>,
    /// The names in the file that were read.
    pub read: BTreeSet<String>,
}

impl Checkpoint {
    /// Reads names and shapes.
    ///
    /// # Errors
    /// Why the file is neither torch's nor safetensors, or promises more than it holds.
    pub fn open(file: &Path) -> Result<Self, StageError> {
        let weights = Weights::open_file(file).map_err(|e| StageError::Input(e.to_string()))?;
        let found = Self { file: file.to_owned(), weights };
        let count = found.weights.tensors().len() + found.weights.others().len();
        if count > TENSORS {
            return Err(found.refuse(format!("{count} tensors; expected at most {TENSORS}")));
        }
        Ok(found)
    }

    /// The network called `what` that has the tensor `marker`, whose names begin in one of `places`.
    ///
    /// # Errors
    /// If there is none; the message lists those that the file has.
    pub fn network(&self, what: &str, places: &[&str], marker: &str) -> Result<Found<'_>, StageError> {
        self.find(places, marker).ok_or_else(|| {
            let groups: Vec<String> = self.groups(|_| true).into_keys().take(SHOWN).collect();
            let has =
                if groups.is_empty() { "no weights at all".to_owned() } else { format!("`{}`", groups.join("`, `")) };
            self.refuse(format!("it holds no {what}, which has a tensor `{marker}`; it holds {has}"))
        })
    }

    /// As [`network`](Self::network), if there is one.
    pub fn find(&self, places: &[&str], marker: &str) -> Option<Found<'_>> {
        let is_there = |place: &&&str| self.weights.tensors().contains_key(&format!("{place}{marker}"));
        let place = places.iter().find(is_there)?;
        Some(Found { checkpoint: self, prefix: (*place).to_owned() })
    }

    /// What of the file was not `read`, in a few words: `t2m_textencoder (19)`; nothing if that is nothing.
    pub fn left_out(&self, read: &BTreeSet<String>) -> Option<String> {
        let groups = self.groups(|name| !read.contains(name));
        let words: Vec<String> = groups.iter().map(|(group, count)| format!("`{group}` ({count})")).collect();
        let shown = words.len().min(SHOWN);
        let more = if shown < words.len() { format!(" and {} more", words.len() - shown) } else { String::new() };
        (shown > 0).then(|| format!("{}{more}", words[..shown].join(", ")))
    }

    /// An error that names the file.
    pub fn refuse(&self, what: impl std::fmt::Display) -> StageError {
        StageError::Input(format!("{}: {what}", self.file.display()))
    }

    /// Tensors by the first word of their names, or the first two where the first is the dict of all.
    fn groups(&self, counts: impl Fn(&str) -> bool) -> BTreeMap<String, usize> {
        let mut groups = BTreeMap::new();
        let names = self.weights.tensors().keys().chain(self.weights.others().keys());
        for name in names.filter(|name| counts(name)) {
            let words = if name.starts_with("state_dict.") { 2 } else { 1 };
            let group: Vec<&str> = name.split('.').take(words).collect();
            *groups.entry(group.join(".").escape_debug().to_string()).or_default() += 1;
        }
        groups
    }
}

impl Found<'_> {
    /// What stands before its names.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    fn tensor(&self, name: &str) -> Option<&StoredTensor> {
        self.checkpoint.weights.tensors().get(&format!("{}{name}", self.prefix))
    }

    /// Whether it has a tensor.
    pub fn has(&self, name: &str) -> bool {
        self.tensor(name).is_some()
    }

    /// The length of an axis of a tensor.
    ///
    /// # Errors
    /// If it has no such tensor, or that has fewer axes or holds nothing.
    pub fn dim(&self, name: &str, axis: usize) -> Result<usize, StageError> {
        let shape = self.tensor(name).map(|tensor| &tensor.shape[..]).unwrap_or_default();
        // With an axis of 0 the others cost nothing, and may be any number.
        if shape.contains(&0) {
            return Err(self.refuse(format!("`{}{name}` has shape {shape:?}, which holds nothing", self.prefix)));
        }
        let missing = || self.refuse(format!("no tensor `{}{name}` with {} axes", self.prefix, axis + 1));
        shape.get(axis).copied().ok_or_else(missing)
    }

    /// How many entries the list `stem` has: `stem.0.`, `stem.1.` and so on.
    pub fn count(&self, stem: &str) -> usize {
        let has = |i: &usize| {
            let begin = format!("{}{stem}.{i}.", self.prefix);
            let next = self.checkpoint.weights.tensors().range(begin.clone()..).next();
            next.is_some_and(|(name, _)| name.starts_with(&begin))
        };
        (0..TENSORS).take_while(has).count()
    }

    /// An error that names the file.
    pub fn refuse(&self, what: impl std::fmt::Display) -> StageError {
        self.checkpoint.refuse(what)
    }

    /// The values of `entries`, each read under its name or the one that `alias` gives.
    ///
    /// # Errors
    /// All tensors that are missing, have another shape, or are there although the network has none of that name; values that are not finite.
    pub fn take(&self, entries: &[Entry], alias: &dyn Fn(&str) -> String) -> Result<Taken, StageError> {
        let names: Vec<String> = entries.iter().map(|entry| alias(&entry.name)).collect();
        let mut wrong = Vec::new();
        for (entry, name) in entries.iter().zip(&names) {
            match self.tensor(name) {
                Some(tensor) if tensor.shape == entry.shape => {}
                Some(tensor) => {
                    wrong.push(format!(
                        "`{}{name}` has shape {:?}, expected {:?}",
                        self.prefix, tensor.shape, entry.shape
                    ));
                }
                None => {
                    let other = self.checkpoint.weights.others().get(&format!("{}{name}", self.prefix));
                    let there = other.map_or_else(String::new, |what| format!(" (there as {what})"));
                    wrong.push(format!("`{}{name}` {:?} is missing{there}", self.prefix, entry.shape));
                }
            }
        }
        let own: BTreeSet<&str> = names.iter().map(String::as_str).collect();
        let heads: BTreeSet<&str> = own.iter().filter_map(|name| name.split('.').next()).collect();
        let mut constants = Vec::new();
        let begin = self.prefix.clone();
        let all = self.checkpoint.weights.tensors().range(begin.clone()..);
        for (name, tensor) in all.take_while(|(name, _)| name.starts_with(&begin)) {
            let name = &name[begin.len()..];
            let head = name.split('.').next().unwrap_or(name);
            if own.contains(name) || FOREIGN.iter().any(|part| name.contains(part)) {
                continue;
            }
            if CONSTANTS.iter().any(|end| name.ends_with(end)) {
                constants.push((Entry { name: name.to_owned(), shape: tensor.shape.clone() }, tensor));
            } else if heads.contains(head) {
                wrong.push(format!("`{begin}{}` {:?} is not of this network", name.escape_debug(), tensor.shape));
            }
        }
        if !wrong.is_empty() {
            let count = wrong.len();
            wrong.truncate(SHOWN);
            let more = if count > SHOWN { format!(" and {} more", count - SHOWN) } else { String::new() };
            return Err(self.refuse(format!("its tensors make no whole network: {}{more}", wrong.join("; "))));
        }
        self.read(entries, &names, constants)
    }

    fn read(
        &self,
        entries: &[Entry],
        names: &[String],
        constants: Vec<(Entry, &StoredTensor)>,
    ) -> Result<Taken, StageError> {
        let values_of = |name: &str, tensor: &StoredTensor| {
            tensor.values().map_err(|e| self.refuse(format!("`{}{name}`: {e}", self.prefix)))
        };
        // All of them are there, so this is no more than the file.
        let mut values = Vec::with_capacity(entries.iter().map(Entry::len).sum());
        for name in names {
            let Some(tensor) = self.tensor(name) else { continue };
            let own = values_of(name, tensor)?;
            if let Some(bad) = own.iter().position(|v| !v.is_finite()) {
                return Err(self.refuse(format!(
                    "`{}{name}`: number {bad} of {} is not finite",
                    self.prefix,
                    own.len()
                )));
            }
            values.extend(own);
        }
        let mut read: BTreeSet<String> = names.iter().map(|name| format!("{}{name}", self.prefix)).collect();
        let mut kept = Vec::new();
        for (entry, tensor) in constants {
            let own = values_of(&entry.name, tensor)?;
            read.insert(format!("{}{}", self.prefix, entry.name));
            kept.push((entry, own));
        }
        Ok(Taken { values, constants: kept, read })
    }
}
