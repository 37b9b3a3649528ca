//! Fuzzing of bundles for a limited time, and tests of malicious files; `hostile::fuzz` has the rules and the treatment
//! of findings.
//!
//! The decompressor's window of at most 32 MiB is allocated by a C library and not counted here; frames with a larger
//! window are refused below.

use std::alloc::System;
use std::io::{self, Read as _, Write as _};
use std::path::Path;

use cap::Cap;
use hostile::named::Named;
use hostile::{Target, fuzz};
use protocol::artifact::FileEntry;
use protocol::{ArtifactKind, Digest, Manifest};
use registry::testing::{self, Entry, Form, Whole, archive, compressed, regular};
use tar::{EntryType, Header};

#[global_allocator]
static MEMORY: Cap<System> = Cap::new(System, usize::MAX);

/// Uncompressed size of a bomb of some kilobytes: more than the allowed allocation.
const BOMB: u64 = 128 << 20;

fn whole() -> Whole {
    Whole::of(vec![7; 3000])
}

fn seeds() -> Vec<Vec<u8>> {
    let whole = whole();
    let tar = archive(&whole.entries());
    let denoiser = &whole.manifest.files["denoiser/manifest.json"].digest;
    vec![
        Form::File.marked(&compressed(&tar)),
        Form::Archive.marked(&tar),
        Form::Manifest.marked(&whole.manifest.to_bytes()),
        Form::Denoiser.marked(&whole.files[denoiser]),
    ]
}

/// Compresses some bytes followed by zeros.
fn bomb(before: &[u8]) -> Vec<u8> {
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).expect("in memory");
    encoder.write_all(before).expect("in memory");
    io::copy(&mut io::repeat(0).take(BOMB), &mut encoder).expect("in memory");
    encoder.finish().expect("in memory")
}

fn header(name: &str, kind: EntryType, size: u64) -> Vec<u8> {
    let mut header = Header::new_ustar();
    header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
    header.set_entry_type(kind);
    header.set_size(size);
    header.set_cksum();
    header.as_bytes().to_vec()
}

/// Makes a frame with a window of 128 MiB.
fn wide_window() -> Vec<u8> {
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).expect("in memory");
    encoder.set_parameter(zstd::zstd_safe::CParameter::WindowLog(27)).expect("a window");
    encoder.set_parameter(zstd::zstd_safe::CParameter::EnableLongDistanceMatching(true)).expect("a window");
    encoder.write_all(&archive(&whole().entries())).expect("in memory");
    encoder.finish().expect("in memory")
}

/// Malicious bundles: paths outside the folder, more content than announced, or less.
fn made_to_do_harm() -> Vec<Named> {
    let whole = whole();
    let entries = |change: &dyn Fn(&mut Vec<Entry>)| {
        let mut entries = whole.entries();
        change(&mut entries);
        Form::Archive.marked(&archive(&entries))
    };
    // Replaces the card, before the files.
    let third = |name: &str, kind: EntryType, content: &[u8]| {
        entries(&|all: &mut Vec<Entry>| all[2] = (name.to_owned(), kind, content.to_vec()))
    };
    // Entries before one with a forged length in its header.
    let before = |count: usize| {
        let all = archive(&whole.entries()[..count]);
        all[..all.len() - 1024].to_vec()
    };
    let announced =
        |name: &str, size: u64| Form::Archive.marked(&[before(2), header(name, EntryType::Regular, size)].concat());
    let manifest = |change: &dyn Fn(&mut Manifest)| {
        let mut manifest = whole.manifest.clone();
        change(&mut manifest);
        Form::Manifest.marked(&manifest.to_bytes())
    };
    let entry = |bytes: u64| FileEntry::of_blob(Digest::of(b"x"), bytes);
    let lists = |name: &'static str, bytes: u64| {
        manifest(&move |manifest: &mut Manifest| _ = manifest.files.insert(name.into(), entry(bytes)))
    };
    let tar = archive(&whole.entries());
    let file = compressed(&tar);
    let brackets = b"[".repeat(100_000);
    vec![
        ("nothing", Form::File.marked(b"")),
        ("a zip", Form::File.marked(&hostile::seeds::zip_bomb(&["bundle.json"], 1 << 20))),
        ("zeros in the place of an archive", Form::File.marked(&bomb(b""))),
        ("a head of zeros", Form::File.marked(&bomb(&header("bundle.json", EntryType::Regular, BOMB)))),
        (
            "a manifest of zeros",
            Form::File.marked(&bomb(&[before(1), header("manifest.json", EntryType::Regular, BOMB)].concat())),
        ),
        ("weights of zeros, more than were announced", {
            Form::File.marked(&bomb(&[before(2), header("vae/model.safetensors", EntryType::Regular, BOMB)].concat()))
        }),
        ("zeros behind the end", Form::File.marked(&bomb(&tar))),
        ("a window of 128 MiB", Form::File.marked(&wide_window())),
        ("cut before its end", Form::File.marked(&file[..file.len() - 20])),
        ("cut in the middle", Form::File.marked(&file[..file.len() / 2])),
        ("cut in the middle of a file", Form::Archive.marked(&tar[..tar.len() * 2 / 3])),
        ("two bundles", Form::File.marked(&[&file[..], &file].concat())),
        ("a path that leads out", third("../../etc/passwd", EntryType::Regular, b"x")),
        ("a path that leads out of a part", third("vae/../../x", EntryType::Regular, b"x")),
        ("an absolute path", third("/etc/passwd", EntryType::Regular, b"x")),
        ("a path of another system", third("C:\\x", EntryType::Regular, b"x")),
        ("a link", third("vae/model.safetensors", EntryType::Symlink, b"")),
        ("a hard link", third("vae/model.safetensors", EntryType::Link, b"")),
        ("a device", third("vae/model.safetensors", EntryType::Block, b"")),
        ("a folder", third("vae", EntryType::Directory, b"")),
        ("a long name", third("././@LongLink", EntryType::GNULongName, &[b'a'; 1 << 20])),
        ("an extension with a path", third("pax", EntryType::XHeader, b"12 path=../x\n")),
        ("an extension with a size", third("pax", EntryType::XHeader, b"30 size=9223372036854775807\n")),
        ("a file with holes", third("vae/model.safetensors", EntryType::GNUSparse, b"")),
        ("a file twice", entries(&|all| all.push(all[4].clone()))),
        ("a head twice", entries(&|all| all.insert(1, all[0].clone()))),
        ("a card twice", entries(&|all| all.push(all[2].clone()))),
        ("a file that nothing lists", entries(&|all| all.push(regular("vae/x", vec![1])))),
        ("files before the manifest", entries(&|all| all.swap(1, 3))),
        ("a file of 2^40 bytes", announced("vae/model.safetensors", 1 << 40)),
        ("a card of 2^60 bytes", announced("card.md", 1 << 60)),
        ("a card of 2^64 - 1 bytes", announced("card.md", u64::MAX)),
        ("a head of brackets", entries(&|all| all[0].2 = brackets.clone())),
        ("a head of another format", entries(&|all| all[0].2 = br#"{"format": 18446744073709551615}"#.to_vec())),
        ("a manifest of brackets", Form::Manifest.marked(&brackets)),
        ("a manifest of 2^60 bytes", lists("vae/x", 1 << 60)),
        ("a manifest with a path that leads out", lists("../x", 1)),
        ("a manifest with the bundle's own names", lists("bundle.json", 1)),
        ("a manifest with a file that is not there", lists("vae/zzz", 1)),
        ("a manifest of twenty thousand files", {
            manifest(&|manifest| manifest.files.extend((0..20_000).map(|i| (format!("vae/{i}"), entry(0)))))
        }),
        ("a manifest of four million terabytes", {
            let most = protocol::limits::BLOB_BYTES as u64;
            manifest(&|manifest| manifest.files.extend((0..9000).map(|i| (format!("vae/{i}"), entry(most)))))
        }),
        ("a part of brackets", Form::Denoiser.marked(&brackets)),
        (
            "a part that fits none",
            Form::Denoiser.marked(
                &Manifest::new(ArtifactKind::Denoiser, serde_json::json!({"fits": {"vae": Digest::of(b"x")}}))
                    .to_bytes(),
            ),
        ),
        (
            "a part of another kind",
            Form::Denoiser.marked(&Manifest::new(ArtifactKind::Model, serde_json::json!({})).to_bytes()),
        ),
    ]
}

const TARGETS: [Target; 1] = [Target::new("bundle", testing::bundle, seeds).named(made_to_do_harm).words(
    "bundle.json¦manifest.json¦card.md¦vae/model.safetensors¦\"format\":1¦\"files\":{¦\"bytes\":¦\"digest\":\"¦\"meta\":{¦\"parts\":{¦\"fits\":{¦\"sampler\":{¦\"metrics\":{¦\"source\":{¦../¦ustar\u{0}00¦\u{28}",
)];

#[test]
fn bundle() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
    fuzz::run("bundle", &TARGETS, &MEMORY, &corpus, Path::new(env!("CARGO_TARGET_TMPDIR")));
}

#[test]
fn what_was_made_to_do_harm_is_refused_and_writes_nothing() {
    let outside = std::env::temp_dir().join("etc");
    assert!(!outside.exists(), "{} is there already", outside.display());
    for target in TARGETS {
        for (what, bytes) in (target.named)() {
            assert!(!(target.run)(&bytes), "{what}: it was accepted");
        }
        for seed in (target.seeds)() {
            assert!((target.run)(&seed), "a seed is refused");
        }
    }
    assert!(!outside.exists(), "a path led out");
}
