//! `data.features` on a folder of our own recordings.

use std::collections::BTreeSet;
use std::fs;

use motion::dataset::Split;
use protocol::Seed;
use protocol::stage::{DataFeatures, DataFold, DataFormat, Splits, StageSettings, UpAxis};
use stage_lab::Bench;
use stages::artifacts;
use stages::context::StageError;

fn bench() -> Bench {
    Bench::new(burn::tensor::Device::flex(), 7, 1)
}

fn settings(folder: &std::path::Path) -> DataFeatures {
    DataFeatures { path: folder.display().to_string(), mirror: true, val: 0.2, test: 0.2, ..DataFeatures::default() }
}

#[test]
fn a_folder_becomes_the_same_dataset_however_it_is_cut() {
    let folder = tempfile::tempdir().unwrap();
    mocap::sample::write_bvh_folder(folder.path(), 10, Seed(3)).unwrap();
    let mut bench = bench();
    let mut run = |shards| {
        let settings = DataFeatures { shards, ..settings(folder.path()) };
        bench.run("dataset", &StageSettings::DataFeatures(settings), &[]).unwrap_or_else(|e| panic!("{e}"))
    };
    // More shards than files leave some shards empty.
    let (one, many) = (run(1), run(13));
    assert_eq!(one.output(), many.output());
    assert_eq!(one.metrics()["clips"], 20.0);
    let manifest = bench.manifest(one.output()).unwrap();
    let blobs = bench.blobs();
    let dataset = artifacts::dataset(&*blobs, &manifest).unwrap();
    assert_eq!((dataset.format, dataset.clips.len()), (DataFormat::Humanml3d, 20));
    for split in Split::ALL {
        let clips = dataset.entries.iter().filter(|entry| entry.split == split);
        // A clip and its mirrored twin come from one recording.
        let mut stems: Vec<&str> = clips.map(|entry| entry.id.trim_start_matches('M')).collect();
        stems.sort_unstable();
        assert!(!stems.is_empty() && stems.chunks(2).all(|pair| pair.len() == 2 && pair[0] == pair[1]), "{stems:?}");
    }
    let text = |name: &str| artifacts::file(&*blobs, &manifest, name).unwrap();
    let report = String::from_utf8(text("report.txt").to_vec()).unwrap();
    assert!(report.contains("10 files such as 000000: joint map `smpl`") && report.contains("left out: 0"), "{report}");
    assert!(text("contact-sheet.png").starts_with(b"\x89PNG"));
    let std = motion::npy::parse(std::path::Path::new("std"), &text("evaluator-std.npy"), false).unwrap();
    assert!((std.data[0] * 25.0 / dataset.std[0] - 1.0).abs() < 1e-6 && std.data[4] == dataset.std[4]);
}

#[test]
fn folds_hold_out_each_recording_once_and_share_the_clips() {
    let folder = tempfile::tempdir().unwrap();
    mocap::sample::write_bvh_folder(folder.path(), 10, Seed(3)).unwrap();
    let mut bench = bench();
    let whole = bench.run("recordings", &StageSettings::DataFeatures(settings(folder.path())), &[]);
    let whole = whole.unwrap_or_else(|e| panic!("{e}")).output();
    let blobs = bench.blobs();
    let of = |bench: &Bench, digest, split: Split| {
        let dataset = artifacts::dataset(&*blobs, &bench.manifest(digest).unwrap()).unwrap();
        let entries = dataset.entries.iter().filter(|entry| entry.split == split);
        entries.map(|entry| entry.id.clone()).collect::<BTreeSet<_>>()
    };
    let test = of(&bench, whole, Split::Test);
    let mut held: Vec<String> = Vec::new();
    for fold in 1..=4 {
        let settings = StageSettings::DataFold(DataFold { folds: 4, fold, ..DataFold::default() });
        let divided = bench.run(&format!("dataset_{fold}"), &settings, &[("dataset", whole)]);
        let divided = divided.unwrap_or_else(|e| panic!("{e}"));
        let (val, train) = (of(&bench, divided.output(), Split::Val), of(&bench, divided.output(), Split::Train));
        assert_eq!(divided.metrics()["val"], val.len() as f64);
        assert!(val.is_disjoint(&train) && val.len() + train.len() == 20 - test.len());
        assert_eq!(of(&bench, divided.output(), Split::Test), test);
        // A clip and its mirrored twin.
        assert!(val.iter().all(|id| val.contains(id.trim_start_matches('M'))), "{val:?}");
        held.extend(val);
        let (before, after) = (bench.manifest(whole).unwrap(), bench.manifest(divided.output()).unwrap());
        let changed: Vec<&String> =
            before.files.keys().filter(|name| before.files[*name] != after.files[*name]).collect();
        assert_eq!(changed, ["dataset.json"]);
    }
    held.sort_unstable();
    assert_eq!(held.len(), 20 - test.len());
    held.dedup();
    assert_eq!(held.len(), 20 - test.len());
    let many = StageSettings::DataFold(DataFold { folds: 20, fold: 1, ..DataFold::default() });
    let refused = bench.run("dataset", &many, &[("dataset", whole)]).unwrap_err();
    assert!(refused.to_string().contains("expected at least one for each of 20 folds"), "{refused}");
}

#[test]
fn broken_recordings_are_all_named_or_left_out() {
    let folder = tempfile::tempdir().unwrap();
    mocap::sample::write_bvh_folder(folder.path(), 6, Seed(3)).unwrap();
    for id in ["000001", "000004"] {
        let file = folder.path().join(format!("{id}.bvh"));
        let text = fs::read_to_string(&file).unwrap();
        fs::write(&file, &text[..text.len() / 2]).unwrap();
    }
    let mut bench = bench();
    let base = DataFeatures { shards: 3, ..settings(folder.path()) };
    let error = bench.run("dataset", &StageSettings::DataFeatures(base.clone()), &[]).unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, StageError::Input(_)), "{said}");
    for part in ["2 of 6 recordings cannot be read", "000001.bvh:", "000004.bvh:", "skip_broken"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let skipping = DataFeatures { skip_broken: true, ..base.clone() };
    let ran = bench.run("dataset", &StageSettings::DataFeatures(skipping), &[]).unwrap();
    assert_eq!((ran.metrics()["clips"], ran.metrics()["skipped"]), (8.0, 2.0));
    // The user's settings take precedence: a map, splits, axis or captions that do not fit the recordings are refused.
    for (settings, part) in [
        (DataFeatures { map: "nobody".into(), ..base.clone() }, "no built-in joint map `nobody`"),
        (DataFeatures { map: "lafan1".into(), ..base.clone() }, "`pelvis` uses the node"),
        (
            DataFeatures { splits: Splits::Lists, skip_broken: true, up: UpAxis::Y, ..base.clone() },
            "no usable training clip",
        ),
        (DataFeatures { captions: "gone.csv".into(), ..base }, "gone.csv: no such file"),
    ] {
        let said = bench.run("dataset", &StageSettings::DataFeatures(settings), &[]).unwrap_err().to_string();
        assert!(said.contains(part), "{part}: {said}");
    }
}
