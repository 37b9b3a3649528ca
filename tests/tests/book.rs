//! README stays short, the book is whole, and links lead somewhere.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use cluster_tests::{book, documented};

/// Words and lines that README may have.
const README: (usize, usize) = (900, 120);
/// Words of a paragraph.
const PARAGRAPH: usize = 90;
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
    for path in files.iter().filter(|path| !path.ends_with("mini.in.md")) {
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
