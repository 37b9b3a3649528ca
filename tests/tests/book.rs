//! README stays short, the book is whole, and links lead somewhere.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use cluster_tests::{book, documented};

/// Words and lines that README may have.
const README: (usize, usize) = (900, 120);
/// Words of a paragraph.
const PARAGRAPH: usize = 90;
/// Words of a sentence: the largest mean, and the largest number.
const SENTENCE: (f64, usize) = (18.0, 30);
/// Characters of a line of a table.
const TABLE_LINE: usize = 200;

fn root() -> PathBuf {
    book::plain(&Path::new(env!("CARGO_MANIFEST_DIR")).join(".."))
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn files_below(folder: &Path, found: &mut BTreeSet<PathBuf>) {
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() && !path.is_symlink() {
            files_below(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            found.insert(path);
        }
    }
}

#[test]
fn the_readme_is_one_page() {
    let text = read(&root().join("README.md"));
    let (words, lines) = (text.split_whitespace().count(), text.lines().count());
    assert!(words <= README.0 && lines <= README.1, "{words} words on {lines} lines; more belongs into the book");
}

#[test]
fn every_chapter_is_in_the_summary() {
    let root = root();
    let listed: Vec<PathBuf> =
        book::chapters(&root).into_iter().map(|chapter| book::source(&root).join(chapter.path)).collect();
    let unique: BTreeSet<PathBuf> = listed.iter().cloned().collect();
    assert_eq!(unique.len(), listed.len(), "a chapter is listed twice");
    let mut there = BTreeSet::new();
    files_below(&book::source(&root), &mut there);
    there.remove(&book::source(&root).join("SUMMARY.md"));
    assert!(there.len() > 20, "{there:?}");
    assert_eq!(there, unique, "files of docs/book/src, and chapters in its SUMMARY.md");
    let decisions = read(&book::source(&root).join("decisions.md"));
    let mut all = BTreeSet::new();
    files_below(&root.join("docs/decisions"), &mut all);
    let shown: BTreeSet<PathBuf> =
        decisions.lines().filter_map(book::included).map(|file| book::plain(&book::source(&root).join(file))).collect();
    assert_eq!(shown, all, "files of docs/decisions, and those that the chapter includes");
}

/// Checks the links of a document. Links of a chapter stay inside the book, so that they work in its pages too.
fn broken_links(path: &Path, inside: Option<&Path>) -> Vec<String> {
    let text = if inside.is_some() { book::expanded(path) } else { read(path) };
    let mut broken = Vec::new();
    for (line, target) in book::links(&text) {
        if target.contains("://") || target.contains("{{") {
            continue;
        }
        let (file, anchor) = target.split_once('#').unwrap_or((&target, ""));
        let to = if file.is_empty() { path.to_owned() } else { book::plain(&path.with_file_name("").join(file)) };
        let mut wrong = |why: &str| broken.push(format!("{}:{line}: {target}: {why}", path.display()));
        if !to.exists() {
            wrong("there is no such file");
        } else if inside.is_some_and(|folder| !to.starts_with(folder)) {
            wrong("a link of a chapter leaves the book");
        } else if !anchor.is_empty() && !book::anchors(&book::expanded(&to)).iter().any(|one| one == anchor) {
            wrong("there is no such heading");
        }
    }
    broken
}

#[test]
fn every_link_of_the_documents_leads_somewhere() {
    let root = root();
    let source = book::source(&root);
    let mut broken = Vec::new();
    for document in documented::all(&root) {
        broken.extend(broken_links(&document, document.starts_with(&source).then_some(source.as_path())));
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));

    let folder = tempfile::tempdir().expect("a folder");
    let document = folder.path().join("a.md");
    fs::write(&document, "# One\n[a](#one) [b](#two) [c](c.md) [d](https://example.org)\n").expect("written");
    assert_eq!(broken_links(&document, None).len(), 2, "a missing heading and a missing file are found");
}

#[test]
fn paths_that_the_book_names_exist() {
    let root = root();
    let mut missing = Vec::new();
    for document in documented::documents(&root).into_iter().filter(|document| !document.ends_with("CONTRIBUTING.md")) {
        for (line, text) in book::prose(&read(&document)) {
            let code = text.split('`').skip(1).step_by(2);
            let is_path = |word: &&str| {
                ["configs/", "docs/", "ops/", "tests/"].iter().any(|folder| word.starts_with(folder))
                    && word.chars().all(|c| c.is_ascii_alphanumeric() || "/._-@".contains(c))
            };
            let gone = code.filter(is_path).filter(|path| !root.join(path).exists());
            missing.extend(gone.map(|path| format!("{}:{line}: {path}", document.display())));
        }
    }
    assert!(missing.is_empty(), "{}", missing.join("\n"));
}

#[test]
fn paragraphs_and_tables_can_be_read() {
    let root = root();
    let mut files: BTreeSet<PathBuf> = BTreeSet::from([root.join("README.md"), root.join("ops/README.md")]);
    files_below(&book::source(&root), &mut files);
    files_below(&root.join("docs/results"), &mut files);
    let mut long = Vec::new();
    for path in files.iter().filter(|path| !path.to_string_lossy().ends_with(".in.md")) {
        let text = read(path);
        for (line, paragraph) in book::paragraphs(&text) {
            let words = paragraph.split_whitespace().count();
            if words > PARAGRAPH {
                long.push(format!("{}:{line}: a paragraph of {words} words", path.display()));
            }
        }
        for (line, row) in book::prose(&text).filter(|(_, row)| row.starts_with('|')) {
            let characters = row.chars().count();
            if characters > TABLE_LINE {
                long.push(format!("{}:{line}: a line of a table of {characters} characters", path.display()));
            }
        }
    }
    assert!(long.is_empty(), "{}", long.join("\n"));
}

/// Words of each sentence of README and of the book, with its place. Code counts as one word.
fn sentence_lengths(path: &Path) -> Vec<(String, usize)> {
    let mut lengths = Vec::new();
    for (line, paragraph) in book::paragraphs(&book::expanded(path)) {
        let code = paragraph.split('`').enumerate();
        let plain: String = code.map(|(i, part)| if i % 2 == 0 { part } else { "X" }).collect();
        let mut words = 0;
        for word in plain.split_whitespace() {
            words += 1;
            if word.trim_end_matches([')', '*', '"', ']']).ends_with(['.', '!', '?', ':']) {
                lengths.push((format!("{}:{line}", path.display()), words));
                words = 0;
            }
        }
        if words > 0 {
            lengths.push((format!("{}:{line}", path.display()), words));
        }
    }
    lengths
}

#[test]
fn sentences_of_the_readme_and_the_book_are_short() {
    let root = root();
    let mut files: BTreeSet<PathBuf> = BTreeSet::from([root.join("README.md")]);
    files_below(&book::source(&root), &mut files);
    // Decisions and the threat model are documents for developers, which the book includes.
    files.retain(|path| !path.ends_with("decisions.md") && !path.ends_with("threat-model.md"));
    let all: Vec<(String, usize)> = files.iter().flat_map(|path| sentence_lengths(path)).collect();
    assert!(all.len() > 700, "{} sentences", all.len());
    let long: Vec<&(String, usize)> = all.iter().filter(|(_, words)| *words > SENTENCE.1).collect();
    assert!(long.is_empty(), "sentences of over {} words: {long:#?}", SENTENCE.1);
    #[expect(clippy::cast_precision_loss, reason = "counts of words")]
    let mean = all.iter().map(|(_, words)| *words).sum::<usize>() as f64 / all.len() as f64;
    assert!(mean <= SENTENCE.0, "{mean:.1} words a sentence");

    let folder = tempfile::tempdir().expect("a folder");
    let document = folder.path().join("a.md");
    fs::write(&document, "# A title\n\nOne `a b c` two. Three:\n\n- four five\n\n| six |\n").expect("written");
    let lengths: Vec<usize> = sentence_lengths(&document).into_iter().map(|(_, words)| words).collect();
    assert_eq!(lengths, [3, 1, 3], "code is a word, and an item has its mark");
}

#[test]
fn the_list_for_language_models_has_every_chapter() {
    let root = root();
    let (path, wanted) = (root.join("llms.txt"), book::llms(&root));
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&path, &wanted).expect("llms.txt is written");
    }
    let found = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(found, wanted, "write it with `UPDATE_DOCS=1 cargo test -p cluster-tests --test book`");
}

/// The troubleshooting page lists the exit codes of `--help`, with their meanings.
#[test]
fn the_book_explains_every_exit_code() {
    let root = root();
    let page = read(&book::source(&root).join("troubleshooting.md"));
    let source = read(&root.join("trainer/src/report/problem.rs"));
    let (_, help) = source.split_once("Exit codes:\n").expect("the help of exit codes");
    let (help, _) = help.split_once('"').expect("its end");
    let mut codes = 0;
    for line in help.lines().map(|line| line.trim().trim_end_matches('\\')) {
        let (code, meaning) = line.split_once("  ").expect("a code and its meaning");
        let meaning = meaning.split(';').next().unwrap_or(meaning);
        assert!(
            page.contains(&format!("| {code} | {meaning}")),
            "troubleshooting.md lacks exit code {code}: {meaning}"
        );
        codes += 1;
    }
    assert!(codes >= 10, "{codes} codes");
}
