//! Compares the words of a prompt with those of the model's training captions, if the store has its lineage.

use std::collections::BTreeSet;

use motion::vocabulary::Vocabulary;
use protocol::Digest;
use registry::cli::{Command, Data};

use super::model::{self, Found};
use crate::reader::Reader;
use crate::report::print;
use crate::report::problem::Result;

/// Kind of the artifacts with captions.
const DATASET: &str = "dataset";
/// Number of sentences offered in place of one with unknown words.
const OFFERED: usize = 3;

/// The vocabulary of a model's training: of its lineage, else of the captions that came with it. `None` if neither is
/// known, as of most imported models.
///
/// # Errors
/// If the store does not answer, or a dataset in it cannot be read.
pub(super) async fn vocabulary(reader: &Reader, found: &Found) -> Result<Option<Vocabulary>> {
    let captions = match captions(reader, found.artifact).await? {
        Some(captions) => captions,
        None if found.captions.is_empty() => return Ok(None),
        None => found.captions.iter().cloned().collect(),
    };
    Ok(Some(Vocabulary::of(captions.iter().map(String::as_str))))
}

/// The training captions of an artifact that was trained here.
///
/// # Errors
/// As [`vocabulary`].
pub(super) async fn captions(reader: &Reader, artifact: Digest) -> Result<Option<BTreeSet<String>>> {
    let answer = reader.registry(&Command::Lineage { reference: artifact.to_string() }).await?;
    let Some(Data::Lineage { nodes }) = answer.data else { return Ok(None) };
    let mut captions = BTreeSet::new();
    let mut is_known = false;
    for node in nodes.iter().filter(|node| node.kind.as_deref() == Some(DATASET)) {
        let Some(read) = model::training_captions(reader, node.digest).await? else { continue };
        is_known = true;
        captions.extend(read);
    }
    Ok(is_known.then_some(captions))
}

/// A few of the captions that have every word of all of them.
pub(super) fn covering(captions: &BTreeSet<String>) -> Vec<&str> {
    let mut kept: Vec<&str> = Vec::new();
    for caption in captions {
        if !Vocabulary::of(kept.iter().copied()).unknown(caption).is_empty() {
            kept.push(caption);
        }
    }
    kept
}

/// A sentence compared with the training captions.
#[derive(Debug, Clone)]
pub(super) struct Compared {
    /// Words that no training caption has.
    pub(super) unknown: Vec<String>,
    /// Training captions nearest to the sentence, if it has unknown words.
    pub(super) nearest: Vec<String>,
    /// True if a known word may describe a motion.
    pub(super) has_known: bool,
}

/// Compares a sentence with the training captions, and prints a note on unknown words. `None` without a vocabulary.
pub(super) fn compare(vocabulary: Option<&Vocabulary>, label: &str, caption: &str) -> Option<Compared> {
    let vocabulary = vocabulary?;
    let unknown = vocabulary.unknown(caption);
    let nearest = if unknown.is_empty() { Vec::new() } else { vocabulary.nearest(caption, OFFERED) };
    let compared = Compared {
        unknown,
        nearest: nearest.into_iter().map(str::to_owned).collect(),
        has_known: vocabulary.has_any(caption),
    };
    if !compared.unknown.is_empty() {
        print::note(&compared.note(label));
    }
    Some(compared)
}

impl Compared {
    fn note(&self, label: &str) -> String {
        let quoted = |texts: &[String], mark: &str| {
            texts.iter().map(|text| format!("{mark}{text}{mark}")).collect::<Vec<_>>().join(", ")
        };
        let words = quoted(&self.unknown, "`");
        let rest = if self.has_known { "only the other words have an effect" } else { "the motion is arbitrary" };
        let offered = match quoted(&self.nearest, "\"") {
            none if none.is_empty() => none,
            some => format!("; nearest known: {some}"),
        };
        format!("note: {words} did not occur in the training of {label}: {rest}{offered}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covering_captions_have_every_word() {
        let all = ["a person jumps", "a person jumps up", "a person walks", "someone walks", "walks up"];
        let all = all.map(str::to_owned).into();
        assert_eq!(covering(&all), ["a person jumps", "a person jumps up", "a person walks", "someone walks"]);
    }
}
