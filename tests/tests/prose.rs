//! Habits of language that make comments and documents hard to read stay rare, in all text and in what is new.
//!
//! A limit is a share of all sentences. New text is what the last commits and uncommitted changes added.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

/// Commits whose added lines count as new.
const COMMITS: usize = 20;
/// Hits that a text of any length may have, so that one quotation does not fail a small change.
const ALLOWED: usize = 2;

const OPENINGS: [&str; 7] = ["What", "Who", "Whose", "Whom", "Whether", "Where", "How"];
const PRONOUNS: [&str; 7] = ["nobody", "somebody", "anybody", "everybody", "whoever", "whatever", "whichever"];
const CHAINS: [&str; 9] = [
    "that of which",
    "of which",
    "that which",
    "those that",
    "those which",
    "for what",
    "in what",
    "of what",
    "from what",
];
const LITERARY: [&str; 14] = [
    "knows nothing",
    "gives back",
    "goes on",
    "gone on",
    "went on",
    "is told",
    "was told",
    "says no",
    "heeds",
    "heeded",
    "stands for",
    "stands in",
    "is asked for",
    "lay down",
];

/// A habit: its name, the largest share of sentences in percent, and its test.
struct Habit {
    name: &'static str,
    percent: f64,
    has: fn(&Sentence) -> bool,
}

const HABITS: [Habit; 6] = [
    Habit {
        name: "begins with What, Who, Whether, Where or How",
        percent: 1.5,
        has: |s| !s.text.ends_with('?') && OPENINGS.contains(&s.words().next().unwrap_or_default()),
    },
    Habit { name: "one or two words as a whole comment", percent: 2.0, has: |s| s.alone && s.words().count() <= 2 },
    Habit { name: "over 30 words", percent: 1.0, has: |s| s.text.split_whitespace().count() > 30 },
    Habit { name: "nobody, somebody, whoever and the like", percent: 0.3, has: |s| s.contains(&PRONOUNS) },
    Habit { name: "of which, of what and the like", percent: 0.3, has: |s| s.contains(&CHAINS) },
    Habit { name: "a literary verb", percent: 0.3, has: |s| s.contains(&LITERARY) },
];

/// A sentence of a comment or document, with code replaced by `X`.
struct Sentence {
    at: String,
    text: String,
    /// True for a Rust comment of one sentence.
    alone: bool,
}

impl Sentence {
    fn words(&self) -> impl Iterator<Item = &str> {
        self.text.split(|c: char| !c.is_alphanumeric() && c != '\'' && c != '-').filter(|word| !word.is_empty())
    }

    fn contains(&self, phrases: &[&str]) -> bool {
        let words = format!(" {} ", self.words().collect::<Vec<_>>().join(" ").to_lowercase());
        phrases.iter().any(|phrase| words.contains(&format!(" {phrase} ")))
    }
}

fn git(root: &Path, arguments: &[&str]) -> Option<String> {
    let said = Command::new("git").arg("-C").arg(root).args(arguments).output().expect("git runs");
    said.status.success().then(|| String::from_utf8_lossy(&said.stdout).into_owned())
}

/// Text of a line if it is of a comment or document, by the file's kind.
fn text_of<'a>(path: &str, line: &'a str) -> Option<&'a str> {
    let line = line.trim_start();
    let text = if path.ends_with(".rs") {
        line.strip_prefix("//")?.trim_start_matches(['/', '!'])
    } else if path.ends_with(".md") {
        (!line.starts_with(['|', '#', '<', '`'])).then_some(line)?.trim_start_matches([' ', '-', '*', '>'])
    } else {
        line.strip_prefix('#')?
    };
    let text = text.trim();
    (!text.is_empty()).then_some(text)
}

/// Replaces the code of a paragraph by `X`.
fn without_code(text: &str) -> String {
    let parts = text.split('`').enumerate();
    parts.map(|(i, part)| if i % 2 == 0 { part } else { "X" }).collect()
}

/// Sentences of a file, by the line on which their paragraph begins.
fn sentences(path: &str, content: &str) -> Vec<(usize, Sentence)> {
    let mut paragraphs: Vec<(usize, String)> = Vec::new();
    let (mut inside, mut in_code) = (false, false);
    for (number, line) in content.lines().enumerate() {
        if path.ends_with(".md") && line.trim_start().starts_with("```") {
            in_code = !in_code;
        }
        let text = text_of(path, line).filter(|_| !in_code);
        if let Some(text) = text {
            match paragraphs.last_mut().filter(|_| inside) {
                Some((_, paragraph)) => *paragraph = format!("{paragraph} {text}"),
                None => paragraphs.push((number + 1, text.to_owned())),
            }
        }
        inside = text.is_some();
    }
    let mut all = Vec::new();
    for (line, paragraph) in paragraphs {
        let paragraph = without_code(&paragraph);
        let mut texts: Vec<String> = Vec::new();
        for word in paragraph.split_whitespace() {
            match texts.last_mut().filter(|text| !text.ends_with(['.', '!', '?'])) {
                Some(text) => *text = format!("{text} {word}"),
                None => texts.push(word.to_owned()),
            }
        }
        let alone = texts.len() == 1 && path.ends_with(".rs");
        let at = format!("{path}:{line}");
        all.extend(texts.into_iter().map(|text| (line, Sentence { at: at.clone(), text, alone })));
    }
    all
}

/// Lines that `git diff` against `base` adds, by file.
fn added(root: &Path, base: &str) -> BTreeMap<String, BTreeSet<usize>> {
    let diff = git(root, &["diff", "--unified=0", base]).expect("git compares");
    let mut lines: BTreeMap<String, BTreeSet<usize>> = BTreeMap::new();
    let mut path = "";
    for line in diff.lines() {
        if let Some(name) = line.strip_prefix("+++ b/") {
            path = name;
        } else if let Some(place) = line.strip_prefix("@@ ").and_then(|place| place.split_once('+')) {
            let place = place.1.split(' ').next().unwrap_or_default();
            let (first, count) = place.split_once(',').unwrap_or((place, "1"));
            let (first, count): (usize, usize) = (first.parse().expect("a line"), count.parse().expect("a count"));
            lines.entry(path.to_owned()).or_default().extend(first..first + count);
        }
    }
    lines
}

fn report(what: &str, sentences: &[&Sentence], allowed: usize) -> Vec<String> {
    let mut broken = Vec::new();
    for habit in &HABITS {
        let found: Vec<&&Sentence> = sentences.iter().filter(|sentence| (habit.has)(sentence)).collect();
        #[expect(clippy::cast_precision_loss, reason = "counts of sentences")]
        let share = 100.0 * found.len() as f64 / sentences.len().max(1) as f64;
        if found.len() > allowed && share > habit.percent {
            let shown: Vec<String> = found.iter().take(20).map(|one| format!("\n  {}: {}", one.at, one.text)).collect();
            let most = habit.percent;
            broken.push(format!(
                "{what}: {}: {share:.1} % of the sentences, at most {most} %{}",
                habit.name,
                shown.concat()
            ));
        }
    }
    broken
}

#[test]
fn habits_that_make_text_hard_to_read_stay_rare() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let Some(files) = git(&root, &["ls-files", "*.rs", "*.md", "*.yaml"]) else {
        assert!(std::env::var_os("CI").is_none(), "no git checkout");
        return;
    };
    let mut all: Vec<(String, usize, Sentence)> = Vec::new();
    for path in files.lines() {
        // A deleted file is listed until the deletion is committed.
        let Ok(content) = std::fs::read_to_string(root.join(path)) else { continue };
        all.extend(sentences(path, &content).into_iter().map(|(line, sentence)| (path.to_owned(), line, sentence)));
    }
    assert!(all.len() > 10_000, "{} sentences", all.len());
    let everything: Vec<&Sentence> = all.iter().map(|(_, _, sentence)| sentence).collect();
    let mut broken = report("all text", &everything, ALLOWED);
    // A shallow clone has fewer commits, and then nothing is new.
    let log = git(&root, &["log", "--first-parent", "--format=%H", &format!("-{}", COMMITS + 1)]).unwrap_or_default();
    if let Some(base) = log.lines().nth(COMMITS) {
        let lines = added(&root, base);
        let is_new = |path: &str, line: &usize| lines.get(path).is_some_and(|lines| lines.contains(line));
        let new: Vec<&Sentence> =
            all.iter().filter(|(path, line, _)| is_new(path, line)).map(|(_, _, sentence)| sentence).collect();
        broken.extend(report(&format!("added by the last {COMMITS} commits"), &new, ALLOWED));
    }
    assert!(broken.is_empty(), "{}", broken.join("\n\n"));
}

#[test]
fn sentences_are_cut_and_judged() {
    let text = "/// Whether it works.\n/// It uses `what is this`. Nobody knows.\nfn f() {}\n// Two words\n";
    let found: Vec<Sentence> = sentences("a.rs", text).into_iter().map(|(_, sentence)| sentence).collect();
    let texts: Vec<&str> = found.iter().map(|sentence| sentence.text.as_str()).collect();
    assert_eq!(texts, ["Whether it works.", "It uses X.", "Nobody knows.", "Two words"]);
    let hits = |text: usize| HABITS.iter().map(|habit| (habit.has)(&found[text])).collect::<Vec<_>>();
    assert_eq!(hits(0), [true, false, false, false, false, false]);
    assert_eq!(hits(1), [false; 6]);
    assert_eq!(hits(2), [false, false, false, true, false, false]);
    assert_eq!(hits(3), [false, true, false, false, false, false]);
}
