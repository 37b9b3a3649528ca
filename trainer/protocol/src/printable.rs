//! Untrusted texts for a terminal.
//!
//! A caption, a path or a stage's message may hold escape sequences, which a terminal executes. They clear the screen,
//! change its title, or answer as if the user had typed. Printed text passes [`printable`] at the place where it is
//! printed.

use std::borrow::Cow;
use std::fmt::Write as _;

/// Escapes control characters and marks that change the reading direction as `\u001b`, which is also valid JSON. Line
/// ends and tabs stay.
pub fn printable(text: &str) -> Cow<'_, str> {
    let is_hidden = |c: char| {
        (c.is_control() && !matches!(c, '\n' | '\t'))
            || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    if !text.contains(is_hidden) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_hidden(c) {
            write!(shown, "\\u{:04x}", u32::from(c)).expect("a string takes all that is written");
        } else {
            shown.push(c);
        }
    }
    Cow::Owned(shown)
}

/// Largest number of characters of a text in an error.
const SHOWN: usize = 120;

/// Start of an untrusted text, for an error.
pub fn excerpt(text: &str) -> String {
    let begins: String = text.chars().take(SHOWN).collect();
    let more = if begins.len() < text.len() { "..." } else { "" };
    format!("{}{more}", begins.escape_debug())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_shows_the_beginning_of_a_text() {
        assert_eq!(excerpt("a\u{1b}b"), "a\\u{1b}b");
        assert_eq!(excerpt(&"\u{e9}".repeat(121)), format!("{}...", "\u{e9}".repeat(120)));
    }

    #[test]
    fn no_escape_sequence_is_left() {
        let text = "a\u{1b}[2Jb\u{9b}31m\rc\u{7f}\u{202e}d\te\nf \u{e9}";
        assert_eq!(printable(text), "a\\u001b[2Jb\\u009b31m\\u000dc\\u007f\\u202ed\te\nf \u{e9}");
        assert!(matches!(printable("plain \u{e9}\n"), Cow::Borrowed(_)));
        let json = serde_json::to_string(text).expect("a text");
        let read: String = serde_json::from_str(&printable(&json)).expect("still JSON");
        assert_eq!(read, text);
    }
}
