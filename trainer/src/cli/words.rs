//! Compares the words of a prompt with those of the model's training captions, if the store has its lineage.

use std::collections::BTreeSet;

use motion::vocabulary::Vocabulary;
use protocol::Digest;
use registry::cli::{Command, Data};

use super::model;
use crate::reader::Reader;
use crate::report::print;
use crate::report::problem::Result;

/// Kind of the artifacts with captions.
const DATASET: &str = "dataset";
/// Number of sentences offered in place of one with unknown words.
const OFFERED: usize = 3;

/// The vocabulary of a model's training; `None` for a model that was trained elsewhere, such as an imported one.
///
/// # Errors
/// If the store does not answer, or a dataset in it cannot be read.
pub(super) async fn vocabulary(reader: &Reader, artifact: Digest) -> Result<Option<Vocabulary>> {
    let answer = reader.registry(&Command::Lineage { reference: artifact.to_string() }).await?;
    let Some(Data::Lineage { nodes }) = answer.data else { return Ok(None) };
    let mut captions = BTreeSet::new();
    let mut is_known = false;
    for node in nodes.iter().filter(|node| node.kind.as_deref() == Some(DATASET)) {
        let Some(read) = model::training_captions(reader, node.digest).await? else { continue };
        is_known = true;
        captions.extend(read);
    }
    Ok(is_known.then(|| Vocabulary::of(captions.iter().map(String::as_str))))
}

/// Prints a note on the words of a sentence that the training data lacks, and returns them.
pub(super) fn unknown(vocabulary: Option<&Vocabulary>, label: &str, caption: &str) -> Vec<String> {
    let Some(vocabulary) = vocabulary else { return Vec::new() };
    let unknown = vocabulary.unknown(caption);
    if !unknown.is_empty() {
        print::note(&note(vocabulary, label, caption, &unknown));
    }
    unknown
}

fn note(vocabulary: &Vocabulary, label: &str, caption: &str, unknown: &[String]) -> String {
    let words = unknown.iter().map(|word| format!("`{word}`")).collect::<Vec<_>>().join(", ");
    let rest =
        if vocabulary.has_any(caption) { "only the other words have an effect" } else { "the motion is arbitrary" };
    let nearest = vocabulary.nearest(caption, OFFERED);
    let offered = nearest.iter().map(|sentence| format!("\"{sentence}\"")).collect::<Vec<_>>().join(", ");
    let offered = if offered.is_empty() { String::new() } else { format!("; nearest known: {offered}") };
    format!("note: {words} did not occur in the training of {label}: {rest}{offered}")
}
