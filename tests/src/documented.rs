//! The command lines that the documents show, so that tests can run or at least parse them as they stand.

use std::fs;
use std::path::Path;

/// The documents with commands for users.
pub const DOCUMENTS: [&str; 3] = ["README.md", "ops/README.md", "CONTRIBUTING.md"];

/// The lines of shell blocks of a document; only of the block after the marker, if one is given. Without comments.
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

/// A command line's words as a shell makes them of quoted and plain text; nothing is expanded.
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

/// All command lines of `program` in the documents of the repository at `root`, each as its words without what the shell reads (`< FILE`).
pub fn commands(root: &Path, program: &str) -> Vec<Vec<String>> {
    let lines = DOCUMENTS.iter().flat_map(|document| shell_lines(&root.join(document), None));
    let through_cargo = format!("cargo run --release --bin {program} -- ");
    let lines = lines.map(|line| match line.strip_prefix(&through_cargo) {
        Some(rest) => format!("{program} {rest}"),
        None => line,
    });
    let own = |line: String| words(&line).into_iter().take_while(|word| word != "<").collect::<Vec<_>>();
    lines.map(own).filter(|words| words.first().is_some_and(|first| first == program)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_those_of_a_shell() {
        assert_eq!(words("a --to 'b <= 1'  \"c d\"'e' ''"), ["a", "--to", "b <= 1", "c de", ""]);
    }
}
