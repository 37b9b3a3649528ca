//! Mistakes in a pipeline file, and their display: place, mistake, remedy, and the line with a caret.

use std::fmt;

/// Position of a value: a line and a column of the file, or of a `--set` override.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Position {
    /// Number of the source: 0 is the file, `i + 1` the i-th override.
    pub(super) source: usize,
    pub(super) line: usize,
    pub(super) column: usize,
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
pub(super) fn window(text: &str, column: usize) -> (String, usize) {
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
    let (before, after) = (if from > 0 { "..." } else { "" }, if to < characters.len() { "..." } else { "" });
    let shown: String = characters[from..to].iter().collect();
    (format!("{before}{shown}{after}"), column - from + before.len())
}

/// Mistakes of a file, ordered by place, at most [`limits::MISTAKES`](crate::limits::MISTAKES). Never empty as an
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

/// Finds the candidate that `text` probably means: at most a third of its letters differ.
pub(super) fn nearest<'a>(text: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let text = text.to_lowercase();
    // Names of other programs for it.
    let text = match text.as_str() {
        "learning_rate" => "lr".to_owned(),
        "iterations" | "epochs" | "max_steps" => "steps".to_owned(),
        "batch_size" => "batch".to_owned(),
        "d_model" | "hidden_size" => "width".to_owned(),
        _ => text,
    };
    let limit = (text.chars().count().max(3) / 3).clamp(1, 4);
    let distance = |candidate: &str| {
        let candidate = candidate.to_lowercase();
        // `steps_total` for `steps`, or `learning_rate` for `rate`: sharing a whole word counts as similar.
        if text.split(['_', '-', '.']).any(|word| word == candidate) {
            return 1;
        }
        levenshtein(&text, &candidate)
    };
    candidates
        .into_iter()
        .map(|candidate| (distance(candidate), candidate))
        .filter(|(distance, _)| *distance <= limit)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// Edit distance in characters; swapping neighbours counts as one edit.
fn levenshtein(a: &str, b: &str) -> usize {
    let a: Vec<char> = a.chars().take(64).collect();
    let b: Vec<char> = b.chars().take(64).collect();
    let mut rows: Vec<Vec<usize>> = vec![(0..=b.len()).collect()];
    for i in 1..=a.len() {
        let mut row = vec![i; b.len() + 1];
        for j in 1..=b.len() {
            let change = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            row[j] = change.min(rows[i - 1][j] + 1).min(row[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                row[j] = row[j].min(rows[i - 2][j - 2] + 1);
            }
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_key_is_the_one_that_was_meant() {
        let keys = ["steps", "batch", "lr", "warmup", "network"];
        assert_eq!(nearest("warmpu", keys), Some("warmup"));
        assert_eq!(nearest("step", keys), Some("steps"));
        assert_eq!(nearest("LR", keys), Some("lr"));
        assert_eq!(nearest("zebra", keys), None);
    }

    #[test]
    fn a_long_line_is_cut_around_its_caret() {
        let (shown, caret) = window(&"x".repeat(400), 200);
        assert!(shown.starts_with("...") && shown.ends_with("...") && shown.len() == 116);
        assert_eq!(caret, 63);
    }
}
