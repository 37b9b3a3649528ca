//! Mistakes in a pipeline file, and their display: place, mistake, remedy, and the line with a caret.

use std::fmt;

/// Position of a value: a line and a column of the file, or of a `--set` override.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Position {
    /// Number of the source: 0 is the file, `i + 1` the i-th override.
    pub(crate) source: usize,
    pub(crate) line: usize,
    pub(crate) column: usize,
}

/// A mistake with its place and its remedy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// Name of the file, or `--set stages.vae.lr=x`.
    pub source: String,
    /// Line number, from 1.
    pub line: usize,
    /// Column number in characters, from 1.
    pub column: usize,
    /// Path of the key, such as `stages.vae.batch.global`; empty for the document.
    pub path: String,
    /// Mistake and expected value, in one fragment.
    pub message: String,
    /// Remedy, if there is one.
    pub help: Option<String>,
    /// Part of the line around the column, at most 110 characters and two ellipses.
    pub excerpt: String,
    /// Column of the caret below the excerpt, from 1.
    pub caret: usize,
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { source, line, column, message, excerpt, caret, .. } = self;
        if source.starts_with("--set ") {
            write!(f, "{source}: {message}")?;
        } else {
            writeln!(f, "{source}:{line}:{column}: {message}")?;
            let number = line.to_string();
            writeln!(f, "  {number} | {excerpt}")?;
            write!(f, "  {:>width$} | {:>caret$}", "", "^", width = number.len())?;
        }
        if let Some(help) = &self.help {
            write!(f, "\n    = {help}")?;
        }
        Ok(())
    }
}

/// Part of a line around a column, at most 110 characters, and the caret's column in it.
pub(crate) fn window(text: &str, column: usize) -> (String, usize) {
    // A line may be as long as the file, which is not copied for each of its mistakes.
    let skipped = column.saturating_sub(256);
    let part = text.chars().skip(skipped).take(512).map(|c| if c.is_control() { ' ' } else { c });
    let (shown, caret) = window_of(part.collect(), column - skipped);
    if skipped > 0 && !shown.starts_with("...") { (format!("...{shown}"), caret + 3) } else { (shown, caret) }
}

fn window_of(characters: Vec<char>, column: usize) -> (String, usize) {
    let column = column.clamp(1, characters.len() + 1);
    if characters.len() <= 110 {
        return (characters.into_iter().collect(), column);
    }
    let from = column.saturating_sub(60).min(characters.len().saturating_sub(110));
    let to = (from + 110).min(characters.len());
    let before = if from > 0 { "..." } else { "" };
    let after = if to < characters.len() { "..." } else { "" };
    let shown: String = characters[from..to].iter().collect();
    (format!("{before}{shown}{after}"), column - from + before.len())
}

/// Mistakes of a file, ordered by place, at most [`limits::MISTAKES`](protocol::limits::MISTAKES). Never empty as an
/// error.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Diagnostics(pub Vec<Diagnostic>);

impl fmt::Display for Diagnostics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, diagnostic) in self.0.iter().enumerate() {
            if i > 0 {
                f.write_str("\n\n")?;
            }
            write!(f, "{diagnostic}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Diagnostics {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_line_is_cut_around_its_caret() {
        let (shown, caret) = window(&"x".repeat(400), 200);
        assert!(shown.starts_with("...") && shown.ends_with("...") && shown.len() == 116);
        assert_eq!(caret, 63);
    }
}
