//! Captions: the line grammar of the `texts/` folder, the token form of the evaluators, and the built-in embedding.
//!
//! A line is `caption#token token ...#from#to`, a token `word/POS`, the times seconds (`nan` reads as 0). Both times 0
//! mean that the caption describes the whole clip. A fifth field is the caption in other words, as in SATO's files. As in
//! the published loaders, later fields are ignored, and a caption whose times are no valid range is not used; see
//! [`Oddity`]. Source of grammar, classes and word lists: the
//! HumanML3D and text-to-motion data definitions.

use std::path::{Path, PathBuf};

use protocol::units::counted;
use protocol::{excerpt, limits};
use serde::{Deserialize, Serialize};

/// Width of [`hashed_embedding`].
pub const EMBEDDING_WIDTH: usize = 768;

/// Width of [`hashed_word`].
pub const WORD_WIDTH: usize = 300;

/// Largest number of a caption's tokens that the evaluators read, without the two markers.
pub const MAX_TOKENS: usize = 20;

/// One caption of a clip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Caption {
    /// The sentence in natural language.
    pub text: String,
    /// Tokens in the form `word/POS`.
    pub tokens: Vec<String>,
    /// Start in seconds; if `to_s` is 0 too, the caption describes the whole clip.
    pub from_s: f64,
    /// End in seconds.
    pub to_s: f64,
    /// The sentence in other words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub perturbed: Option<String>,
}

/// A caption line that does not parse.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}:{line}: {what}; expected `caption#word/POS word/POS ...#from_seconds#to_seconds`", file.display())]
pub struct TextError {
    /// Path of the text file.
    pub file: PathBuf,
    /// Line number, from 1.
    pub line: usize,
    /// Defect of the line.
    pub what: String,
}

impl Caption {
    /// Creates a caption of a whole clip.
    pub fn whole(text: impl Into<String>, tokens: Vec<String>) -> Self {
        Self { text: text.into(), tokens, from_s: 0.0, to_s: 0.0, perturbed: None }
    }

    /// Returns true if it describes the whole clip.
    pub fn is_whole(&self) -> bool {
        self.from_s == 0.0 && self.to_s == 0.0
    }

    /// The described frames `from..to` at `fps`, both truncated; `None` for the whole clip.
    pub fn frames(&self, fps: f64) -> Option<(usize, usize)> {
        (!self.is_whole()).then_some(((self.from_s * fps) as usize, (self.to_s * fps) as usize))
    }

    /// Reads one line, with any times. The error describes the defect, without file and line.
    pub fn parse(line: &str) -> Result<Self, String> {
        if line.len() > limits::CAPTION_BYTES {
            return Err(format!("the line has {} bytes; expected at most {}", line.len(), limits::CAPTION_BYTES));
        }
        let mut fields = line.trim().split('#');
        let (Some(text), Some(tokens), Some(from), Some(to)) =
            (fields.next(), fields.next(), fields.next(), fields.next())
        else {
            return Err(format!(
                "the line has {} separated by `#`; expected 4",
                counted(line.trim().split('#').count(), "field")
            ));
        };
        if text.trim().is_empty() {
            return Err("the caption is empty".into());
        }
        let tokens: Vec<String> = tokens.split_whitespace().map(str::to_owned).collect();
        if let Some(token) = tokens.iter().find(|t| split_token(t).is_none()) {
            return Err(format!("token `{}` is not `word/POS`", excerpt(token)));
        }
        let perturbed = fields.next().map(str::trim).filter(|text| !text.is_empty()).map(str::to_owned);
        Ok(Self { text: text.to_owned(), tokens, from_s: seconds(from)?, to_s: seconds(to)?, perturbed })
    }

    /// Returns true if its times describe the whole clip or a valid part of it.
    fn has_range(&self) -> bool {
        self.is_whole() || (self.from_s >= 0.0 && self.from_s < self.to_s && self.to_s.is_finite())
    }

    /// Writes the line that [`Caption::parse`] reads.
    pub fn to_line(&self) -> String {
        let perturbed = self.perturbed.iter().map(|text| format!("#{text}")).collect::<String>();
        format!("{}#{}#{:?}#{:?}{perturbed}", self.text, self.tokens.join(" "), self.from_s, self.to_s)
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let value: f64 = text.trim().parse().map_err(|_| format!("time `{}` is not a number of seconds", excerpt(text)))?;
    Ok(if value.is_nan() { 0.0 } else { value })
}

/// Word and POS of a token that has exactly these two parts.
pub fn split_token(token: &str) -> Option<(&str, &str)> {
    token.split_once('/').filter(|(word, pos)| !word.is_empty() && !pos.is_empty() && !pos.contains('/'))
}

/// Irregularities that the published loaders ignore silently.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Oddity {
    /// The times are no valid range, so the caption is not used. Holds them as written.
    Times(String),
    /// The line has this many fields; those after the fifth are ignored.
    ExtraFields(usize),
}

/// Content of a text file, by line.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Texts {
    /// Captions that describe a clip or a part of it.
    pub captions: Vec<(usize, Caption)>,
    /// Irregular lines and their kind.
    pub odd: Vec<(usize, Oddity)>,
}

/// Reads a text file: every line that is not blank. The error lists the lines that do not parse, at most
/// [`limits::MISTAKES`] of them.
pub fn parse_file(file: &Path, content: &str) -> Result<Texts, Vec<TextError>> {
    let mut texts = Texts::default();
    let mut errors = vec![];
    for (i, line) in content.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let caption = match Caption::parse(line) {
            Ok(caption) => caption,
            Err(what) => {
                errors.push(TextError { file: file.into(), line: i + 1, what });
                // Each error names the file, so many of them would take far more memory than the text.
                if errors.len() >= limits::MISTAKES {
                    break;
                }
                continue;
            }
        };
        let fields = line.trim().split('#').count();
        if fields > 5 {
            texts.odd.push((i + 1, Oddity::ExtraFields(fields)));
        }
        if caption.has_range() {
            texts.captions.push((i + 1, caption));
        } else {
            texts.odd.push((i + 1, Oddity::Times(format!("{} to {} s", caption.from_s, caption.to_s))));
        }
    }
    if errors.is_empty() { Ok(texts) } else { Err(errors) }
}

/// Tokens in the form that evaluators read: `sos/OTHER`, at most 20 tokens, `eos/OTHER`, padded to 22 with `unk/OTHER`.
/// Also returns their number before padding.
pub fn padded_tokens(tokens: &[String]) -> (Vec<String>, usize) {
    let mut padded = vec!["sos/OTHER".to_owned()];
    padded.extend(tokens.iter().take(MAX_TOKENS).cloned());
    padded.push("eos/OTHER".to_owned());
    let sent_len = padded.len();
    padded.resize(MAX_TOKENS + 2, "unk/OTHER".to_owned());
    (padded, sent_len)
}

/// Names of the 15 POS classes, by class index.
pub const POS_CLASSES: [&str; 15] = [
    "VERB", "NOUN", "DET", "ADP", "NUM", "AUX", "PRON", "ADJ", "ADV", "Loc_VIP", "Body_VIP", "Obj_VIP", "Act_VIP",
    "Desc_VIP", "OTHER",
];

const PLACES: &str = "left right clockwise counterclockwise anticlockwise forward back backward up down straight curve";
const BODY: &str = "arm chin foot feet face hand mouth leg waist eye knee shoulder thigh";
const OBJECTS: &str = "stair dumbbell chair window floor car ball handrail baseball basketball";
const ACTIONS: &str = "walk run swing pick bring kick put squat throw hop dance jump turn stumble stop sit lift lower \
    raise wash stand kneel stroll rub bend balance flap jog shuffle lean rotate spin spread climb";
const MANNERS: &str = "slowly carefully fast careful slow quickly happy angry sad happily angrily sadly";

/// POS class of a token whose word is in the evaluator's vocabulary. A word of one of the five lists has the list's
/// class, for any tag. (A word outside the vocabulary is `unk` with class OTHER. Only the owner of the vocabulary can
/// decide that, so the caller handles it.)
pub fn pos_class(token: &str) -> usize {
    let (word, pos) = split_token(token).unwrap_or((token, "OTHER"));
    let lists = [PLACES, BODY, OBJECTS, ACTIONS, MANNERS];
    if let Some(i) = lists.iter().position(|list| list.split_whitespace().any(|w| w == word)) {
        return 9 + i;
    }
    POS_CLASSES[..9].iter().position(|class| *class == pos).unwrap_or(14)
}

fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3))
}

/// The last mixing steps of MurmurHash3 (64 bit): FNV alone leaves the upper bits of short words too similar.
fn finalise(mut h: u64) -> u64 {
    h = (h ^ (h >> 33)).wrapping_mul(0xff51_afd7_ed55_8ccd);
    h = (h ^ (h >> 33)).wrapping_mul(0xc4ce_b9fe_1a85_ec53);
    h ^ (h >> 33)
}

/// End marker of a caption; an empty caption has nothing else.
const END: &str = "</s>";

/// The words of a caption: lower-cased, separated by everything outside `[a-z0-9]`.
pub fn words(caption: &str) -> Vec<String> {
    let lower = caption.to_lowercase();
    let words = lower.split(|c: char| !matches!(c, 'a'..='z' | '0'..='9')).filter(|w| !w.is_empty());
    words.map(str::to_owned).collect()
}

/// The coordinate and sign that a word or a pair of words is hashed to.
fn hashed_gram(gram: &str) -> (usize, i32) {
    let h = finalise(fnv1a(gram.as_bytes()));
    ((h % EMBEDDING_WIDTH as u64) as usize, if h >> 63 == 0 { 1 } else { -1 })
}

/// The built-in text encoder by token: each word of the caption and its end as a signed coordinate, in order.
pub fn hashed_tokens(caption: &str) -> Vec<[f32; EMBEDDING_WIDTH]> {
    let token = |word: &str| {
        let (coordinate, sign) = hashed_gram(word);
        let mut row = [0.0; EMBEDDING_WIDTH];
        row[coordinate] = sign as f32;
        row
    };
    words(caption).iter().map(String::as_str).chain([END]).map(token).collect()
}

/// The built-in text encoder: words and word pairs hashed to signed coordinates, unit length.
///
/// It hashes `</s>`, every one of its [`words`] and every pair of neighbours joined by one space. The coordinate is
/// `h mod 768`, its sign `+1` if bit 63 of `h` is 0, else `-1`. The empty caption, the null condition of
/// classifier-free guidance, is `</s>` alone.
pub fn hashed_embedding(caption: &str) -> [f32; EMBEDDING_WIDTH] {
    let words = words(caption);
    let pairs = words.windows(2).map(|pair| pair.join(" "));
    let mut sums = [0_i32; EMBEDDING_WIDTH];
    for gram in std::iter::once(END.to_owned()).chain(words.iter().cloned()).chain(pairs) {
        let (coordinate, sign) = hashed_gram(&gram);
        sums[coordinate] += sign;
    }
    let squares: i32 = sums.iter().map(|v| v * v).sum();
    // Coordinates can cancel out; then there is no direction to normalise.
    let scale = if squares == 0 { 0.0 } else { 1.0 / f64::from(squares).sqrt() };
    sums.map(|v| (f64::from(v) * scale) as f32)
}

/// The built-in word vector: the sum of the directions of the word and of its letter triples, with `<` and `>` at its
/// ends. Its length is 6, about that of the published vectors.
///
/// The direction of a text has coordinates of +1 and -1: bit `i mod 64` of the `i div 64`-th number generated from its
/// hash. The word itself has the same weight as all its triples together.
pub fn hashed_word(word: &str) -> [f32; WORD_WIDTH] {
    const LENGTH: f64 = 6.0;
    let mut sums = [0.0_f64; WORD_WIDTH];
    let mut add = |text: &str, weight: f64| {
        let mut bits = fnv1a(text.as_bytes());
        for (i, sum) in sums.iter_mut().enumerate() {
            if i % 64 == 0 {
                bits = finalise(bits.wrapping_add(0x9e37_79b9_7f4a_7c15));
            }
            *sum += if bits >> (i % 64) & 1 == 0 { weight } else { -weight };
        }
    };
    let letters: Vec<char> = format!("<{word}>").chars().collect();
    add(word, 1.0);
    let triples: Vec<String> = letters.windows(3).map(|triple| triple.iter().collect()).collect();
    // Directions are nearly orthogonal, so the sum of n of them is root n times as long as one.
    let weight = 1.0 / (triples.len().max(1) as f64).sqrt();
    for triple in &triples {
        add(triple, weight);
    }
    let norm = sums.iter().map(|v| v * v).sum::<f64>().sqrt();
    sums.map(|v| (v * LENGTH / norm) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_has_its_published_check_values() {
        assert_eq!(fnv1a(b"a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(finalise(fnv1a(b"a")), 0x82a2_a958_a9be_ce5b);
        assert_eq!(finalise(fnv1a(b"walks forward")), 0xe88f_1947_4a1b_b973);
    }

    #[test]
    fn embeddings_have_their_published_check_values() {
        let set = |v: [f32; EMBEDDING_WIDTH]| {
            v.iter().enumerate().filter(|(_, x)| **x != 0.0).map(|(i, x)| (i, *x)).collect::<Vec<_>>()
        };
        assert_eq!(set(hashed_embedding("")), [(247, -1.0)]);
        assert_eq!(set(hashed_embedding(" ... ")), [(247, -1.0)]);
        let signs =
            [(247, -1.0), (347, -1.0), (356, 1.0), (371, -1.0), (379, -1.0), (462, 1.0), (594, 1.0), (668, 1.0)];
        let found = set(hashed_embedding("a person walks forward."));
        assert_eq!(found.len(), signs.len());
        for ((i, x), (j, sign)) in found.into_iter().zip(signs) {
            assert!(i == j && (x - sign * 0.353_553).abs() < 1e-5, "{i} {x} against {j} {sign}");
        }
    }

    #[test]
    fn word_vectors_are_apart_but_for_related_forms() {
        let cosine = |a: &str, b: &str| {
            let a = hashed_word(a);
            let b = hashed_word(b);
            a.iter().zip(&b).map(|(a, b)| f64::from(a * b)).sum::<f64>() / 36.0
        };
        assert!((cosine("walk", "walk") - 1.0).abs() < 1e-5);
        assert!(cosine("walk", "walks") > 0.2 && cosine("walk", "jump").abs() < 0.2);
    }

    #[test]
    fn a_line_survives_and_a_bad_one_is_explained() {
        protocol::show_excerpts();
        let caption = Caption::parse("a man kicks.#a/DET man/NOUN kick/VERB#2.0#6.5").unwrap();
        assert_eq!(Caption::parse(&caption.to_line()), Ok(caption.clone()));
        assert_eq!(caption.frames(20.0), Some((40, 130)));
        assert!(Caption::parse("x#x/X#nan#nan").unwrap().is_whole());
        for (line, part) in [
            ("a man kicks.", "1 field"),
            ("#a/DET#0.0#0.0", "empty"),
            ("a#a#0.0#0.0", "`a` is not"),
            ("a#a/b/c#0.0#0.0", "`a/b/c`"),
            ("a#a/DET#zero#0.0", "`zero`"),
            (&format!("{}#a/DET#0#0", "a".repeat(9_000)), "9010 bytes"),
        ] {
            let error = Caption::parse(line).unwrap_err();
            assert!(error.contains(part), "{line}: {error}");
        }
        let errors = parse_file(Path::new("texts/1.txt"), "a#a/DET#0#0\n\nb#b\n").unwrap_err();
        assert!(errors[0].to_string().starts_with("texts/1.txt:3: the line has 2 fields"), "{}", errors[0]);
    }

    #[test]
    fn what_upstream_passes_over_is_passed_over_and_told() {
        let lines = [
            "whole#whole/ADJ#0.0#nan",
            "part#part/NOUN#1.0#4.5",
            "inverted#a/DET#4.5#1.0",
            "empty#a/DET#2#2",
            "negative#a/DET#-1#3",
            "endless#a/DET#0#inf",
            "more#a/DET#0.0#0.0#5#x",
            "both#a/DET#3#1#0#5",
        ];
        let texts = parse_file(Path::new("1.txt"), &lines.join("\n")).unwrap();
        let used: Vec<(usize, &str)> = texts.captions.iter().map(|(line, c)| (*line, c.text.as_str())).collect();
        assert_eq!(used, [(1, "whole"), (2, "part"), (7, "more")]);
        let times = |line, range: &str| (line, Oddity::Times(range.to_owned()));
        let expected = [
            times(3, "4.5 to 1 s"),
            times(4, "2 to 2 s"),
            times(5, "-1 to 3 s"),
            times(6, "0 to inf s"),
            (7, Oddity::ExtraFields(6)),
            (8, Oddity::ExtraFields(6)),
            times(8, "3 to 1 s"),
        ];
        assert_eq!(texts.odd, expected);
    }

    #[test]
    fn a_fifth_field_is_the_caption_in_other_words() {
        let line = "a man walks#a/DET man/NOUN walk/VERB#0.0#0.0#a person strolls";
        let caption = Caption::parse(line).unwrap();
        assert_eq!(caption.perturbed.as_deref(), Some("a person strolls"));
        assert_eq!(caption.to_line(), line);
        assert_eq!(Caption::parse("a man walks#a/DET#0.0#0.0#").unwrap().perturbed, None);
    }

    proptest::proptest! {
        /// A line is read or explained; a line that is read has a range that frames can be cut by.
        #[test]
        fn no_line_breaks_the_reader(
            line in "\\PC{0,40}(#[a-z/ ]{0,20}){0,2}(#(nan|inf|-?[0-9]{0,3}(\\.[0-9]{0,3})?|1e400)){0,4}",
            junk in "(?s).{0,60}",
        ) {
            for line in [&line, &junk] {
                let _ = Caption::parse(line);
                if let Ok(texts) = parse_file(Path::new("1.txt"), line) {
                    for (_, caption) in texts.captions {
                        if let Some((from, to)) = caption.frames(20.0) {
                            proptest::prop_assert!(from <= to);
                        }
                    }
                }
            }
        }
    }
}
