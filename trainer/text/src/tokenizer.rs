//! Converts captions to ids: the `tokenizers` crate under the [`Rules`] of a published model.
//!
//! The crate trusts its files, so a file is checked first. These are refused: a vocabulary larger than the network's
//! table, dropout (ids would be random), more entries than any vocabulary has, and steps that expand text before it is
//! cut. The rules replace the file's truncation and padding. A panic of the crate becomes an error.

use std::panic::{AssertUnwindSafe, catch_unwind};

use data_encoding::BASE64_NOPAD;
use protocol::{excerpt, json_mistake, limits};
use serde::de::{MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_json::{Value, json};
use tokenizers::{PostProcessor as _, TruncationParams};

use crate::error::EncoderError;
use crate::rules::Rules;

/// Largest size of a tokenizer's file, in bytes; those of the papers' encoders have at most two and a half million.
pub(crate) const TOKENIZER_BYTES: u64 = 32 << 20;
/// Largest number of steps before a text is cut.
const STEPS: usize = 16;
/// Largest number of steps that replace text, and of the bytes that each inserts.
const REPLACEMENTS: (usize, usize) = (4, 8);
/// Largest number of bytes for one character in a SentencePiece table.
const MAPPED_BYTES: usize = 64;

/// Largest number of entries of a vocabulary, of its merges, and of the tokens added to it. Those of the papers'
/// encoders have at most 49,408.
const ENTRIES: usize = 500_000;

/// Largest number of bytes of a token. The crate keeps some vocabularies as a tree with a level per byte, whose drop
/// uses stack for each level.
const TOKEN_BYTES: usize = 1_024;

/// The checked parts of `tokenizer.json`; vocabulary and merges are only counted.
#[derive(Deserialize)]
struct Looked {
    #[serde(default)]
    normalizer: Value,
    #[serde(default)]
    added_tokens: Count,
    model: LookedModel,
}

#[derive(Deserialize)]
struct LookedModel {
    #[serde(default)]
    dropout: Option<f64>,
    #[serde(default)]
    vocab: Count,
    #[serde(default)]
    merges: Count,
}

/// Number of entries of a list or mapping, and size of the longest text in it at any depth; no entry is kept.
#[derive(Default)]
struct Count {
    entries: usize,
    longest: usize,
}

impl Count {
    fn add(&mut self, part: &Self) {
        self.longest = self.longest.max(part.longest);
    }
}

impl<'de> Deserialize<'de> for Count {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Counts)
    }
}

struct Counts;

impl<'de> Visitor<'de> for Counts {
    type Value = Count;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Count, E> {
        Ok(Count::default())
    }

    fn visit_bool<E>(self, _: bool) -> Result<Count, E> {
        Ok(Count::default())
    }

    fn visit_i64<E>(self, _: i64) -> Result<Count, E> {
        Ok(Count::default())
    }

    fn visit_u64<E>(self, _: u64) -> Result<Count, E> {
        Ok(Count::default())
    }

    fn visit_f64<E>(self, _: f64) -> Result<Count, E> {
        Ok(Count::default())
    }

    fn visit_str<E>(self, text: &str) -> Result<Count, E> {
        Ok(Count { entries: 0, longest: text.len() })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Count, A::Error> {
        let mut count = Count::default();
        while let Some(value) = list.next_element::<Count>()? {
            count.entries += 1;
            count.add(&value);
        }
        Ok(count)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Count, A::Error> {
        let mut count = Count::default();
        while let Some((key, value)) = map.next_entry::<Count, Count>()? {
            count.entries += 1;
            count.add(&key);
            count.add(&value);
        }
        Ok(count)
    }
}

/// A tokenizer under a model's rules.
#[derive(Debug)]
pub struct Tokenizer {
    inner: tokenizers::Tokenizer,
    rules: Rules,
    rows: usize,
}

impl Tokenizer {
    /// Creates a tokenizer from the bytes of a `tokenizer.json`, for a token table of `rows` rows; `place` names the
    /// file in errors.
    ///
    /// # Errors
    /// The defect of the file or of the rules.
    pub fn new(place: &str, json: &[u8], rules: &Rules, rows: usize) -> Result<Self, EncoderError> {
        let refuse = |what: String| EncoderError::new(place, what);
        let inner = parsed(place, json)?;
        let known = inner.get_vocab(true);
        if let Some((word, id)) = known.iter().filter(|(_, id)| **id as usize >= rows).min() {
            let word = excerpt(word);
            return Err(refuse(format!(
                "the token `{word}` has id {id}, but the embedding table has {rows} rows; use the tokenizer and the \
                 weights of the same model"
            )));
        }
        if let Some(id) = [rules.end, rules.pad].into_iter().chain(rules.first).find(|id| *id as usize >= rows) {
            return Err(refuse(format!(
                "the tokenizer uses the token id {id}, but the embedding table has {rows} rows; use the tokenizer and the \
                 weights of the same model"
            )));
        }
        if rules.most <= rules.added() {
            return Err(refuse(format!(
                "a limit of {} tokens leaves no room for a caption; expected at least 3",
                rules.most
            )));
        }
        let added = inner.get_post_processor().map_or(0, |post| post.added_tokens(false));
        if added != rules.added() {
            return Err(refuse(format!(
                "adds {added} tokens to a caption; expected {}, the number of special tokens of this model",
                rules.added()
            )));
        }
        let mut inner = inner;
        inner.with_padding(None);
        let cut = TruncationParams { max_length: rules.most, ..TruncationParams::default() };
        inner.with_truncation(Some(cut)).map_err(|e| refuse(excerpt(&e.to_string())))?;
        Ok(Self { inner, rules: rules.clone(), rows })
    }

    /// Looks up the id of a token in a `tokenizer.json`.
    ///
    /// # Errors
    /// As [`new`](Self::new), and if there is no such token.
    pub(crate) fn id(place: &str, json: &[u8], token: &str) -> Result<u32, EncoderError> {
        let tokenizer = parsed(place, json)?;
        tokenizer.token_to_id(token).ok_or_else(|| {
            EncoderError::new(place, format!("no token `{}`, which every caption needs", excerpt(token)))
        })
    }

    /// Rules for the steps before and after it.
    pub fn rules(&self) -> &Rules {
        &self.rules
    }

    /// The ids of a caption, the end last, without padding: at least one.
    ///
    /// # Errors
    /// If the caption exceeds the limit, or the tokenizer fails.
    pub fn ids(&self, caption: &str) -> Result<Vec<u32>, EncoderError> {
        let refuse = |what: String| EncoderError::new(format!("the caption `{}`", excerpt(caption)), what);
        if caption.len() > limits::CAPTION_BYTES {
            let found = caption.len();
            let most = limits::CAPTION_BYTES;
            return Err(refuse(format!("has {found} bytes; expected at most {most}")));
        }
        let text = self.rules.prepared(caption);
        let encoded = catch_unwind(AssertUnwindSafe(|| self.inner.encode_fast(text.as_str(), true)))
            .map_err(|_| refuse("the tokenizer failed; its file is damaged".into()))?
            .map_err(|e| refuse(format!("the tokenizer failed: {}", excerpt(&e.to_string()))))?;
        let ids = encoded.get_ids().to_vec();
        let sound = ids.len() <= self.rules.most
            && ids.iter().all(|id| (*id as usize) < self.rows)
            && ids.last() == Some(&self.rules.end)
            && self.rules.first.is_none_or(|first| ids.first() == Some(&first));
        if !sound {
            return Err(refuse(format!("has the ids {ids:?}, which do not form a caption of this model")));
        }
        Ok(ids)
    }

    /// The ids of a caption, padded to `length`, and their number before padding.
    ///
    /// # Errors
    /// As [`ids`](Self::ids).
    pub fn padded(&self, caption: &str, length: usize) -> Result<(Vec<u32>, usize), EncoderError> {
        let mut ids = self.ids(caption)?;
        let own = ids.len();
        ids.resize(length.max(own), self.rules.pad);
        Ok((ids, own))
    }
}

/// Creates the tokenizer of a checked file.
fn parsed(place: &str, json: &[u8]) -> Result<tokenizers::Tokenizer, EncoderError> {
    let refuse = |what: String| EncoderError::new(place, what);
    let expected = "expected a `tokenizer.json` of Hugging Face tokenizers";
    let looked: Looked =
        serde_json::from_slice(json).map_err(|e| refuse(format!("{}; {expected}", json_mistake(&e))))?;
    let counted = [("model.vocab", &looked.model.vocab), ("model.merges", &looked.model.merges)];
    for (what, Count { entries, longest }) in counted.into_iter().chain([("added_tokens", &looked.added_tokens)]) {
        if *entries > ENTRIES {
            return Err(refuse(format!("`{what}` has {entries} entries; expected at most {ENTRIES}")));
        }
        if *longest > TOKEN_BYTES {
            return Err(refuse(format!("`{what}` has a token of {longest} bytes; expected at most {TOKEN_BYTES}")));
        }
    }
    if looked.model.dropout.is_some_and(|share| share != 0.0) {
        return Err(refuse("`model.dropout` is set, which makes the ids random; set it to null".into()));
    }
    let mut steps = (0, 0);
    check_normalizer(&looked.normalizer, &mut steps).map_err(refuse)?;
    catch_unwind(|| tokenizers::Tokenizer::from_bytes(json))
        .map_err(|_| refuse(format!("cannot be read; {expected}")))?
        .map_err(|e| refuse(format!("{}; {expected}", excerpt(&e.to_string()))))
}

/// Refuses steps that would expand text; `met` counts steps, and those of them that replace.
fn check_normalizer(step: &Value, met: &mut (usize, usize)) -> Result<(), String> {
    let kind = match step["type"].as_str() {
        Some(kind) => kind,
        None if step.is_null() => return Ok(()),
        None => return Err("a step of `normalizer` has no `type`".into()),
    };
    met.0 += 1;
    let text = |key: &str| step[key].as_str().unwrap_or_default();
    match kind {
        "Sequence" => {
            for step in step["normalizers"].as_array().into_iter().flatten() {
                check_normalizer(step, met)?;
            }
        }
        "Replace" | "Prepend" => {
            met.1 += 1;
            let longest = text("content").len().max(text("prepend").len());
            if met.1 > REPLACEMENTS.0 || longest > REPLACEMENTS.1 {
                let (times, bytes) = REPLACEMENTS;
                return Err(format!(
                    "`normalizer` has a replacement that applies more than {times} times, or has more than {bytes} \
                     bytes"
                ));
            }
        }
        "Precompiled" => check_character_map(text("precompiled_charsmap"))?,
        _ => {}
    }
    if met.0 > STEPS { Err(format!("`normalizer` has more than {STEPS} steps")) } else { Ok(()) }
}

/// Checks SentencePiece's table in base64: the bytes of a trie of 32-bit units, the trie, and zero-terminated texts.
fn check_character_map(text: &str) -> Result<(), String> {
    let broken = || "`precompiled_charsmap` of `normalizer` is damaged".to_owned();
    let bytes = BASE64_NOPAD.decode(text.trim_end_matches('=').as_bytes()).map_err(|_| broken())?;
    let (head, rest) = bytes.split_first_chunk::<4>().ok_or_else(broken)?;
    let trie = u32::from_le_bytes(*head) as usize;
    if !trie.is_multiple_of(4) || trie > rest.len() {
        return Err(broken());
    }
    let longest = rest[trie..].split(|byte| *byte == 0).map(<[u8]>::len).max().unwrap_or_default();
    if longest > MAPPED_BYTES {
        return Err(format!(
            "`precompiled_charsmap` maps a character to {longest} bytes; expected at most {MAPPED_BYTES}"
        ));
    }
    Ok(())
}

/// Makes CLIP's `tokenizer.json` from its `vocab.json` and `merges.txt`, for folders without one.
///
/// Source: the converter of `CLIPTokenizer` in Hugging Face's transformers.
///
/// # Errors
/// The invalid file.
pub(crate) fn clip_from_parts(vocab: (&str, &[u8]), merges: (&str, &[u8])) -> Result<Vec<u8>, EncoderError> {
    let table: serde_json::Map<String, Value> = serde_json::from_slice(vocab.1).map_err(|e| {
        EncoderError::new(vocab.0, format!("{}; expected a mapping from tokens to ids", json_mistake(&e)))
    })?;
    let id = |token: &str| {
        table
            .get(token)
            .and_then(Value::as_u64)
            .ok_or_else(|| EncoderError::new(vocab.0, format!("no token `{token}`, which every caption needs")))
    };
    let start = "<|startoftext|>";
    let end = "<|endoftext|>";
    let first = id(start)?;
    let last = id(end)?;
    let text = std::str::from_utf8(merges.1).map_err(|e| EncoderError::new(merges.0, e.to_string()))?;
    // The last line may lack its end, or an empty line may follow.
    let lines = text.lines().filter(|line| !line.starts_with("#version") && !line.is_empty());
    let mut pairs = Vec::new();
    for line in lines {
        let Some((left, right)) = line.split_once(' ').filter(|(_, right)| !right.contains(' ')) else {
            let what = format!("the line `{}` is not a merge; expected two tokens", excerpt(line));
            return Err(EncoderError::new(merges.0, what));
        };
        pairs.push(json!([left, right]));
    }
    let special = |id: u64, token: &str| json!({"id": id, "content": token, "single_word": false, "lstrip": false, "rstrip": false, "normalized": true, "special": true});
    let words = "'s|'t|'re|'ve|'m|'ll|'d|[\\p{L}]+|[\\p{N}]|[^\\s\\p{L}\\p{N}]+";
    let whole = json!({
        "version": "1.0",
        "truncation": null,
        "padding": null,
        "added_tokens": [special(first, start), special(last, end)],
        "normalizer": {"type": "Sequence", "normalizers": [
            {"type": "NFC"},
            {"type": "Replace", "pattern": {"Regex": "\\s+"}, "content": " "},
            {"type": "Lowercase"},
        ]},
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": [
            {"type": "Split", "pattern": {"Regex": words}, "behavior": "Removed", "invert": true},
            {"type": "ByteLevel", "add_prefix_space": false, "trim_offsets": true, "use_regex": true},
        ]},
        "post_processor": {
            "type": "RobertaProcessing", "sep": [end, last], "cls": [start, first], "trim_offsets": false, "add_prefix_space": false,
        },
        "decoder": null,
        "model": {
            "type": "BPE", "dropout": null, "unk_token": end, "continuing_subword_prefix": "", "end_of_word_suffix": "</w>",
            "fuse_unk": false, "byte_fallback": false, "ignore_merges": false, "vocab": table, "merges": pairs,
        },
    });
    Ok(whole.to_string().into_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rules() -> Rules {
        Rules { repair: false, strip: false, lower: false, first: Some(4), end: 5, pad: 5, most: 6 }
    }

    fn clip() -> Value {
        let vocab =
            json!({"a": 0, "b": 1, "a</w>": 2, "ab</w>": 3, "<|startoftext|>": 4, "<|endoftext|>": 5, "b</w>": 6});
        let merges = "#version: 0.2\na b</w>\n";
        let json = clip_from_parts(("v", vocab.to_string().as_bytes()), ("m", merges.as_bytes())).unwrap();
        serde_json::from_slice(&json).unwrap()
    }

    fn refused(file: &Value, rules: &Rules, rows: usize) -> String {
        Tokenizer::new("t", file.to_string().as_bytes(), rules, rows).unwrap_err().to_string()
    }

    #[test]
    fn captions_are_cut_between_their_ends() {
        protocol::show_excerpts();
        let tokenizer = Tokenizer::new("t", clip().to_string().as_bytes(), &rules(), 7).unwrap();
        let ids = |caption: &str| tokenizer.ids(caption).unwrap();
        assert_eq!(ids("AB  a"), [4, 3, 2, 5]);
        assert_eq!(ids(""), [4, 5]);
        assert_eq!(ids("a a a a a a"), [4, 2, 2, 2, 2, 5], "the end stays");
        assert_eq!(tokenizer.padded("ab", 5).unwrap(), (vec![4, 3, 5, 5, 5], 3));
        let long = tokenizer.ids(&"a ".repeat(5_000)).unwrap_err().to_string();
        assert!(long.contains("has 10000 bytes; expected at most 8192"), "{long}");
    }

    #[test]
    fn files_that_would_break_what_follows_are_refused() {
        protocol::show_excerpts();
        let with = |change: &dyn Fn(&mut Value)| {
            let mut file = clip();
            change(&mut file);
            file
        };
        assert!(refused(&clip(), &rules(), 6).contains("`b</w>` has id 6, but the embedding table has 6 rows"));
        let drawn = with(&|file| file["model"]["dropout"] = json!(0.1));
        assert!(refused(&drawn, &rules(), 7).contains("makes the ids random"));
        let bare = with(&|file| file["post_processor"] = Value::Null);
        assert!(refused(&bare, &rules(), 7).contains("adds 0 tokens to a caption; expected 2"));
        let doubling = with(&|file| {
            let step = json!({"type": "Replace", "pattern": {"String": "a"}, "content": "aa"});
            file["normalizer"] = json!({"type": "Sequence", "normalizers": vec![step; 9]});
        });
        assert!(refused(&doubling, &rules(), 7).contains("applies more than 4 times"));
        // An empty trie, and a text of seventy bytes.
        let map = format!("AAAAAEFB{}", "QUFB".repeat(24));
        let wide = with(&|file| file["normalizer"] = json!({"type": "Precompiled", "precompiled_charsmap": map}));
        assert!(refused(&wide, &rules(), 7).contains("maps a character"), "{}", refused(&wide, &rules(), 7));
        let broken = with(&|file| file["normalizer"] = json!({"type": "Precompiled", "precompiled_charsmap": "////"}));
        assert!(refused(&broken, &rules(), 7).contains("is damaged"));
        let merge = with(&|file| file["model"]["merges"] = json!([["a", "zzz"]]));
        assert!(refused(&merge, &rules(), 7).contains("t: "));
        let long = with(&|file| file["model"]["vocab"]["a".repeat(1_025)] = json!(0));
        assert!(refused(&long, &rules(), 7).contains("`model.vocab` has a token of 1025 bytes; expected at most 1024"));
        let short = Rules { most: 2, ..rules() };
        assert!(refused(&clip(), &short, 7).contains("leaves no room"));
        for text in ["", "{", "[]", "{\"model\": 3}", "\"\\ud800\"", &"[".repeat(10_000)] {
            let said = Tokenizer::new("t", text.as_bytes(), &rules(), 7).unwrap_err().to_string();
            assert!(said.starts_with("t: "), "{said}");
        }
        let merges = clip_from_parts(("v", clip()["model"]["vocab"].to_string().as_bytes()), ("m", b"a b c"));
        assert!(merges.unwrap_err().to_string().contains("m: the line `a b c` is not a merge"));
        let none = clip_from_parts(("v", b"{}"), ("m", b"")).unwrap_err().to_string();
        assert!(none.contains("v: no token `<|startoftext|>`"));
    }

    /// Overwritten, cut and doubled bytes must not cause a panic, nor an id outside the table.
    #[test]
    fn no_bytes_break_it() {
        protocol::show_excerpts();
        let whole = clip().to_string().into_bytes();
        let mut state = 0x9e37_79b9_7f4a_7c15_u64;
        let mut next = move |bound: usize| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state % bound.max(1) as u64) as usize
        };
        for _ in 0..2_000 {
            let mut bytes = whole.clone();
            for _ in 0..=next(3) {
                let at = next(bytes.len());
                match next(4) {
                    0 => bytes.truncate(at.max(1)),
                    1 => bytes.splice(at..at, [b'9'; 3]).for_each(drop),
                    _ => bytes[at] = [0, 0xff, b'9', b'0', b'"', b'}', b'a'][next(7)],
                }
            }
            if let Ok(tokenizer) = Tokenizer::new("t", &bytes, &rules(), 7)
                && let Ok(ids) = tokenizer.ids("ab a b \u{1f600}")
            {
                assert!(ids.iter().all(|id| *id < 7));
            }
        }
    }
}
