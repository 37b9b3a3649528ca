//! The synthetic set: the same for the same seed, readable as a folder, physically plausible.

use motion::DataPath;
use motion::Dataset;
use motion::features::{Turns, extract_with, mirror_joints, recover_from_rotations, recover_joints};
use motion::synthetic::{generate, write_folder};
use proptest::prelude::*;
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};

fn settings(clips: usize, mirror: bool) -> DataSynthetic {
    DataSynthetic { clips, mirror, ..DataSynthetic::default() }
}

#[test]
fn a_written_folder_opens_as_the_same_dataset() {
    let dataset = generate(&settings(40, true), Seed(5));
    assert_eq!(dataset, generate(&settings(40, true), Seed(5)));
    let folder = tempfile::tempdir().unwrap();
    write_folder(&dataset, folder.path()).unwrap();
    let (opened, report) =
        Dataset::open(&DataPath::local(folder.path()), DataFormat::Humanml3d).unwrap_or_else(|e| panic!("{e}"));
    assert!(report.skips.is_empty() && report.shared.is_empty(), "{report}");
    assert_eq!(opened.clips.len(), 80);
    for (a, b) in opened.entries.iter().zip(&dataset.entries) {
        assert_eq!((&a.id, a.split, opened.features(a)), (&b.id, b.split, dataset.features(b)));
        let texts =
            |d: &Dataset, captions: &[usize]| captions.iter().map(|c| d.captions[*c].clone()).collect::<Vec<_>>();
        assert_eq!(texts(&opened, &a.captions), texts(&dataset, &b.captions));
    }
    assert_eq!((opened.mean, opened.std), (dataset.mean, dataset.std));
}

#[test]
fn more_clips_leave_the_earlier_ones_as_they_are() {
    let (few, many) = (generate(&settings(10, false), Seed(2)), generate(&settings(60, false), Seed(2)));
    assert_eq!(few.clips[..], many.clips[..10]);
    assert_ne!(few.clips[0], generate(&settings(10, false), Seed(3)).clips[0]);
}

#[test]
fn bodies_move_like_bodies() {
    let dataset = generate(&settings(280, false), Seed(3407));
    let skeleton = dataset.skeleton();
    for entry in &dataset.entries {
        let text = &dataset.captions[entry.captions[0]].text;
        assert!((40..200).contains(&entry.len), "{text}: {} frames", entry.len);
        let joints = recover_joints(dataset.features(entry), skeleton);
        let at = |t: usize, j: usize| [0, 1, 2].map(|k| f64::from(joints[(t * 22 + j) * 3 + k]));
        let distance = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
        for t in 1..entry.len {
            for j in 0..22 {
                let speed = distance(at(t, j), at(t - 1, j)) * skeleton.fps;
                assert!(speed < 12.0, "{text}: {} moves at {speed:.1} m/s in frame {t}", skeleton.names[j]);
            }
            let lowest = (0..22).map(|j| at(t, j)[1]).fold(f64::INFINITY, f64::min);
            assert!(lowest > -1e-4, "{text}: below the floor in frame {t}");
        }
        if text.contains("walk") {
            // A standing foot does not slide: of frames with a toe on the floor, nearly all are still.
            let toe = |t: usize| [10, 11].map(|j| (at(t, j)[1] < 0.006, distance(at(t, j), at(t - 1, j))));
            let low: Vec<f64> = (1..entry.len).flat_map(toe).filter(|(low, _)| *low).map(|(_, d)| d).collect();
            let sliding = low.iter().filter(|d| **d > 0.02).count();
            assert!(low.len() > entry.len / 2, "{text}: feet are in the air ({} of {})", low.len(), entry.len);
            assert!(sliding * 12 < low.len(), "{text}: {sliding} of {} standing toes slide", low.len());
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn features_and_joints_are_inverses(seed in 0_u64..1000) {
        let dataset = generate(&settings(28, false), Seed(seed));
        let skeleton = dataset.skeleton();
        for clip in &dataset.clips {
            let joints = recover_joints(&clip.features, skeleton);
            let from_rotations = recover_from_rotations(&clip.features, skeleton, skeleton.bone_lengths.unwrap());
            let apart = joints.iter().zip(&from_rotations).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            prop_assert!(apart < 2e-3, "{}: rotations and positions are {apart} apart", clip.id);
            // The last frame of features has no successor, so the result is one row shorter. The smoothed heading has
            // one frame less, so only the positions can be compared.
            let again = extract_with(&joints, skeleton, None, Turns::Continuous).unwrap();
            let back = recover_joints(&again, skeleton);
            let apart = joints.iter().zip(&back).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            prop_assert!(apart < 2e-3, "{}: {apart} after extract and recover", clip.id);
            prop_assert_eq!(&mirror_joints(&mirror_joints(&joints, skeleton), skeleton), &joints);
        }
    }
}
