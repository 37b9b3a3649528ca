//! Extracts the command lines in the documents, so that tests can run or at least parse them unchanged.

use std::fs;
use std::path::{Path, PathBuf};

/// The documents with commands for users: three at fixed places, and the chapters of the book.
///
/// # Panics
/// If the book cannot be read.
pub fn documents(root: &Path) -> Vec<PathBuf> {
    let fixed = ["README.md", "ops/README.md", "CONTRIBUTING.md"].map(|name| root.join(name));
    let chapters = crate::book::chapters(root).into_iter().map(|chapter| crate::book::source(root).join(chapter.path));
    fixed.into_iter().chain(chapters).collect()
}

/// The command lines that the test in `file` runs: of the block behind `<!-- run by FILE -->` in one of the documents.
///
/// # Panics
/// If no document has the marker, or several have it.
pub fn run_by(root: &Path, file: &str) -> Vec<String> {
    let marker = format!("<!-- run by {file} -->");
    let has = |path: &PathBuf| fs::read_to_string(path).is_ok_and(|text| text.contains(&marker));
    let found: Vec<PathBuf> = documents(root).into_iter().filter(has).collect();
    let [document] = &found[..] else { panic!("`{marker}` is expected in one document: {found:?}") };
    shell_lines(document, Some(&marker))
}

/// The lines of a document's shell blocks, without comments. With a marker, only those of the block after it.
pub fn shell_lines(document: &Path, after: Option<&str>) -> Vec<String> {
    let text = fs::read_to_string(document).unwrap_or_else(|e| panic!("{}: {e}", document.display()));
    let text = match after {
        None => text.as_str(),
        Some(marker) => {
            let at = text.find(marker).unwrap_or_else(|| panic!("no `{marker}` in {}", document.display()));
            let rest = &text[at..];
            let begin = rest.find("```sh\n").expect("a block after the marker");
            let length = rest[begin + 3..].find("```\n").expect("the block ends") + 6;
            &rest[begin..begin + length]
        }
    };
    let mut lines = Vec::new();
    let mut inside = false;
    for line in text.lines() {
        if line.starts_with("```") {
            inside = !inside && line == "```sh";
        } else if inside {
            let line = line.split_once(" #").map_or(line, |(command, _)| command).trim();
            if !line.is_empty() && !line.starts_with('#') {
                lines.push(line.to_owned());
            }
        }
    }
    lines
}

/// The pipelines in a document, each with the line of its start. A block behind the marker
/// `<!-- a stage of the pipeline above -->` replaces the stage of its name in the complete pipeline above it.
///
/// # Panics
/// If a marked block has no such stage above it.
pub fn pipelines(document: &Path) -> Vec<(usize, String)> {
    const STAGE: &str = "<!-- a stage of the pipeline above -->";
    let text = fs::read_to_string(document).unwrap_or_else(|e| panic!("{}: {e}", document.display()));
    let lines: Vec<&str> = text.lines().collect();
    let mut found: Vec<(usize, String)> = Vec::new();
    for (begin, _) in lines.iter().enumerate().filter(|(_, line)| line.trim_start().starts_with("```yaml")) {
        let block: Vec<&str> = lines[begin + 1..].iter().copied().take_while(|line| !line.starts_with("```")).collect();
        let whole = if begin > 0 && lines[begin - 1] == STAGE {
            let place = format!("{}:{}", document.display(), begin + 1);
            let name = block.first().and_then(|line| line.split_inclusive(':').next()).expect("a stage's name");
            let above = found.last().unwrap_or_else(|| panic!("{place}: no pipeline above"));
            let replaced =
                above.1.lines().flat_map(|line| if line.starts_with(name) { block.clone() } else { vec![line] });
            let whole: String = replaced.map(|line| format!("{line}\n")).collect();
            assert_ne!(whole, above.1, "{place}: the pipeline above has no stage `{}`", name.trim());
            whole
        } else {
            block.iter().map(|line| format!("{line}\n")).collect()
        };
        found.push((begin + 1, whole));
    }
    found
}

/// All files of the repository at `root` that end in `.md`, without build output.
pub fn all(root: &Path) -> Vec<PathBuf> {
    let mut folders = vec![root.to_owned()];
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        let entries = fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
        for path in entries.map(|entry| entry.expect("an entry").path()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() && !path.is_symlink() && !name.starts_with('.') && name != "target" && name != "shared" {
                folders.push(path);
            } else if name.ends_with(".md") {
                files.push(path);
            }
        }
    }
    files.sort();
    files
}

/// Splits a command line into words as a shell does for quoted and plain text; nothing is expanded.
pub fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    for c in line.chars() {
        match (quote, c) {
            (Some(q), c) if c == q => quote = None,
            (Some(_), c) => word.get_or_insert_default().push(c),
            (None, '\'' | '"') => {
                quote = Some(c);
                word.get_or_insert_default();
            }
            (None, c) if c.is_whitespace() => words.extend(word.take()),
            (None, c) => word.get_or_insert_default().push(c),
        }
    }
    words.extend(word);
    words
}

/// All command lines of `program` in the documents of the repository at `root`, as words without redirections
/// (`< FILE`, `> FILE`).
pub fn commands(root: &Path, program: &str) -> Vec<Vec<String>> {
    let lines = documents(root).into_iter().flat_map(|document| shell_lines(&document, None));
    let through_cargo = format!("cargo run --release --bin {program} -- ");
    let lines = lines.map(|line| match line.strip_prefix(&through_cargo) {
        Some(rest) => format!("{program} {rest}"),
        None => line,
    });
    let own = |line: String| words(&line).into_iter().take_while(|word| word != "<" && word != ">").collect::<Vec<_>>();
    lines.map(own).filter(|words| words.first().is_some_and(|first| first == program)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_marked_block_takes_its_stage_s_place() {
        let folder = tempfile::tempdir().expect("a folder");
        let document = folder.path().join("a.md");
        let text = "```yaml\nname: p\nstages:\n  a: {kind: x}\n  b: {kind: y}\n```\n\n<!-- a stage of the pipeline above -->\n```yaml\n  a:\n    kind: z\n```\n";
        fs::write(&document, text).expect("written");
        let whole = "name: p\nstages:\n  a: {kind: x}\n  b: {kind: y}\n".to_owned();
        let changed = "name: p\nstages:\n  a:\n    kind: z\n  b: {kind: y}\n".to_owned();
        assert_eq!(pipelines(&document), [(1, whole), (9, changed)]);
    }

    #[test]
    fn words_are_those_of_a_shell() {
        assert_eq!(words("a --to 'b <= 1'  \"c d\"'e' ''"), ["a", "--to", "b <= 1", "c de", ""]);
    }
}
