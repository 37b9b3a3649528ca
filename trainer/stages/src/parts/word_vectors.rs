//! Captions in the form that evaluators read: a vector and a class for each of 22 words.
//!
//! Word vectors are the published vocabulary, or built in. A built-in vector hashes the word and its letter triples to
//! directions, so that any word has one and related forms are similar. An evaluator keeps the vectors of its training,
//! and its meta names them: metrics with different word vectors belong to different evaluators. Source of the published
//! form: text-to-motion (Guo et al.), whose vocabulary is an extract of GloVe.

use std::collections::{BTreeMap, HashMap};
use std::io::Read as _;

use checkpoint::Blobs;
use motion::dataset::Caption;
use motion::text::{MAX_TOKENS, POS_CLASSES, hashed_word, padded_tokens, pos_class, split_token};
use motion::{DataPath, Floats, npy};
use protocol::{Digest, Manifest, excerpt, limits};
use pytorch_reader::{PickleValue, PytorchReader};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, Draft, Tensors};
use crate::context::{ContextError, StageError};

/// Width of a word vector.
pub const WORD_WIDTH: usize = motion::text::WORD_WIDTH;
/// Number of words of a caption, with markers and padding.
pub const WORDS: usize = MAX_TOKENS + 2;
/// Number of word classes.
pub const CLASSES: usize = POS_CLASSES.len();
/// The class of words that are not in a vocabulary.
const OTHER: usize = CLASSES - 1;
/// Entry for words that are not in a vocabulary.
const UNKNOWN: &str = "unk";
/// File of an evaluator's vectors, `vectors` `[n, 300]`.
const VECTORS_FILE: &str = "words.safetensors";
/// File of their rows by word.
const INDEX_FILE: &str = "words.json";

/// The word vectors of an evaluator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum WordsMeta {
    /// Built-in vectors, hashed from words.
    Hashed,
    /// A published vocabulary.
    Vocabulary {
        /// Digest of the vectors and their index.
        digest: Digest,
        /// Number of words.
        words: usize,
    },
}

/// Word vectors of either kind.
#[derive(Debug, Clone, PartialEq)]
pub enum Words {
    /// Built-in vectors, hashed from words.
    Hashed,
    /// A published vocabulary.
    Vocabulary {
        /// Vectors of shape `[n, 300]`.
        vectors: Floats,
        /// Row of each word.
        index: HashMap<String, usize>,
    },
}

/// Captions as values of tensors.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CaptionBatch {
    /// Word vectors of shape `[captions, 22, 300]`.
    pub words: Vec<f32>,
    /// One-hot classes of shape `[captions, 22, 15]`.
    pub classes: Vec<f32>,
    /// Number of words of each caption, with markers and without padding.
    pub lengths: Vec<usize>,
}

impl Words {
    /// Reads a folder with `our_vab_data.npy` and `our_vab_idx.pkl`; none is the built-in vectors.
    ///
    /// # Errors
    /// If a file is missing or invalid; the message names it.
    pub fn open(folder: Option<&DataPath>) -> Result<Self, StageError> {
        let Some(folder) = folder else { return Ok(Self::Hashed) };
        let bad = |file: &DataPath, what: String| StageError::Input(format!("{}: {what}", file.display()));
        let data = folder.join("our_vab_data.npy");
        let array = npy::read_any_float(&data).map_err(|e| StageError::Input(e.to_string()))?;
        let [rows, WORD_WIDTH] = array.shape[..] else {
            return Err(bad(&data, format!("has shape {:?}; expected [words, {WORD_WIDTH}]", array.shape)));
        };
        let file = folder.join("our_vab_idx.pkl");
        let wanted = "expected a pickled dict from word to row";
        let (mut opened, length) = file.open().map_err(|e| bad(&file, e.to_string()))?;
        if length > limits::VOCABULARY_BYTES {
            return Err(bad(&file, format!("has {length} bytes; at most {} are read", limits::VOCABULARY_BYTES)));
        }
        // An archive, which the reader would unpack, could be of any size there.
        let mut magic = [0; 2];
        if opened.read_exact(&mut magic).is_ok() && &magic == b"PK" {
            return Err(bad(&file, format!("is an archive; {wanted}")));
        }
        let held = file.hold().map_err(|e| bad(&file, e.to_string()))?;
        let value = PytorchReader::read_pickle_data(held.path(), None)
            .map_err(|e| bad(&file, format!("{}; {wanted}", text_models::no_torch(&e))))?;
        let PickleValue::Dict(dict) = value else { return Err(bad(&file, wanted.into())) };
        let mut index = HashMap::with_capacity(dict.len());
        for (word, row) in dict {
            match row {
                PickleValue::Int(row) if usize::try_from(row).is_ok_and(|row| row < rows) => {
                    index.insert(word, row as usize);
                }
                PickleValue::Int(row) => {
                    let word = excerpt(&word);
                    return Err(bad(
                        &file,
                        format!("the word `{word}` has row {row}, but the file of vectors has {rows} rows"),
                    ));
                }
                _ => return Err(bad(&file, format!("`{}` has no row; {wanted}", excerpt(&word)))),
            }
        }
        for word in ["sos", "eos", UNKNOWN] {
            if !index.contains_key(word) {
                return Err(bad(&file, format!("lacks the word `{word}`, which every caption needs")));
            }
        }
        Ok(Self::Vocabulary { vectors: array.data.into(), index })
    }

    /// The description of the vectors in an evaluator's meta.
    pub fn meta(&self) -> WordsMeta {
        match self {
            Self::Hashed => WordsMeta::Hashed,
            Self::Vocabulary { vectors, index } => {
                let mut bytes: Vec<u8> = vectors.iter().flat_map(|v| v.to_le_bytes()).collect();
                bytes.extend(protocol::canonical::to_bytes(&sorted(index)));
                WordsMeta::Vocabulary { digest: Digest::of(&bytes), words: index.len() }
            }
        }
    }

    /// Adds the vectors to an evaluator's artifact; the built-in ones need no file.
    pub fn write(&self, draft: &mut Draft) -> Result<(), StageError> {
        if let Self::Vocabulary { vectors, index } = self {
            let rows = vectors.len() / WORD_WIDTH;
            draft.add(
                VECTORS_FILE,
                Tensors::default().with("vectors", [rows, WORD_WIDTH], vectors.to_vec()).to_bytes()?,
            )?;
            draft.add(INDEX_FILE, protocol::canonical::to_bytes(&sorted(index)))?;
        }
        Ok(())
    }

    /// Reads the vectors of an evaluator.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, meta: &WordsMeta) -> Result<Self, StageError> {
        if *meta == WordsMeta::Hashed {
            return Ok(Self::Hashed);
        }
        let bad = |text: String| StageError::Context(ContextError::Corrupt(format!("the evaluator's words: {text}")));
        let mut tensors = Tensors::from_bytes(artifacts::mapped(blobs, manifest, VECTORS_FILE)?, VECTORS_FILE)?;
        let vectors = tensors.take("vectors", 2, VECTORS_FILE)?.values;
        let index: HashMap<String, usize> = serde_json::from_slice(&artifacts::file(blobs, manifest, INDEX_FILE)?)
            .map_err(|e| bad(format!("{INDEX_FILE}: {e}")))?;
        let words = Self::Vocabulary { vectors, index };
        if words.meta() == *meta {
            Ok(words)
        } else {
            Err(bad("their digest differs from the one in its manifest".into()))
        }
    }

    /// Vector and class of a token `word/POS`.
    fn token(&self, token: &str) -> (Vec<f32>, usize) {
        let word = split_token(token).map_or(token, |(word, _)| word);
        match self {
            Self::Hashed => (hashed_word(word).to_vec(), pos_class(token)),
            Self::Vocabulary { vectors, index } => {
                let known = index.get(word);
                let row = known.or_else(|| index.get(UNKNOWN)).copied().unwrap_or_default();
                let class = if known.is_some() { pos_class(token) } else { OTHER };
                (vectors[row * WORD_WIDTH..(row + 1) * WORD_WIDTH].to_vec(), class)
            }
        }
    }

    /// Converts captions to the form that an evaluator reads.
    pub fn batch<'a>(&self, captions: impl IntoIterator<Item = &'a Caption>) -> CaptionBatch {
        let mut batch = CaptionBatch::default();
        for caption in captions {
            let (tokens, length) = padded_tokens(&caption.tokens);
            for token in &tokens {
                let (vector, class) = self.token(token);
                batch.words.extend(vector);
                batch.classes.extend((0..CLASSES).map(|c| if c == class { 1.0 } else { 0.0 }));
            }
            batch.lengths.push(length);
        }
        batch
    }
}

fn sorted(index: &HashMap<String, usize>) -> BTreeMap<&str, usize> {
    index.iter().map(|(word, row)| (word.as_str(), *row)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn captions_have_the_published_form() {
        let caption = Caption::whole("a man walks", ["a/DET", "man/NOUN", "walk/VERB"].map(str::to_owned).to_vec());
        let batch = Words::Hashed.batch([&caption]);
        assert_eq!((batch.words.len(), batch.classes.len(), &batch.lengths[..]), (22 * 300, 22 * 15, &[5][..]));
        let class = |i: usize| batch.classes[i * 15..(i + 1) * 15].iter().position(|c| *c == 1.0);
        assert_eq!((0..6).map(class).collect::<Vec<_>>(), [14, 2, 1, 12, 14, 14].map(Some));

        let index = HashMap::from([("sos", 0), ("eos", 1), ("unk", 2), ("walk", 3)].map(|(w, i)| (w.to_owned(), i)));
        let vectors: Vec<f32> = (0..4).flat_map(|row| vec![row as f32; WORD_WIDTH]).collect();
        let words = Words::Vocabulary { vectors: vectors.into(), index };
        let batch = words.batch([&caption]);
        let firsts: Vec<f32> = batch.words.iter().step_by(WORD_WIDTH).copied().take(6).collect();
        assert_eq!(firsts, [0.0, 2.0, 2.0, 3.0, 1.0, 2.0]);
        let class = |i: usize| batch.classes[i * 15..(i + 1) * 15].iter().position(|c| *c == 1.0);
        assert_eq!((0..4).map(class).collect::<Vec<_>>(), [14, 14, 14, 12].map(Some), "an unknown word is OTHER");
        assert_ne!(words.meta(), Words::Hashed.meta());
    }
}
