//! The book that a server shows: every chapter, small enough, with links that lead somewhere and nothing that its policy forbids.

use std::collections::BTreeSet;

/// Limit of all files on the wire: 0.3 MB of text, and the pictures.
const BUDGET: usize = 1_200_000;

/// The values of an attribute in a document.
fn values<'a>(text: &'a str, attribute: &str) -> Vec<&'a str> {
    let begin = format!(" {attribute}=\"");
    text.split(begin.as_str()).skip(1).filter_map(|rest| rest.split('"').next()).collect()
}

fn documents() -> Vec<(&'static str, String)> {
    let documents = book::files().filter(|file| file.name.ends_with(".html"));
    documents.map(|file| (file.name, String::from_utf8(file.bytes.clone()).expect("text"))).collect()
}

#[test]
fn every_link_leads_to_a_file_and_a_name_in_it() {
    let documents = documents();
    assert!(documents.len() > 25 && documents.iter().any(|(name, _)| *name == book::FIRST));
    let mut checked = 0;
    for (name, text) in &documents {
        let folder = name.rsplit_once('/').map_or("", |(folder, _)| folder);
        for target in values(text, "href").into_iter().chain(values(text, "src")) {
            if target.contains("://") || target == "/" {
                continue;
            }
            checked += 1;
            let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
            let path = match (file, file.strip_prefix("../")) {
                ("", _) => (*name).to_owned(),
                (_, Some(rest)) => rest.to_owned(),
                (_, None) if folder.is_empty() => file.to_owned(),
                (_, None) => format!("{folder}/{file}"),
            };
            let found = book::find(&path).unwrap_or_else(|| panic!("{name}: no file for {target}"));
            if !anchor.is_empty() {
                let text = String::from_utf8_lossy(&found.bytes);
                assert!(values(&text, "id").contains(&anchor), "{name}: {target} names nothing there");
            }
        }
    }
    assert!(checked > 900, "{checked} links");
}

#[test]
fn nothing_is_what_the_policy_forbids() {
    for (name, text) in documents() {
        for wrong in ["<script", " style=", "<style", "javascript:", " onclick", "<iframe", "<form", "{{#"] {
            assert!(!text.contains(wrong), "{name} has `{wrong}`");
        }
        let ids = values(&text, "id");
        assert_eq!(ids.iter().collect::<BTreeSet<_>>().len(), ids.len(), "{name} gives a name twice");
        assert_eq!(text.matches("aria-current=\"page\"").count(), 1, "{name} is one of the chapters");
        assert!(text.matches("<h1").count() == 1 || name == "decisions.html", "{name} has one title");
    }
    for word in ["unsafe", "*", "script-src"] {
        assert!(!book::CONTENT_POLICY.contains(word));
    }
}

#[test]
fn error_codes_have_names_that_links_reach() {
    let (_, text) = documents().into_iter().find(|(name, _)| *name == "troubleshooting.html").expect("the chapter");
    let ids: BTreeSet<&str> = values(&text, "id").into_iter().collect();
    for code in ["stale-fence", "arrived-damaged", "out-of-memory", "codes", "exit-codes"] {
        assert!(ids.contains(code), "{code}: {ids:?}");
    }
}

#[test]
fn language_models_get_every_chapter_as_text() {
    let list = book::find("llms.txt").expect("the list");
    let list = String::from_utf8(list.bytes.clone()).expect("text");
    let targets: Vec<&str> = list.split("](").skip(1).filter_map(|rest| rest.split(')').next()).collect();
    assert_eq!(targets.len(), documents().len());
    for target in targets {
        let chapter = book::find(target).unwrap_or_else(|| panic!("{target}"));
        let text = String::from_utf8_lossy(&chapter.bytes);
        assert!(text.starts_with('#') && !text.contains("{{#include"), "{target}: {text}");
        assert_eq!(chapter.kind, "text/markdown; charset=utf-8");
    }
}

#[test]
fn all_of_it_is_small() {
    let size = |ending: &str| -> usize {
        let files = book::files().filter(|file| file.name.ends_with(ending));
        files.map(|file| if file.gzip.is_empty() { file.bytes.len() } else { file.gzip.len() }).sum()
    };
    println!(
        "{} bytes on the wire: {} of HTML, {} of PNG, {} of SVG",
        size(""),
        size(".html"),
        size(".png"),
        size(".svg")
    );
    assert!(size("") <= BUDGET, "{} bytes", size(""));
}
