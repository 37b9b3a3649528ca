//! Tests of valid bundles and of every kind of invalid one.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::collections::BTreeMap;
use std::io::{self, Read, Write as _};

use checkpoint::BlobError;

use checkpoint::model::Model;
use protocol::artifact::FileEntry;
use protocol::{ArtifactKind, Digest, Manifest, ModelName};
use registry::bundle::{Head, Sink, Writer, card, read};
use registry::testing::{Entry, Whole, archive, compressed};
use registry::{Holder, Store, Version};
use serde_json::{Value, json};
use tar::{EntryType, Header};

const HEAD: &str = "bundle.json";
const CARD: &str = "card.md";

/// An exported version whose VAE has more weights than fit in one piece.
fn whole() -> Whole {
    Whole::of(vec![7; 100_000])
}

fn packed(entries: &[Entry]) -> Vec<u8> {
    compressed(&archive(entries))
}

fn version(whole: &Whole) -> Version {
    Version {
        model: whole.head.model.clone(),
        version: whole.head.version,
        artifact: whole.head.artifact,
        metrics: BTreeMap::from([
            ("fid".to_owned(), 0.25),
            ("fid.lower".to_owned(), 0.2),
            ("fid.upper".to_owned(), 0.3),
        ]),
        source: whole.head.source.clone(),
        created_ms: 0,
        aliases: Vec::new(),
    }
}

fn card_of(whole: &Whole) -> String {
    let model = Model::read(&whole.manifest).unwrap();
    let parts =
        model.parts.iter().map(|(role, digest)| (role.clone(), serde_json::from_slice(&whole.files[digest]).unwrap()));
    card(&version(whole), &whole.manifest, &model, &parts.collect())
}

fn exported(whole: &Whole) -> Vec<u8> {
    let mut writer = Writer::begin(Vec::new(), &whole.head, &whole.manifest, &card_of(whole)).unwrap();
    for (name, entry) in &whole.manifest.files {
        writer.file(name, entry.bytes).unwrap();
        for piece in whole.files[&entry.digest].chunks(1000) {
            writer.write(piece).unwrap();
        }
    }
    writer.finish().unwrap()
}

/// A sink that keeps files in memory.
#[derive(Default)]
struct Kept {
    open: Vec<u8>,
    files: BTreeMap<Digest, Vec<u8>>,
}

impl Sink for Kept {
    fn begin(&mut self, _: Digest, _: u64) -> Result<(), BlobError> {
        self.open.clear();
        Ok(())
    }

    fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        self.open.extend_from_slice(piece);
        Ok(())
    }

    fn end(&mut self, digest: Digest) -> Result<(), BlobError> {
        self.files.insert(digest, std::mem::take(&mut self.open));
        Ok(())
    }
}

fn refused(bytes: &[u8]) -> String {
    read(bytes, &mut ()).unwrap_err().to_string()
}

#[test]
fn what_is_written_is_read() {
    let whole = whole();
    let bytes = exported(&whole);
    assert_eq!(exported(&whole), bytes, "one version, one file");
    let mut kept = Kept::default();
    let found = read(&bytes[..], &mut kept).unwrap();
    assert_eq!((&found.head, &found.manifest), (&whole.head, &whole.manifest));
    let mut expected = whole.files.clone();
    expected.insert(whole.manifest.digest(), whole.manifest.to_bytes());
    assert_eq!(kept.files, expected);
    let card = found.card.unwrap();
    for part in
        ["# quick, version 3", "| `vae` | a VAE |", "encoder hashed", "263 features", "fid", "--model quick@latest"]
    {
        assert!(card.contains(part), "`{part}` is missing in\n{card}");
    }
    // A reader that returns one byte at a time, and a bundle packed by another program.
    struct Slow<'a>(&'a [u8]);
    impl Read for Slow<'_> {
        fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
            let count = out.len().min(1);
            self.0.read(&mut out[..count])
        }
    }
    assert_eq!(read(Slow(&bytes), &mut ()).unwrap().head, whole.head);
    assert_eq!(read(&packed(&whole.entries())[..], &mut ()).unwrap().head, whole.head);
}

#[test]
fn every_cut_and_every_changed_byte_is_found() {
    let bytes = exported(&whole());
    for length in (0..bytes.len()).step_by(7) {
        let cut = refused(&bytes[..length]);
        assert!(!cut.is_empty(), "{length}");
    }
    let mut unharmed = 0;
    for at in (0..bytes.len()).step_by(11) {
        let mut changed = bytes.clone();
        changed[at] ^= 0x10;
        // A few bits of the compression's frame carry no information.
        if let Ok(found) = read(&changed[..], &mut ()) {
            assert_eq!(found.manifest, whole().manifest);
            unharmed += 1;
        }
    }
    assert!(unharmed < 5, "{unharmed}");
}

#[test]
fn entries_that_would_do_harm_are_refused() {
    let whole = whole();
    let file = |name: &str, kind: EntryType, content: &[u8]| (name.to_owned(), kind, content.to_vec());
    let regular = EntryType::Regular;
    for (entry, words) in [
        (file("../../etc/passwd", regular, b"x"), "`..`"),
        (file("vae/../../x", regular, b"x"), "`..`"),
        (file("/etc/passwd", regular, b"x"), "absolute"),
        (file("C:\\x", regular, b"x"), "absolute"),
        (file("vae//x", regular, b"x"), "not a plain path"),
        (file("./card.md", regular, b"x"), "not a plain path"),
        (file("vae/\u{7}x", regular, b"x"), "not a plain path"),
        (file("vae/link", EntryType::Symlink, b""), "a link"),
        (file("vae/link", EntryType::Link, b""), "a link"),
        (file("vae", EntryType::Directory, b""), "a folder"),
        (file("vae/pipe", EntryType::Fifo, b""), "neither file nor folder"),
        (file("././@LongLink", EntryType::GNULongName, &[b'a'; 4096]), "an extension"),
        (file("pax", EntryType::XHeader, b"12 path=../x\n"), "an extension"),
        (file("unknown.bin", regular, b"x"), "does not list it"),
        (file("vae/model.safetensors", regular, b"x"), "it has 1 bytes"),
        (file("vae/model.safetensors", regular, &[8; 100_000]), "its bytes hash to"),
    ] {
        // Replaces the card, before the files.
        let mut entries = whole.entries();
        let name = entry.0.clone();
        entries[2] = entry;
        let shown = refused(&packed(&entries));
        assert!(shown.contains(words), "{name}: {shown}");
        assert!(!shown.contains('\u{7}'), "{shown:?}");
    }
    let mut twice = whole.entries();
    twice.push(twice[4].clone());
    assert!(refused(&packed(&twice)).contains("appears twice"));
    let mut order = whole.entries();
    order.swap(0, 1);
    assert!(refused(&packed(&order)).contains("expected `bundle.json`"));
    order = whole.entries();
    order.swap(1, 2);
    assert!(refused(&packed(&order)).contains("expected `manifest.json`"));
    for gone in 0..whole.entries().len() {
        let mut entries = whole.entries();
        let (name, ..) = entries.remove(gone);
        let read = read(&packed(&entries)[..], &mut ());
        assert_eq!(read.is_ok(), name == CARD, "{name}");
    }
}

#[test]
fn heads_and_manifests_that_this_build_does_not_read_are_refused() {
    let whole = whole();
    let with = |change: &dyn Fn(&mut Value)| {
        let mut entries = whole.entries();
        let mut head = serde_json::to_value(&whole.head).unwrap();
        change(&mut head);
        entries[0].2 = serde_json::to_vec(&head).unwrap();
        packed(&entries)
    };
    let newer = refused(&with(&|head| *head = json!({"format": 2, "other": true})));
    assert!(newer.contains("format 2") && newer.contains("newer build"), "{newer}");
    assert!(refused(&with(&|head| head["model"] = json!("../x"))).contains("not a model name"));
    assert!(refused(&with(&|head| head["artifact"] = json!(Digest::of(b"x")))).contains("`bundle.json` says"));
    assert!(refused(&with(&|head| head["metrics"] = json!("many"))).contains("cannot be parsed"));

    // Manifests, with their digest in the head.
    let with = |change: &dyn Fn(&mut Manifest), raw: &dyn Fn(String) -> String| {
        let mut entries = whole.entries();
        let mut manifest = whole.manifest.clone();
        change(&mut manifest);
        let bytes = raw(String::from_utf8(manifest.to_bytes()).unwrap()).into_bytes();
        entries[0].2 = serde_json::to_vec(&Head { artifact: Digest::of(&bytes), ..whole.head.clone() }).unwrap();
        entries[1].2 = bytes;
        refused(&packed(&entries))
    };
    let same = |text: String| text;
    let unknown = with(&|_| {}, &|text| text.replace("\"kind\":\"model\"", "\"kind\":\"hologram\""));
    assert!(unknown.contains("hologram"), "{unknown}");
    let vae = with(&|m| m.kind = ArtifactKind::Vae, &same);
    assert!(vae.contains("expected a model"), "{vae}");
    assert!(with(&|m| m.format = 9, &same).contains("format 9"));
    assert!(with(&|_| {}, &|text| format!("{text} ")).contains("canonical JSON"));
    let entry = |bytes| FileEntry::of_blob(Digest::of(b"x"), bytes);
    let lists = |name: &'static str, bytes: u64| with(&move |m| _ = m.files.insert(name.into(), entry(bytes)), &same);
    assert!(lists("../x", 1).contains("`..`"));
    assert!(lists("card.md", 1).contains("reserved for the bundle"));
    assert!(lists("vae/huge", u64::MAX).contains("expected at most"));
    // A file that is listed but missing, and one that exists but belongs to no part.
    assert!(lists("vae/zzz", 1).contains("`vae/zzz`"));
    assert!(with(&|m| _ = m.files.remove("vae/manifest.json"), &same).contains("lists no `vae/manifest.json`"));
    let mut entries = whole.entries();
    let mut manifest = whole.manifest.clone();
    manifest.files.insert("vae/extra".into(), entry(1));
    entries[0].2 = serde_json::to_vec(&Head { artifact: manifest.digest(), ..whole.head.clone() }).unwrap();
    entries[1].2 = manifest.to_bytes();
    entries.push(("vae/extra".into(), EntryType::Regular, b"x".to_vec()));
    assert!(refused(&packed(&entries)).contains("are not those that the manifests of its parts list"));
}

#[test]
fn bombs_are_left_at_the_first_byte_too_many() {
    assert!(refused(b"PK\x03\x04 is a zip").contains("not compressed with zstd"));
    assert!(refused(b"").contains("fewer than 4"));
    let nothing = zstd::encode_all(&b""[..], 1).unwrap();
    assert!(refused(&nothing).contains("has no `bundle.json`"));
    // 256 MiB of zeros in some kilobytes, at each place where they would be unpacked.
    let zeros = |count: u64| io::repeat(0).take(count);
    let bomb = |before: &[u8], size: u64| {
        let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
        encoder.write_all(before).unwrap();
        io::copy(&mut zeros(size), &mut encoder).unwrap();
        encoder.finish().unwrap()
    };
    let header = |name: &str, size: u64| {
        let mut header = Header::new_ustar();
        header.set_path(name).unwrap();
        header.set_size(size);
        header.set_cksum();
        header.as_bytes().to_vec()
    };
    let size = 256 << 20;
    let large = refused(&bomb(&header(HEAD, size), size));
    assert!(large.contains("expected at most"), "{large}");
    assert!(refused(&bomb(b"", size)).contains("data follows the end of the archive"));
    // A frame that requires a window of 128 MiB.
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
    encoder.set_parameter(zstd::zstd_safe::CParameter::WindowLog(27)).unwrap();
    encoder.set_parameter(zstd::zstd_safe::CParameter::EnableLongDistanceMatching(true)).unwrap();
    encoder.write_all(&header(HEAD, 10)).unwrap();
    let window = refused(&encoder.finish().unwrap());
    assert!(window.contains("cannot be unpacked"), "{window}");
    // After a valid archive.
    let mut behind = zstd::decode_all(&exported(&whole())[..]).unwrap();
    behind.extend(std::iter::repeat_n(0, 10 * 512));
    assert!(read(&zstd::encode_all(&behind[..], 1).unwrap()[..], &mut ()).is_ok(), "tar's own padding");
    behind.push(1);
    assert!(refused(&zstd::encode_all(&behind[..], 1).unwrap()).contains("follows the end"));
}

#[tokio::test]
async fn a_bundle_becomes_a_version_or_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(&dir.path().join("store"), Holder::this_process("test")).await.unwrap();
    let file = dir.path().join("b.tar.zst");
    let (whole, blobs) = (whole(), || store.blobs().list().unwrap().len());
    let bytes = exported(&whole);
    for damaged in [&bytes[..bytes.len() - 9], &bytes[..bytes.len() / 2], b"no bundle"] {
        std::fs::write(&file, damaged).unwrap();
        store.import_bundle(&file, None).await.unwrap_err();
        assert_eq!((blobs(), store.models().await.unwrap().len()), (0, 0), "nothing half-written");
    }
    assert_eq!(std::fs::read_dir(dir.path().join("store/staging")).map_or(0, Iterator::count), 0);
    std::fs::write(&file, &bytes).unwrap();
    let version = store.import_bundle(&file, None).await.unwrap();
    assert_eq!((version.model.as_str(), version.version, version.artifact), ("quick", 1, whole.head.artifact));
    assert!(version.metrics["odd"].is_nan() && version.metrics["fid"] == 0.25);
    assert_eq!(version.source["imported"]["source"]["run"], "r-1");
    assert_eq!(store.import_bundle(&file, None).await.unwrap().version, 1, "the same again");
    let renamed = store.import_bundle(&file, Some(ModelName::new("other"))).await.unwrap();
    assert_eq!((renamed.model.as_str(), renamed.version), ("other", 1));
    assert!(store.fsck().await.unwrap().problems.is_empty());
    let gone = store.gc(0).await.unwrap();
    assert_eq!(gone.remove, [], "a version needs all of it");
    assert_eq!(store.resolve("quick@best").await.unwrap().version, 1, "it says which metric decides");
}
