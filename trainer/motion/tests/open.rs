//! Opening folders: the content of real ones, and the errors of broken ones.

mod shared;

use std::fs;
use std::path::Path;

use motion::Dataset;
use motion::dataset::{OpenError, ProblemKind, SkipReason};
use motion::{DataPath, npy, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic, Split};

#[test]
fn the_mini_sets_open_with_their_known_counts() {
    for (part, format, counts) in
        [("humanml3d-mini", DataFormat::Humanml3d, [259, 16, 44]), ("kit-mini", DataFormat::Kit, [47, 4, 9])]
    {
        let Some(folder) = shared::data(part) else { return };
        let (dataset, report) = Dataset::open(&DataPath::local(&folder), format).unwrap_or_else(|e| panic!("{e}"));
        println!("{part}\n{report}");
        let found = [Split::Train, Split::Val, Split::Test].map(|split| dataset.entries_of(split).len());
        assert_eq!(found, counts, "{part}");
        assert_eq!(dataset.entries_of(Split::All).len(), counts.iter().sum::<usize>());
        assert!(report.skips.is_empty(), "{report}");
        for entry in &dataset.entries {
            assert_eq!(dataset.features(entry).len(), entry.len * dataset.skeleton().features);
        }
        let mut rows = dataset.features(&dataset.entries[0]).to_vec();
        let before = rows.clone();
        dataset.normalise(&mut rows);
        dataset.denormalise(&mut rows);
        let unit = if format == DataFormat::Kit { 1000.0 } else { 1.0 };
        assert!(rows.iter().zip(&before).all(|(a, b)| (a - b).abs() < 1e-6 * unit));

        let files = dataset.to_files().unwrap();
        assert_eq!(
            files,
            Dataset::open(&DataPath::local(&folder), format).unwrap().0.to_files().unwrap(),
            "other bytes the second time"
        );
        let fetch = |name: &str| {
            files.iter().find(|(n, _)| n == name).map(|(_, b)| b.clone().into()).ok_or_else(|| "not there".to_owned())
        };
        assert_eq!(Dataset::from_files(&fetch).unwrap(), dataset);
        assert!(Dataset::from_files(&|_| Err("gone".into())).unwrap_err().to_string().contains("dataset.json: gone"));
    }
}

/// A folder of 10 synthetic clips.
fn folder() -> (tempfile::TempDir, Vec<String>) {
    let settings = DataSynthetic { clips: 10, val: 0.1, test: 0.1, mirror: false };
    let dataset = synthetic::generate(&settings, Seed(1));
    let folder = tempfile::tempdir().expect("a folder");
    synthetic::write_folder(&dataset, folder.path()).expect("a written folder");
    let list = fs::read_to_string(folder.path().join("train.txt")).expect("a list");
    (folder, list.lines().map(str::to_owned).collect())
}

fn open_error(folder: &Path) -> OpenError {
    Dataset::open(&DataPath::local(folder), DataFormat::Humanml3d).expect_err("a broken folder")
}

#[track_caller]
fn expect(error: &OpenError, kind: ProblemKind, parts: &[&str]) {
    let text = error.to_string();
    assert!(error.problems.iter().any(|p| p.kind == kind), "{kind:?} in {text}");
    for part in parts {
        assert!(text.contains(part), "`{part}` in {text}");
    }
}

#[test]
fn missing_parts_are_named() {
    expect(
        &open_error(Path::new("no/such/folder")),
        ProblemKind::Missing,
        &["no/such/folder: no such folder", "dataset.path"],
    );
    let (folder, _) = folder();
    fs::remove_file(folder.path().join("val.txt")).unwrap();
    fs::remove_file(folder.path().join("Std.npy")).unwrap();
    fs::remove_dir_all(folder.path().join("texts")).unwrap();
    let error = open_error(folder.path());
    expect(&error, ProblemKind::Missing, &["val.txt", "Std.npy", "texts: no such folder"]);
    assert_eq!(error.problems.len(), 3, "{error}");
}

#[test]
fn every_bad_clip_is_named_at_once() {
    let (folder, ids) = folder();
    let motion = |i: usize| folder.path().join(format!("new_joint_vecs/{}.npy", ids[i]));
    let rows = |i: usize| npy::read(&DataPath::local(motion(i))).unwrap();
    npy::write(&motion(0), &[50, 251], &vec![0.0; 50 * 251]).unwrap();
    let mut nan = rows(1);
    nan.data[7 * 263 + 5] = f32::NAN;
    npy::write(&motion(1), &nan.shape, &nan.data).unwrap();
    let bytes = fs::read(motion(2)).unwrap();
    fs::write(motion(2), &bytes[..bytes.len() - 1000]).unwrap();
    let mut doubles = fs::read(motion(3)).unwrap();
    let at = doubles.windows(3).position(|w| w == b"<f4").unwrap();
    doubles[at..at + 3].copy_from_slice(b"<i4");
    fs::write(motion(3), doubles).unwrap();
    fs::write(folder.path().join(format!("texts/{}.txt", ids[4])), "fine#fine/ADJ#0.0#0.0\nno fields\n").unwrap();
    fs::write(motion(5), b"not an array").unwrap();
    let error = open_error(folder.path());
    println!("{error}");
    assert_eq!(error.problems.len(), 6, "{error}");
    let whole = bytes.len() - 128;
    let (found, expected) = (format!("{} bytes of data", whole - 1000), format!("expected {whole}"));
    expect(&error, ProblemKind::Shape, &[&ids[0], "251 features per frame; expected 263"]);
    expect(&error, ProblemKind::NotFinite, &[&ids[1], "NaN in frame 7, column 5"]);
    expect(&error, ProblemKind::Size, &[&ids[2], &found, &expected, "truncated"]);
    expect(&error, ProblemKind::Type, &[&ids[3], "expected f32 (<f4)"]);
    expect(&error, ProblemKind::Text, &[&format!("{}.txt:2: the line has 1 field ", ids[4]), "expected `caption#"]);
    expect(&error, ProblemKind::Type, &[&ids[5], "not a .npy file"]);
}

#[test]
fn what_the_rules_leave_out_is_reported() {
    let (folder, ids) = folder();
    let motion = |i: usize| folder.path().join(format!("new_joint_vecs/{}.npy", ids[i]));
    let text = |i: usize| folder.path().join(format!("texts/{}.txt", ids[i]));
    let frames = |i: usize, n: usize| npy::write(&motion(i), &[n, 263], &vec![0.5; n * 263]).unwrap();
    frames(0, 39);
    frames(1, 200);
    fs::remove_file(motion(2)).unwrap();
    fs::remove_file(text(3)).unwrap();
    fs::write(text(4), "short#short/ADJ#0.5#1.0\n").unwrap();
    frames(5, 100);
    fs::write(text(5), "whole#whole/ADJ#0.0#nan\npart#part/NOUN#1.0#4.5\npart#part/NOUN#1.0#4.5\n").unwrap();
    let (dataset, report) = Dataset::open(&DataPath::local(folder.path()), DataFormat::Humanml3d).unwrap();
    println!("{report}");
    let reasons: Vec<_> = report.skips.iter().map(|s| (s.id.as_str(), s.reason.clone())).collect();
    assert_eq!(
        reasons,
        [
            (ids[0].as_str(), SkipReason::TooShort { frames: 39, min: 40 }),
            (ids[1].as_str(), SkipReason::TooLong { frames: 200, bound: 200 }),
            (ids[2].as_str(), SkipReason::NoMotion),
            (ids[3].as_str(), SkipReason::NoText),
            (ids[4].as_str(), SkipReason::CaptionRange { line: 1, frames: 10 }),
            (ids[4].as_str(), SkipReason::NoCaption),
        ]
    );
    let entries: Vec<_> = dataset.entries.iter().filter(|e| e.id.starts_with(&ids[5])).collect();
    let names: Vec<_> = entries.iter().map(|e| e.id.strip_prefix(ids[5].as_str()).unwrap()).collect();
    assert_eq!(names, ["", "@20-90", "@20-90.3"]);
    assert_eq!((entries[1].start, entries[1].len, entries[1].captions.len()), (20, 70, 1));
    assert!(report.to_string().contains("too short, train (1)"));
}

/// Lines that the published loaders skip silently are skipped, and reported with file and line.
#[test]
fn odd_captions_are_left_out_and_listed() {
    let (folder, ids) = folder();
    let text = folder.path().join(format!("texts/{}.txt", ids[0]));
    let lines = ["whole#whole/ADJ#0#0", "inverted#a/DET#4#1", "more#a/DET#0#0#9#8", "past#a/DET#900#901"];
    fs::write(&text, lines.join("\n")).unwrap();
    fs::write(folder.path().join(format!("texts/{}.txt", ids[1])), "inverted#a/DET#4#1\n").unwrap();
    let (dataset, report) = Dataset::open(&DataPath::local(folder.path()), DataFormat::Humanml3d).unwrap();
    let reasons: Vec<_> = report.skips.iter().map(|s| (s.id.as_str(), s.reason.clone())).collect();
    let inverted = |line| SkipReason::CaptionTimes { line, range: "4 to 1 s".into() };
    assert_eq!(
        reasons,
        [
            (ids[0].as_str(), inverted(2)),
            (ids[0].as_str(), SkipReason::ExtraFields { line: 3, fields: 6 }),
            (ids[0].as_str(), SkipReason::CaptionRange { line: 4, frames: 0 }),
            (ids[1].as_str(), inverted(1)),
            (ids[1].as_str(), SkipReason::NoCaption),
        ]
    );
    let entry = dataset.entries.iter().find(|e| e.id == ids[0]).unwrap();
    let captions: Vec<&str> = entry.captions.iter().map(|c| dataset.captions[*c].text.as_str()).collect();
    assert_eq!(captions, ["whole", "more"]);
    let shown = report.to_string();
    assert!(shown.contains(&format!("texts/{}.txt:2 (4 to 1 s)", ids[0])), "{shown}");
    assert!(shown.contains(&format!("texts/{}.txt:3 (6 fields)", ids[0])), "{shown}");
}

/// Pipes, cycles of links, sockets and folders in place of files: each is reported at once, without blocking.
#[test]
fn what_is_no_file_is_named() {
    let (folder, ids) = folder();
    let motion = |i: usize| folder.path().join(format!("new_joint_vecs/{}.npy", ids[i]));
    let text = |i: usize| folder.path().join(format!("texts/{}.txt", ids[i]));
    let fifo = |path: &Path| {
        fs::remove_file(path).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
    };
    fifo(&motion(0));
    fifo(&text(1));
    fs::remove_file(motion(2)).unwrap();
    fs::create_dir(motion(2)).unwrap();
    fs::remove_file(motion(3)).unwrap();
    std::os::unix::fs::symlink(motion(3), motion(3)).unwrap();
    fs::remove_file(text(4)).unwrap();
    let _socket = std::os::unix::net::UnixListener::bind(text(4)).unwrap();
    fs::write(text(5), format!("{}#a/DET#0#0", "a".repeat(2 << 20))).unwrap();
    let error = open_error(folder.path());
    assert_eq!(error.problems.len(), 6, "{error}");
    for (path, part) in [
        (motion(0), "is a named pipe; expected a file"),
        (text(1), "is a named pipe; expected a file"),
        (motion(2), "is a folder; expected a file"),
        (motion(3), "symbolic link"),
        (text(4), "is a socket; expected a file"),
        (text(5), "has more than 1048576 bytes"),
    ] {
        let wanted = path.display().to_string();
        let line =
            error.problems.iter().find(|p| p.what.contains(&wanted)).unwrap_or_else(|| panic!("{wanted}: {error}"));
        assert!(line.kind == ProblemKind::Io && line.what.contains(part), "{line}");
    }
    fifo(&folder.path().join("train.txt"));
    fifo(&folder.path().join("Mean.npy"));
    expect(&open_error(folder.path()), ProblemKind::Io, &["train.txt: is a named pipe", "Mean.npy: is a named pipe"]);
}

#[test]
fn nothing_to_train_on_is_an_error() {
    let (folder, ids) = folder();
    for id in &ids {
        fs::remove_file(folder.path().join(format!("new_joint_vecs/{id}.npy"))).unwrap();
    }
    expect(&open_error(folder.path()), ProblemKind::Empty, &["train.txt", "no usable training clip", "no features"]);
}
