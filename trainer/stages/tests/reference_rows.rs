//! The definitions of the reconstruction metrics against rows of the reference table that need no network.

use motion::{DataPath, Dataset};
use protocol::stage::{DataFormat, Split};
use stages::metrics::{joints, reconstruction};

/// Rows of a guess at a clip: global, aligned and local error in mm, smooth-L1 of the features.
type Row = (&'static str, fn(&[f32], usize) -> Vec<f32>, [f64; 4]);

#[test]
fn guesses_without_a_network_have_the_errors_of_the_reference_table() {
    let Some(folder) = fixtures::data("humanml3d-mini") else { return };
    let (dataset, _) = Dataset::open(&DataPath::local(&folder), DataFormat::Humanml3d).expect("the folder opens");
    let entries = dataset.entries_of(Split::Test);
    let rows: [Row; 3] = [
        ("zeros", |clip, _| vec![0.0; clip.len()], [1840.0, 117.1, 109.7, 0.378]),
        (
            "first frame's features",
            |clip, width| clip[..width].repeat(clip.len() / width),
            [1534.0, 177.6, 95.6, 0.320],
        ),
        ("clip mean", joints::time_mean, [269.0, 69.8, 66.7, 0.178]),
    ];
    let width = dataset.mean.len();
    for (name, guess, expected) in rows {
        let clips: Vec<_> = entries
            .iter()
            .map(|&e| {
                let entry = &dataset.entries[e];
                let mut clip = dataset.features(entry)[..entry.len / 4 * 4 * width].to_vec();
                dataset.normalise(&mut clip);
                let guess = guess(&clip, width);
                reconstruction::ClipErrors::between(&clip, &guess, &dataset.mean, &dataset.std, dataset.skeleton())
            })
            .collect();
        let found = reconstruction::summary(&clips, dataset.skeleton(), "");
        println!("{name}: {found:?}");
        for (key, expected) in
            ["mpjpe_global_mm", "mpjpe_mm", "mpjpe_local_mm", "feature_smooth_l1"].into_iter().zip(expected)
        {
            let error = (found[key] - expected).abs() / expected;
            assert!(error < 5e-3, "{name}: {key} is {}, the table says {expected}", found[key]);
        }
    }
}
