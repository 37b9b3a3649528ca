//! Mean and Std of the mini sets by our rule, and known properties of the published statistics.

mod shared;

use motion::Skeleton;
use motion::dataset::statistics;
use protocol::stage::DataFormat;
use shared::{load, wide, worst};

#[test]
fn golden_stats() {
    for (part, format, golden) in [
        ("humanml3d-mini", DataFormat::Humanml3d, Some("humanml3d_mini")),
        ("kit-mini", DataFormat::Kit, Some("kit_mini")),
    ] {
        let (Some(folder), Some(stats)) = (shared::data(part), shared::data("golden/stats")) else { return };
        let skeleton = Skeleton::of(format);
        let mut files: Vec<_> =
            std::fs::read_dir(folder.join("new_joint_vecs")).unwrap().map(|f| f.unwrap().path()).collect();
        files.sort();
        let clips: Vec<Vec<f32>> = files.iter().map(|f| load(f).data).collect();
        let (mean, std) = statistics(skeleton, clips.iter().map(Vec::as_slice));
        // The stored statistics were summed in f32, ours in f64: 5.4e-5 and 7.8e-7 apart in metres.
        let unit = if format == DataFormat::Kit { 1000.0 } else { 1.0 };
        let stored = ["Mean.npy", "Std.npy"].map(|name| load(&folder.join(name)).data);
        let errors = [worst(mean.iter().copied(), wide(&stored[0])), worst(std.iter().copied(), wide(&stored[1]))];
        println!("{part}: Mean {:.1e}, Std {:.1e} from the stored f32 ones", errors[0], errors[1]);
        assert!(errors[0] < 1e-4 * unit && errors[1] < 1e-5 * unit, "{part}: {errors:?}");
        for (name, values) in [("Mean", &mean), ("Std", &std)] {
            let file = stats.join(format!("{}_{name}_f64.npy", golden.unwrap_or(part)));
            if file.exists() {
                let exact = load(&file).data;
                let error = worst(values.iter().map(|v| f64::from(*v as f32)), wide(&exact));
                println!("{part}: {name} {error:.1e} from the golden f64 one (tolerance 1e-6)");
                assert!(error < 1e-6, "{part} {name}: {error:.2e}");
            }
        }
    }
}

#[test]
fn golden_stats_published_std_is_constant_inside_our_groups() {
    let Some(stats) = shared::data("golden/stats") else { return };
    let mut files: Vec<_> = std::fs::read_dir(&stats).unwrap().map(|f| f.unwrap().path()).collect();
    files.sort();
    let mut cases = 0;
    for file in files.iter().filter(|f| f.to_string_lossy().to_lowercase().contains("std")) {
        let std = load(file).data;
        let format = if std.len() == 251 { DataFormat::Kit } else { DataFormat::Humanml3d };
        assert_eq!(std.len(), Skeleton::of(format).features, "{}", file.display());
        for group in Skeleton::of(format).layout().groups() {
            let first = std[group.start];
            let spread = std[group].iter().map(|v| f64::from((v - first).abs() / first)).fold(0.0, f64::max);
            assert!(spread < 1e-5, "{}: {spread}", file.display());
        }
        println!("{}: constant inside all 7 groups", file.file_name().unwrap().to_string_lossy());
        cases += 1;
    }
    assert!(cases > 0);
}
