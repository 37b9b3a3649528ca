//! Rules for converting a caption to the ids that a published model reads.

use serde::{Deserialize, Serialize};

use crate::repair::repaired;

/// Steps before and after the tokenizer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rules {
    /// Repairs the caption first as OpenAI's package does: mojibake, HTML, ligatures, quotes.
    pub repair: bool,
    /// Trims white space first, as sentence-transformers does.
    pub strip: bool,
    /// Converts to lower case first.
    pub lower: bool,
    /// The first id of every caption, if there is one.
    pub first: Option<u32>,
    /// The last id of every caption, cut or not.
    pub end: u32,
    /// The id that pads after the end.
    pub pad: u32,
    /// Largest number of ids of a caption, including `first` and `end`.
    pub most: usize,
}

impl Rules {
    /// Number of ids that [`first`](Self::first) and [`end`](Self::end) use.
    pub(crate) fn added(&self) -> usize {
        1 + usize::from(self.first.is_some())
    }

    /// Prepares a caption for its tokenizer.
    pub(crate) fn prepared(&self, caption: &str) -> String {
        let mut text = caption.to_owned();
        if self.repair {
            text = repaired(&text);
        }
        if self.strip {
            // Python's `strip` removes four separators that are not white space in Unicode.
            let blank = |c: char| c.is_whitespace() || ('\u{1c}'..='\u{1f}').contains(&c);
            text = text.trim_matches(blank).to_owned();
        }
        if self.lower { text.to_lowercase() } else { text }
    }
}
