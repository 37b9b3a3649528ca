//! Reads the book in `docs/book` and the Markdown of all documents: chapters, links, anchors and paragraphs.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Component, Path, PathBuf};

/// A chapter in `SUMMARY.md`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chapter {
    /// Its name in the table of contents.
    pub title: String,
    /// Its file, relative to the book's source folder.
    pub path: String,
}

/// The folder of the chapters in the repository at `root`.
pub fn source(root: &Path) -> PathBuf {
    root.join("docs/book/src")
}

/// All chapters, in the order of the book.
///
/// # Panics
/// If `SUMMARY.md` cannot be read.
pub fn chapters(root: &Path) -> Vec<Chapter> {
    let path = source(root).join("SUMMARY.md");
    let text = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let link = |line: &str| {
        let (title, path) = line.trim_start_matches([' ', '-']).strip_prefix('[')?.split_once("](")?;
        Some(Chapter { title: title.to_owned(), path: path.split_once(')')?.0.to_owned() })
    };
    text.lines().filter_map(link).collect()
}

/// The file that a line `{{#include FILE}}` names.
pub fn included(line: &str) -> Option<&str> {
    line.trim().strip_prefix("{{#include ")?.strip_suffix("}}")
}

/// The text of a document with its included files in place.
///
/// # Panics
/// If a file cannot be read.
pub fn expanded(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut whole = String::with_capacity(text.len());
    for line in text.lines() {
        match included(line) {
            Some(file) => whole.push_str(&expanded(&path.with_file_name("").join(file))),
            None => {
                whole.push_str(line);
                whole.push('\n');
            }
        }
    }
    whole
}

/// The lines of a document outside of blocks of code, numbered from one.
pub fn prose(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut inside = false;
    text.lines().enumerate().filter_map(move |(number, line)| {
        let fence = line.trim_start().starts_with("```");
        inside ^= fence;
        (!inside && !fence).then_some((number + 1, line))
    })
}

/// A line without its code in backticks.
fn without_code(line: &str) -> String {
    line.split('`').enumerate().filter(|(i, _)| i % 2 == 0).map(|(_, part)| part).collect()
}

/// The targets of all links and pictures, each with its line.
pub fn links(text: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    for (number, line) in prose(text) {
        let line = without_code(line);
        if let Some((_, target)) = line.strip_prefix('[').and_then(|rest| rest.split_once("]: ")) {
            found.push((number, target.trim().to_owned()));
        }
        let targets = line.split("](").skip(1).filter_map(|rest| rest.split_once(')'));
        found.extend(targets.map(|(target, _)| (number, target.to_owned())));
    }
    found
}

/// The names by which links reach the headings of a document.
pub fn anchors(text: &str) -> Vec<String> {
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    let headings = prose(text).filter_map(|(_, line)| {
        let title = line.trim_start_matches('#');
        (title.len() < line.len()).then(|| title.strip_prefix(' ')).flatten()
    });
    headings
        .map(|title| {
            let kept = title.trim().chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
            let name: String = kept.map(|c| if c == ' ' { '-' } else { c.to_ascii_lowercase() }).collect();
            let before = seen.entry(name.clone()).or_default();
            *before += 1;
            if *before == 1 { name } else { format!("{name}-{}", *before - 1) }
        })
        .collect()
}

/// The paragraphs and list items of a document, each with its first line, without tables, headings and comments.
pub fn paragraphs(text: &str) -> Vec<(usize, String)> {
    let mut found: Vec<(usize, String)> = Vec::new();
    let mut last = 0;
    for (number, line) in prose(text) {
        let line = line.trim_start();
        if line.is_empty() || line.starts_with(['|', '#', '<']) {
            continue;
        }
        let item = line.starts_with("- ") || line.split_once(". ").is_some_and(|(n, _)| n.parse::<u8>().is_ok());
        match found.last_mut().filter(|_| last + 1 == number && !item) {
            Some((_, paragraph)) => {
                let _ = write!(paragraph, " {line}");
            }
            None => found.push((number, line.to_owned())),
        }
        last = number;
    }
    found
}

/// A path without `.` and `..`, which need not exist.
pub fn plain(path: &Path) -> PathBuf {
    let mut whole = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => {
                whole.pop();
            }
            Component::CurDir => {}
            other => whole.push(other),
        }
    }
    whole
}

/// The list of all documents for language models, `llms.txt`.
pub fn llms(root: &Path) -> String {
    let introduction = fs::read_to_string(source(root).join("introduction.md")).unwrap_or_default();
    let about = paragraphs(&introduction).into_iter().next().map(|(_, text)| text).unwrap_or_default();
    let mut text = format!("# Stride\n\n> {about}\n\n## Chapters\n\n");
    for chapter in chapters(root) {
        // A chapter that only shows another file is that file.
        let path = format!("docs/book/src/{}", chapter.path);
        let whole = fs::read_to_string(root.join(&path)).unwrap_or_default();
        let shown = included(whole.trim()).map(|file| plain(&Path::new(&path).with_file_name("").join(file)));
        let _ = writeln!(text, "- [{}]({})", chapter.title, shown.unwrap_or_else(|| path.into()).display());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markdown_is_read() {
        let text = "# A `b.c` d\n\nOne\ntwo.\n- three\n- four\n  five\n\n```sh\n[x](no)\n```\n| [y](z.md#q) | `[u](v)` |\n\n# A bc d\n";
        assert_eq!(anchors(text), ["a-bc-d", "a-bc-d-1"]);
        assert_eq!(links(text), [(12, "z.md#q".to_owned())]);
        let found = [(3, "One two.".to_owned()), (5, "- three".to_owned()), (6, "- four five".to_owned())];
        assert_eq!(paragraphs(text), found);
        assert_eq!(plain(Path::new("a/b/../c/./d")), Path::new("a/c/d"));
        assert_eq!(included("{{#include ../a.md}}"), Some("../a.md"));
    }
}
