//! Checks the golden feature clips: every folder is a case. 21 joints mean KIT-ML.

mod shared;

use std::path::Path;

use motion::Skeleton;
use motion::features::{self, extract, recover_from_rotations, recover_joints, root_path};
use motion::quaternion::Quat;
use protocol::stage::DataFormat;
use shared::{load, wide, worst};

fn target_of(folder: &Path, skeleton: &Skeleton) -> Vec<f64> {
    skeleton.lengths_of_offsets(&load(&folder.join("tgt_offsets.npy")).data)
}

/// Largest errors by file name, printed as one line per case.
struct Case {
    line: String,
    worst: f64,
}

impl Case {
    fn compare(&mut self, what: &str, found: impl IntoIterator<Item = f64>, expected: impl IntoIterator<Item = f64>) {
        let error = worst(found, expected);
        self.line += &format!(" {what} {error:.1e}");
        self.worst = self.worst.max(error);
    }
}

fn flat(rotations: &[Quat]) -> Vec<f64> {
    rotations.iter().flatten().copied().collect()
}

fn stages(case: &mut Case, folder: &Path, skeleton: &Skeleton, target: &[f64]) {
    let file = |name: &str| folder.join(format!("{name}.npy"));
    let joints: Vec<f64> = wide(&load(&file("joints")).data).collect();
    let given = |name: &str| file(name).exists().then(|| load(&file(name)).data);
    let (uniform, _) = features::uniform_skeleton(&joints, skeleton, target);
    let placed = features::place(&uniform, skeleton);
    if let Some(expected) = given("stage1_ik_quat_raw") {
        case.compare("ik_raw", flat(&features::inverse_kinematics(&joints, skeleton, false)), wide(&expected));
    }
    if let Some(expected) = given("stage1_uniform_skeleton") {
        case.compare("uniform", uniform, wide(&expected));
    }
    if let Some(expected) = given("stage2_global_positions") {
        case.compare("placed", placed.iter().copied(), wide(&expected));
    }
    let smooth = features::inverse_kinematics(&placed, skeleton, true);
    if let Some(expected) = given("stage3_ik_quat_smooth") {
        case.compare("ik_smooth", flat(&smooth), wide(&expected));
    }
    if let Some(expected) = given("stage3_local_positions") {
        let headings: Vec<Quat> = smooth.chunks_exact(skeleton.joints).map(|r| r[0]).collect();
        case.compare("local", features::local_positions(&placed, &headings, skeleton), wide(&expected));
    }
}

fn inverses(case: &mut Case, folder: &Path, vecs: &[f32], skeleton: &Skeleton, target: &[f64]) {
    let given = |name: &str| {
        let file = folder.join(format!("{name}.npy"));
        file.exists().then(|| load(&file).data)
    };
    let path = root_path(vecs, skeleton);
    if let Some(expected) = given("recover_root_quat") {
        case.compare("root_quat", path.iter().flat_map(|(q, _)| *q), wide(&expected));
    }
    if let Some(expected) = given("recover_root_pos") {
        case.compare("root_pos", path.iter().flat_map(|(_, p)| *p), wide(&expected));
    }
    if let Some(expected) = given("recover_from_ric") {
        case.compare("ric", wide(&recover_joints(vecs, skeleton)), wide(&expected));
    }
    if let Some(expected) = given("recover_from_rot") {
        case.compare("rot", wide(&recover_from_rotations(vecs, skeleton, target)), wide(&expected));
    }
}

#[test]
fn golden_features() {
    let (Some(golden), Some(mini), Some(kit)) =
        (shared::data("golden/features"), shared::data("humanml3d-mini"), shared::data("kit-mini"))
    else {
        return;
    };
    let mut failed = vec![];
    let folders = shared::folders(&golden);
    for folder in &folders {
        let name = folder.file_name().unwrap().to_string_lossy().into_owned();
        let mut case = Case { line: format!("{name}:"), worst: 0.0 };
        let find = |names: &[&str]| {
            names
                .iter()
                .map(|n| folder.join(n))
                .find(|f| f.exists())
                .unwrap_or_else(|| panic!("{name}: none of {names:?}"))
        };
        let joints = load(&find(&["joints.npy", "joints171.npy", "joints_mirrored.npy"]));
        let vecs = load(&find(&["vecs.npy", "reference_vecs.npy"])).data;
        let format = if joints.shape[1] == 21 { DataFormat::Kit } else { DataFormat::Humanml3d };
        let (skeleton, joints) = (Skeleton::of(format), joints.data);
        let own = folder.join("tgt_offsets.npy").exists();
        let base = if own {
            folder
        } else if format == DataFormat::Kit {
            &kit
        } else {
            &mini
        };
        let target = target_of(base, skeleton);
        let tolerance = match format {
            DataFormat::Kit => 5e-3,
            DataFormat::Humanml3d if own => 1e-4,
            DataFormat::Humanml3d => 5e-4,
        };
        let found = extract(&joints, skeleton, Some(&target)).unwrap_or_else(|e| panic!("{name}: {e}"));
        case.compare("vecs", wide(&found), wide(&vecs));
        if folder.join("joints.npy").exists() {
            stages(&mut case, folder, skeleton, &target);
        }
        inverses(&mut case, folder, &vecs, skeleton, &target);
        if folder.join("authors_new_joint_vecs.npy").exists() {
            let authors = load(&folder.join("authors_new_joint_vecs.npy")).data;
            case.compare("authors", wide(&found), wide(&authors));
            let joints = load(&folder.join("authors_new_joints.npy")).data;
            case.compare("authors_joints", wide(&recover_joints(&authors, skeleton)), wide(&joints));
        }
        println!("{} (tolerance {tolerance:.0e})", case.line);
        if case.worst > tolerance || case.worst.is_nan() {
            failed.push(format!("{name}: {:.2e} > {tolerance:.0e}", case.worst));
        }
    }
    assert!(!folders.is_empty(), "no case in {}", golden.display());
    assert!(failed.is_empty(), "{failed:#?}");
}

#[test]
fn golden_features_of_whole_sets() {
    for (part, format, tolerance, every) in
        [("humanml3d-mini", DataFormat::Humanml3d, 5e-4, 3), ("kit-mini", DataFormat::Kit, 5e-3, 1)]
    {
        let Some(folder) = shared::data(part) else { return };
        let skeleton = Skeleton::of(format);
        let target = target_of(&folder, skeleton);
        let ids = std::fs::read_to_string(folder.join("all.txt")).unwrap();
        let (mut errors, mut count, mut flips) = (0.0_f64, 0, 0);
        for id in ids.lines().map(str::trim).filter(|l| !l.is_empty()).step_by(every) {
            let joints = load(&folder.join(format!("joints/{id}.npy"))).data;
            let expected = load(&folder.join(format!("new_joint_vecs/{id}.npy"))).data;
            let found = extract(&joints, skeleton, Some(&target)).unwrap_or_else(|e| panic!("{id}: {e}"));
            let contacts = skeleton.layout().contacts;
            let rows =
                |v: &[f32]| v.chunks(skeleton.features).flat_map(|r| r[contacts.clone()].to_vec()).collect::<Vec<_>>();
            flips += rows(&found).iter().zip(rows(&expected)).filter(|(a, b)| **a != *b).count();
            let error = worst(wide(&found), wide(&expected));
            assert!(error <= tolerance, "{id}: {error:.2e} > {tolerance:.0e}");
            errors = errors.max(error);
            count += 1;
        }
        println!("{part}: {count} clips, worst {errors:.1e}, {flips} contact flips (tolerance {tolerance:.0e})");
    }
}
