//! The files of the page: all of them, small enough, unchanged where they are others' work, and free of what the content policy forbids.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use protocol::Digest;

/// Limit of all files on the wire.
const BUDGET: usize = 150 << 10;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("static")
}

fn below(folder: &Path, prefix: &str, names: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry")) {
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        match entry.path().is_dir() {
            true => below(&entry.path(), &format!("{name}/"), names),
            false => drop(names.insert(name)),
        }
    }
}

/// Our own modules and their text.
fn own() -> Vec<(String, String)> {
    let all = page::files().chain([page::index()]).filter(|file| !file.name.starts_with("vendor/"));
    all.map(|file| (file.name.to_owned(), String::from_utf8(file.bytes.clone()).expect("text"))).collect()
}

#[test]
fn every_file_is_shipped_but_licences() {
    let mut there = BTreeSet::new();
    below(&folder(), "", &mut there);
    let licences: BTreeSet<String> = there.iter().filter(|name| name.starts_with("vendor/LICENSE-")).cloned().collect();
    // Types of the libraries, for the check of ours.
    there.retain(|name| !name.ends_with(".d.ts"));
    let shipped: BTreeSet<String> = page::files().chain([page::index()]).map(|file| file.name.to_owned()).collect();
    assert_eq!(&there - &licences, shipped);
    assert_eq!(licences.len(), 2, "one for each library: {licences:?}");
}

#[test]
fn all_of_it_is_small() {
    let bytes: usize = page::files().chain([page::index()]).map(|file| file.gzip.len()).sum();
    println!("{bytes} bytes compressed");
    assert!(bytes <= BUDGET, "{bytes} bytes");
}

#[test]
fn libraries_are_as_their_authors_published_them() {
    // uPlot 1.6.32 and lit-html 3.3.3, from the npm registry.
    for (name, digest) in [
        ("vendor/uPlot.iife.min.js", "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f"),
        ("vendor/uPlot.min.css", "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04"),
        ("vendor/lit-html.js", "b878e7f95dec8a9b6e9b217faca6b6a11bad82ebc44c0caa77419ed83edd81f2"),
        ("vendor/LICENSE-uPlot", "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd"),
        ("vendor/LICENSE-lit-html", "2b66f9390afde29edfe4314daff93f01fb182e1178053e228120178987e5db75"),
    ] {
        assert_eq!(Digest::of(&std::fs::read(folder().join(name)).expect("a file")).hex(), digest, "{name}");
    }
}

#[test]
fn nothing_is_inline_evaluated_or_from_elsewhere() {
    for (name, text) in own() {
        for wrong in [
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "document.write",
            "eval(",
            "new Function",
            "javascript:",
            "unsafeHTML",
        ] {
            assert!(!text.contains(wrong), "{name} has `{wrong}`");
        }
        for (place, _) in text.match_indices("://") {
            let around = &text[text[..place].rfind(['"', '\'', '`', ' ', '<']).unwrap_or(0)..];
            let around = &around[..around.find(['\n']).unwrap_or(around.len())];
            assert!(
                around.contains("www.w3.org") || around.contains("SERVER") || around.contains("location"),
                "{name} names `{around}`"
            );
        }
        assert!(!text.contains(" style=\""), "{name} has a style of its own in markup");
        assert!(!name.ends_with(".html") || !text.contains("<script>"), "{name} has a script in it");
    }
}

#[test]
fn the_document_loads_from_the_folder_of_this_build() {
    let text = String::from_utf8(page::index().bytes.clone()).expect("text");
    let folder = page::folder();
    assert!(text.contains(&format!("/page/{folder}/main.js")) && !text.contains("FOLDER"), "{text}");
    assert!(page::find(folder, "main.js").is_some());
    assert!(
        text.contains(&format!("modulepreload\" href=\"/page/{folder}/views/run.js")) && !text.contains("PRELOADS")
    );
    assert!(page::find("0123456789abcdef", "main.js").is_none(), "another build's");
    assert!(page::find(folder, "index.html").is_none() && page::find(folder, "../Cargo.toml").is_none());
}
