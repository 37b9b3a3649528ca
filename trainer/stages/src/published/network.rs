//! A published network in a file, and its values.

use std::collections::BTreeSet;

use models::flat::Entry;
use protocol::{excerpt, excerpts};
use text_models::StoredTensor;

use super::file::{Checkpoint, SHOWN, TENSORS};
use crate::context::StageError;

/// Prefixes and suffixes of tensors that networks never read or compute from their size: tables of positions, causal
/// masks, counters.
const CONSTANTS: [&str; 6] = [
    "position_enc.pe",
    "sequence_pos_encoder.pe",
    ".attn.mask",
    "pos_embedding.weight",
    "pos_embed.embed",
    "time_mlp.0.pe",
];
/// Names of another network inside a network's own names, and counters that are no floats.
const FOREIGN: [&str; 2] = ["trans_base.vqvae.", ".num_batches_tracked"];

/// A published network in files.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Its name in errors.
    pub what: &'static str,
    /// Prefixes that its names may have, in the order of preference.
    pub prefixes: &'static [&'static str],
    /// A name that all variants have.
    pub marker: &'static str,
}

impl Place {
    pub(super) const fn new(what: &'static str, prefixes: &'static [&'static str], marker: &'static str) -> Self {
        Self { what, prefixes, marker }
    }
}

/// A network's tensors in a file.
#[derive(Debug, Clone)]
pub struct Found<'a> {
    checkpoint: &'a Checkpoint,
    /// Prefix of the network's names.
    prefix: String,
}

/// A network's values, and its constants.
#[derive(Debug, Clone, PartialEq)]
pub struct Taken {
    /// Values in the order of the network's entries.
    pub values: Vec<f32>,
    /// Tensors of the published network that ours does not need: names, shapes, values.
    pub constants: Vec<(Entry, Vec<f32>)>,
    /// Names in the file that were read.
    pub read: BTreeSet<String>,
}

impl Checkpoint {
    /// Finds a network.
    ///
    /// # Errors
    /// If there is none; the message lists the networks in the file.
    pub fn network(&self, place: &Place) -> Result<Found<'_>, StageError> {
        self.find(place.prefixes, place.marker).ok_or_else(|| {
            let groups = self.groups(|_| true);
            let has = match groups.is_empty() {
                true => "no weights".to_owned(),
                false => format!("`{}`", excerpts(groups.keys().map(String::as_str), SHOWN)),
            };
            let Place { what, marker, .. } = place;
            self.refuse(format!("it has no {what}: the tensor `{marker}` is missing; it has {has}"))
        })
    }

    /// Finds a network beside others in one file; `None` if there is none. Only the first two prefixes count, because
    /// other networks have the same names without a prefix of their own.
    pub fn beside(&self, place: &Place) -> Option<Found<'_>> {
        self.find(&place.prefixes[..2], place.marker)
    }

    fn find(&self, prefixes: &[&str], marker: &str) -> Option<Found<'_>> {
        let is_there = |prefix: &&&str| self.weights.tensors().contains_key(&format!("{prefix}{marker}"));
        let prefix = prefixes.iter().find(is_there)?;
        Some(Found { checkpoint: self, prefix: (*prefix).to_owned() })
    }
}

impl Found<'_> {
    /// Prefix of the network's names.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    fn tensor(&self, name: &str) -> Option<&StoredTensor> {
        self.checkpoint.weights.tensors().get(&format!("{}{name}", self.prefix))
    }

    /// Returns true if the network has a tensor `name`.
    pub fn has(&self, name: &str) -> bool {
        self.tensor(name).is_some()
    }

    /// The length of an axis of a tensor.
    ///
    /// # Errors
    /// If there is no such tensor, or it has fewer axes or no elements.
    pub fn dim(&self, name: &str, axis: usize) -> Result<usize, StageError> {
        let shape = self.tensor(name).map(|tensor| &tensor.shape[..]).unwrap_or_default();
        // With an axis of 0 the other axes cost nothing and may be any number.
        if shape.contains(&0) {
            return Err(self.refuse(format!("`{}{name}` has shape {shape:?}, which has no elements", self.prefix)));
        }
        let missing = || self.refuse(format!("no tensor `{}{name}` with {} axes", self.prefix, axis + 1));
        shape.get(axis).copied().ok_or_else(missing)
    }

    /// Number of entries of the list `stem`: `stem.0.`, `stem.1.` and so on.
    pub fn count(&self, stem: &str) -> usize {
        let has = |i: &usize| {
            let begin = format!("{}{stem}.{i}.", self.prefix);
            let next = self.checkpoint.weights.tensors().range(begin.clone()..).next();
            next.is_some_and(|(name, _)| name.starts_with(&begin))
        };
        (0..TENSORS).take_while(has).count()
    }

    /// Makes an error that names the file.
    pub fn refuse(&self, what: impl std::fmt::Display) -> StageError {
        self.checkpoint.refuse(what)
    }

    /// Reads the values of `entries`, each under its own name or the one that `alias` returns.
    ///
    /// # Errors
    /// All missing tensors, those with another shape, and those in the file that the network lacks; values that are not
    /// finite.
    pub fn take(&self, entries: &[Entry], alias: &dyn Fn(&str) -> String) -> Result<Taken, StageError> {
        let names: Vec<String> = entries.iter().map(|entry| alias(&entry.name)).collect();
        let mut wrong = Vec::new();
        for (entry, name) in entries.iter().zip(&names) {
            match self.tensor(name) {
                Some(tensor) if tensor.shape == entry.shape => {}
                Some(tensor) => {
                    wrong.push(format!(
                        "`{}{name}` has shape {:?}; expected {:?}",
                        self.prefix, tensor.shape, entry.shape
                    ));
                }
                None => {
                    let other = self.checkpoint.weights.others().get(&format!("{}{name}", self.prefix));
                    let there = other.map_or_else(String::new, |what| format!(" (it is {what})"));
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
                wrong.push(format!("`{begin}{}` {:?} is not part of this network", excerpt(name), tensor.shape));
            }
        }
        if !wrong.is_empty() {
            let count = wrong.len();
            wrong.truncate(SHOWN);
            let more = if count > SHOWN { format!(" and {} more", count - SHOWN) } else { String::new() };
            return Err(self.refuse(format!("its tensors do not match the network: {}{more}", wrong.join("; "))));
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
        // All of them are in the file, so this is at most its size.
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
