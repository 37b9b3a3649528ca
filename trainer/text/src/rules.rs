//! How a caption becomes the ids that a published model reads.

use serde::{Deserialize, Serialize};

use crate::repair::repaired;

/// What is done to a caption before and after its tokenizer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rules {
    /// Repaired first, as OpenAI's package does: mojibake, HTML, ligatures, quotes.
    pub repair: bool,
    /// Without white space around it, as sentence-transformers does.
    pub strip: bool,
    /// In lower case first.
    pub lower: bool,
    /// The id that every caption begins with.
    pub first: Option<u32>,
    /// The id that every caption ends with, cut or not.
    pub end: u32,
    /// What pads behind the end.
    pub pad: u32,
    /// Ids of a caption at most, `first` and `end` among them.
    pub most: usize,
}

impl Rules {
    /// Ids that [`first`](Self::first) and [`end`](Self::end) take.
    pub(crate) fn added(&self) -> usize {
        1 + usize::from(self.first.is_some())
    }

    /// A caption as its tokenizer gets it.
    pub(crate) fn prepared(&self, caption: &str) -> String {
        let mut text = caption.to_owned();
        if self.repair {
            text = repaired(&text);
        }
        if self.strip {
            // What Python strips, which counts four separators more than Unicode.
            let blank = |c: char| c.is_whitespace() || ('\u{1c}'..='\u{1f}').contains(&c);
            text = text.trim_matches(blank).to_owned();
        }
        if self.lower { text.to_lowercase() } else { text }
    }
}
