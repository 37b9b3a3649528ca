//! The words of a model's training captions. Finds words of a prompt that no caption has, and suggests captions.
//!
//! Not its job: embedding words. A hashed encoder has a vector for every word, so only the captions show which words mean
//! something to the model.

use std::collections::{BTreeMap, BTreeSet};

use protocol::spelling;

/// Words that describe no motion: a prompt of these and unknown words gives an arbitrary one.
const FUNCTION_WORDS: [&str; 27] = [
    "a", "an", "and", "are", "at", "figure", "he", "her", "his", "in", "is", "it", "its", "man", "of", "on", "person",
    "she", "someone", "the", "their", "then", "they", "to", "while", "with", "woman",
];

/// Largest number of times that [`draws`] repeats a clip in an epoch.
const MOST_DRAWS: usize = 16;

/// The number of times that an epoch shows each clip, so that rare words are shown more often. `captions` are those of
/// each clip. A clip's weight is `(clips / clips with its rarest word)^exponent`; the clip of median weight is shown once,
/// each clip at least once.
pub fn draws(captions: &[Vec<&str>], exponent: f64) -> Vec<usize> {
    let meaning = |captions: &Vec<&str>| -> BTreeSet<String> {
        let all = captions.iter().flat_map(|caption| words(caption));
        all.filter(|word| !FUNCTION_WORDS.contains(&word.as_str())).collect()
    };
    let mut clips_with: BTreeMap<String, usize> = BTreeMap::new();
    for word in captions.iter().flat_map(meaning) {
        *clips_with.entry(word).or_default() += 1;
    }
    let rarest = |clip: &Vec<&str>| meaning(clip).iter().map(|word| clips_with[word]).min().unwrap_or(captions.len());
    let weights: Vec<f64> =
        captions.iter().map(|clip| (captions.len() as f64 / rarest(clip) as f64).powf(exponent)).collect();
    let mut sorted = weights.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(1.0);
    weights.iter().map(|weight| ((weight / median).round() as usize).clamp(1, MOST_DRAWS)).collect()
}

/// Words and sentences of training captions.
#[derive(Debug, Clone, Default)]
pub struct Vocabulary {
    /// The number of sentences that have a word.
    words: BTreeMap<String, usize>,
    /// The number of captions that are a sentence.
    sentences: BTreeMap<String, usize>,
}

impl Vocabulary {
    /// The vocabulary of these captions.
    pub fn of<'a>(captions: impl IntoIterator<Item = &'a str>) -> Self {
        let mut vocabulary = Self::default();
        for caption in captions {
            let sentence = caption.trim().trim_end_matches('.').to_lowercase();
            let count = vocabulary.sentences.entry(sentence).or_default();
            *count += 1;
            if *count == 1 {
                for word in words(caption).collect::<BTreeSet<_>>() {
                    *vocabulary.words.entry(word).or_default() += 1;
                }
            }
        }
        vocabulary
    }

    /// The words of `prompt` that no caption has, in their order.
    pub fn unknown(&self, prompt: &str) -> Vec<String> {
        let mut unknown = Vec::new();
        for word in words(prompt) {
            if !self.words.contains_key(&word) && !unknown.contains(&word) {
                unknown.push(word);
            }
        }
        unknown
    }

    /// Returns true if a caption has a word of `prompt` that may describe a motion.
    pub fn has_any(&self, prompt: &str) -> bool {
        words(prompt).any(|word| self.words.contains_key(&word) && !FUNCTION_WORDS.contains(&word.as_str()))
    }

    /// The sentences that share most with `prompt`, at most `count`: rare words count more than frequent ones, and a word that is
    /// nearly one of the prompt's counts half. Without anything shared, the most frequent sentences.
    pub fn nearest(&self, prompt: &str, count: usize) -> Vec<&str> {
        let mut wanted: BTreeMap<&str, f64> = BTreeMap::new();
        for word in words(prompt) {
            let (known, share) = match self.words.get_key_value(&word) {
                Some((known, _)) => (Some(known.as_str()), 1.0),
                None => (self.similar(&word), 0.5),
            };
            if let Some(known) = known {
                let rarity = (1.0 + self.sentences.len() as f64 / self.words[known] as f64).ln();
                wanted.insert(known, share * rarity);
            }
        }
        let score = |sentence: &str| {
            let own: BTreeSet<String> = words(sentence).collect();
            let shared: f64 = own.iter().filter_map(|word| wanted.get(word.as_str())).sum();
            // Of sentences that share as much, the one that says least besides.
            shared / (1.0 + 0.05 * own.len() as f64)
        };
        let mut scored: Vec<(f64, usize, &str)> =
            self.sentences.iter().map(|(sentence, count)| (score(sentence), *count, sentence.as_str())).collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)).then(a.2.cmp(b.2)));
        scored.into_iter().take(count).map(|(_, _, sentence)| sentence).collect()
    }

    /// The known word that `word` is nearly: another form of it, or a slip.
    fn similar(&self, word: &str) -> Option<&str> {
        let letters: Vec<char> = word.chars().collect();
        let stem: String = letters[..letters.len().min(4)].iter().collect();
        let forms = self.words.keys().filter(|known| letters.len() >= 4 && known.starts_with(&stem));
        let form = forms.min_by_key(|known| spelling::distance(word, known));
        form.map(String::as_str).or_else(|| spelling::nearest(word, self.words.keys().map(String::as_str)))
    }
}

/// Words in small letters, without marks.
fn words(text: &str) -> impl Iterator<Item = String> + '_ {
    text.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).map(str::to_lowercase)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clips_with_rare_words_are_drawn_more_often() {
        let mut clips = vec![vec!["a person walks", "someone is walking"]; 20];
        clips.push(vec!["a person bows"]);
        // 21 to the power of one half is 4.6; the walks have 1.02.
        assert_eq!(draws(&clips, 0.5), [&[1; 20][..], &[4]].concat());
        assert_eq!(draws(&clips, 0.0), vec![1; 21]);
        assert_eq!(draws(&clips, 2.0)[20], MOST_DRAWS);
        assert_eq!(draws(&[], 1.0), Vec::<usize>::new());
    }

    fn vocabulary() -> Vocabulary {
        Vocabulary::of([
            "a person walks forward.",
            "a person walks forward",
            "a person walks in a circle",
            "a person jumps up",
            "someone kicks with the right leg",
        ])
    }

    #[test]
    fn words_that_training_never_saw_are_named() {
        let vocabulary = vocabulary();
        assert_eq!(vocabulary.unknown("quantum Flapdoodle, quantum"), ["quantum", "flapdoodle"]);
        assert!(!vocabulary.has_any("quantum flapdoodle"));
        assert_eq!(vocabulary.unknown("A person WALKS, up."), [""; 0]);
        assert_eq!(vocabulary.unknown("a person moonwalks"), ["moonwalks"]);
        assert!(!vocabulary.has_any("a person moonwalks"), "the known words describe no motion");
        assert!(vocabulary.has_any("a person jumps and moonwalks"));
        assert_eq!(vocabulary.unknown(""), [""; 0]);
    }

    #[test]
    fn the_nearest_sentences_share_rare_words_or_nearly_do() {
        let vocabulary = vocabulary();
        assert_eq!(vocabulary.nearest("somebody kicked high", 1), ["someone kicks with the right leg"]);
        assert_eq!(vocabulary.nearest("walk around a circel", 1), ["a person walks in a circle"]);
        assert_eq!(vocabulary.nearest("quantum flapdoodle", 2)[0], "a person walks forward", "the most frequent one");
        assert_eq!(Vocabulary::of([]).nearest("a jump", 3), [""; 0]);
    }
}
