//! Untrusted texts for a terminal.
//!
//! A caption, a path or a stage's message may contain escape sequences. A terminal obeys them: they clear its text,
//! change its title, or answer as if the user had typed. Every print of such text calls [`printable`].
//!
//! Errors quote files only through [`excerpt`] and [`json_mistake`]. These show nothing of a file before the process
//! calls [`show_excerpts`], because a worker reads files that the readers of its messages may not read.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::sync::atomic::{AtomicBool, Ordering};

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

/// Stands for text of a file that is not shown.
const HIDDEN: &str = "...";

static SHOWS_EXCERPTS: AtomicBool = AtomicBool::new(false);

/// Lets errors of this process quote the files that they are about. Only for a command whose user reads both: never for a worker of a server.
pub fn show_excerpts() {
    SHOWS_EXCERPTS.store(true, Ordering::Relaxed);
}

/// Returns the beginning of a file's text for an error message, or `...` if this process may not quote files.
pub fn excerpt(text: &str) -> String {
    if SHOWS_EXCERPTS.load(Ordering::Relaxed) { beginning(text) } else { HIDDEN.to_owned() }
}

/// Returns at most `most` names from a file for an error message, or `...` if this process may not quote files.
pub fn excerpts<'a>(names: impl IntoIterator<Item = &'a str>, most: usize) -> String {
    if !SHOWS_EXCERPTS.load(Ordering::Relaxed) {
        return HIDDEN.to_owned();
    }
    names.into_iter().take(most).map(beginning).collect::<Vec<_>>().join(", ")
}

/// The kind and place of a mistake in JSON. The reader's own message may quote the text, and so is an excerpt.
pub fn json_mistake(error: &serde_json::Error) -> String {
    let what = match error.classify() {
        serde_json::error::Category::Syntax => "invalid JSON",
        serde_json::error::Category::Eof => "incomplete JSON",
        serde_json::error::Category::Data | serde_json::error::Category::Io => "unexpected JSON",
    };
    let text = error.to_string();
    // Such a name is one of ours.
    if let Some(rest) = text.strip_prefix("missing field `")
        && let Some((name, _)) = rest.split_once('`')
    {
        return format!("JSON without the key `{name}`");
    }
    let said = if SHOWS_EXCERPTS.load(Ordering::Relaxed) { format!(" ({text})") } else { String::new() };
    match error.line() {
        0 => format!("{what}{said}"),
        line => format!("{what} at line {line} column {}{said}", error.column()),
    }
}

/// The first 120 characters of a text, escaped. Only for texts that are no part of a file.
pub fn beginning(text: &str) -> String {
    let begins: String = text.chars().take(SHOWN).collect();
    let more = if begins.len() < text.len() { "..." } else { "" };
    format!("{}{more}", begins.escape_debug())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_shows_the_beginning_of_a_text_if_the_process_asked_for_it() {
        let error = serde_json::from_str::<Vec<u8>>("\n[\"secret\"]").unwrap_err();
        assert_eq!((excerpt("secret"), excerpts(["secret"], 2)), ("...".to_owned(), "...".to_owned()));
        assert_eq!(json_mistake(&error), "unexpected JSON at line 2 column 9");
        show_excerpts();
        assert!(json_mistake(&error).contains("secret"));
        assert_eq!(excerpts(["a", "b", "c"], 2), "a, b");
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
