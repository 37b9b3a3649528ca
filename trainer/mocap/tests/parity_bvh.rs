//! The BVH fixtures: every `10_bvh*` folder, with any files and sizes.

mod shared;

use motion::DataPath;
use std::path::{Path, PathBuf};

use mocap::bvh::Bvh;
use mocap::joint_map::{JointMap, Source};
use mocap::take::{self, Reading, Take, resample};
use motion::Skeleton;
use protocol::stage::DataFormat;
use serde_json::Value;
use shared::{entries, json, load, worst};

fn folders() -> Vec<PathBuf> {
    let Some(parity) = shared::data("parity") else { return vec![] };
    let found = entries(&parity, |name| name.starts_with("10_bvh"));
    assert!(!found.is_empty(), "no 10_bvh in {}", parity.display());
    found
}

fn read(file: &Path) -> Bvh {
    Bvh::read(&DataPath::local(file)).unwrap_or_else(|e| panic!("{e}"))
}

/// The largest extent of the first frame along an axis, the scale of tolerances.
fn height(positions: &[f64], nodes: usize) -> f64 {
    let of = |axis: usize| {
        let values = || positions[..3 * nodes].iter().skip(axis).step_by(3).copied();
        values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
    };
    (0..3).map(of).fold(0.0, f64::max)
}

fn names(list: &Value) -> Vec<String> {
    list.as_array().expect("a list").iter().map(|name| name.as_str().expect("a name").to_owned()).collect()
}

#[test]
fn positions_of_every_node_and_frame() {
    for folder in folders() {
        let expected = json(&folder.join("expected.json"));
        let files = expected.as_object().expect("files").iter().filter(|(name, _)| name.ends_with(".bvh"));
        let mut cases = 0;
        for (name, expected) in files {
            let bvh = read(&folder.join(name));
            assert_eq!(bvh.frames as u64, expected["frames"].as_u64().unwrap(), "{name}");
            assert_eq!(bvh.channels() as u64, expected["channels"].as_u64().unwrap(), "{name}");
            assert_eq!(bvh.frame_time, expected["frame_time"].as_f64().unwrap(), "{name}");
            let found: Vec<String> = bvh.nodes.iter().map(|node| node.name.clone()).collect();
            assert_eq!(found, names(&expected["nodes"]), "{name}");
            let parents: Vec<i64> = bvh.nodes.iter().map(|node| node.parent.map_or(-1, |p| p as i64)).collect();
            let given: Vec<i64> = expected["parents"].as_array().unwrap().iter().map(|p| p.as_i64().unwrap()).collect();
            assert_eq!(parents, given, "{name}");
            if let Some(fps) = expected["fps"].as_f64() {
                assert_eq!(bvh.rate, fps, "{name}");
            }
            let positions = bvh.positions();
            let height = height(&positions, bvh.nodes.len());
            let error = worst(positions, &load(&folder.join(name.replace(".bvh", "_positions.npy"))).data) / height;
            println!("{name}: {error:.1e} of the height {height:.2}");
            assert!(error <= 1e-5, "{name}: {error:.1e}");
            // Written and read again; angles have six decimals.
            let again = Bvh::parse(Path::new(name), bvh.to_text().as_bytes()).unwrap();
            let given: Vec<f32> = bvh.positions().iter().map(|v| *v as f32).collect();
            let error = worst(again.positions(), &given) / height;
            assert!(error <= 1e-5 && again.rate == bvh.rate, "{name} again: {error:.1e}");
            cases += 1;
        }
        assert!(cases > 0, "{}", folder.display());
    }
}

#[test]
fn broken_files_are_refused_with_file_and_line() {
    for folder in folders() {
        let expected = json(&folder.join("expected.json"));
        let broken = folder.join("broken");
        for (name, case) in expected["broken"].as_object().expect("cases") {
            let must = case["must"].as_str().expect("must");
            match (must, Bvh::read(&DataPath::local(broken.join(name)))) {
                ("read", found) => {
                    let bvh = found.unwrap_or_else(|e| panic!("{e}"));
                    let nodes: Vec<String> = bvh.nodes.iter().map(|node| node.name.clone()).collect();
                    assert_eq!(nodes, names(&expected["broken_readable_nodes"]), "{name}");
                    let positions = bvh.positions();
                    let height = height(&positions, nodes.len());
                    let error = worst(positions, &load(&broken.join("readable_positions.npy")).data) / height;
                    assert!(error <= 1e-5, "{name}: {error:.1e}");
                }
                ("refuse" | "refuse or read", Err(error)) => {
                    let said = error.to_string();
                    println!("{said}");
                    let place = said.split_once(&format!("{name}:")).map(|(_, rest)| rest);
                    assert!(place.is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit())), "{said}");
                }
                ("refuse or read", Ok(bvh)) => assert_eq!(bvh.positions().len(), bvh.frames * bvh.nodes.len() * 3),
                (_, Ok(_)) => panic!("{name} was read: {}", case["what"]),
                (other, _) => panic!("{name}: what is `{other}`?"),
            }
        }
    }
}

/// Recorded motions on the uniform skeleton, whose bones are constant, through our file and back: at most a millimetre.
#[test]
fn our_files_give_the_joints_back() {
    let Some(folder) = shared::data("humanml3d-mini/new_joints") else { return };
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let (mut worst_rig, mut worst_file) = (0.0_f64, 0.0_f64);
    for file in entries(&folder, |name| name.ends_with(".npy")) {
        let joints = load(&file).data;
        let rig = mocap::rig::Rig::fit(&joints, skeleton).unwrap();
        let text = rig.to_bvh(skeleton.fps, 100.0).to_text();
        let bvh = Bvh::parse(&file, text.as_bytes()).unwrap();
        let columns: Vec<usize> =
            skeleton.names.iter().map(|name| bvh.nodes.iter().position(|node| node.name == *name).unwrap()).collect();
        let positions = bvh.positions();
        let back = positions
            .chunks_exact(3 * bvh.nodes.len())
            .flat_map(|frame| columns.iter().flat_map(move |c| (0..3).map(move |k| frame[3 * c + k] / 100.0)));
        worst_rig = worst_rig.max(rig.error);
        worst_file = worst_file.max(worst(back, &joints));
    }
    println!("rotations {worst_rig:.1e} m, through a file {worst_file:.1e} m");
    assert!(worst_rig <= 1e-3 && worst_file <= 1e-3);
}

/// The joints of a file at 20 fps, f64.
fn joints22(bvh: &Bvh, map: Option<JointMap>) -> Vec<f64> {
    let take = Take::of_bvh(bvh, &Reading { map, ..Reading::default() }).expect("well formed");
    resample(&take.joints, 66, take.rate, 20.0)
}

#[test]
fn five_spellings_end_in_the_same_joints() {
    for folder in folders() {
        let (config, expected) = (json(&folder.join("config.json")), json(&folder.join("expected.json")));
        let motion = load(&folder.join("joints22_20fps.npy")).data;
        for name in names(&config["same_motion"]) {
            let bvh = read(&folder.join(&name));
            let case = &expected[&name];
            let how = take::read(&bvh, &Reading::default()).unwrap();
            println!("{name}: {how}");
            assert!(how.shipped.is_some());
            let same = (how.metres_per_unit - case["metres_per_unit"].as_f64().unwrap()).abs() < 1e-12;
            assert!(same && how.detected.unit == case["unit"], "{how}");
            assert_eq!(how.up.to_string(), case["up"].as_str().unwrap());
            for (joint, node) in case["joint_map"].as_object().unwrap() {
                match (node.as_str(), &how.map.joints[joint]) {
                    (Some(node), source) => assert_eq!(*source, Source::Node(node.into()), "{name}: {joint}"),
                    (None, source) => assert!(!matches!(source, Source::Node(_)), "{name}: {joint}"),
                }
            }
            let own = load(&folder.join(name.replace(".bvh", "_joints22_20fps.npy"))).data;
            let found = joints22(&bvh, None);
            let error = worst(found.iter().copied(), &own);
            let interpolated = case["max_abs_difference_to_joints22_20fps"].as_f64().unwrap();
            let off = worst(found, &motion);
            println!("  {error:.1e} m from the file's joints, {off:.1e} m from the motion ({interpolated:.1e} is due)");
            assert!(error <= 1e-4, "{name}: {error:.1e} m");
            assert!(off <= interpolated + 1e-4, "{name}: {off:.1e} m");
        }
    }
}

/// The same files with meaningless names.
#[test]
fn a_skeleton_without_known_names_is_mapped_by_its_shape() {
    for folder in folders() {
        let config = json(&folder.join("config.json"));
        for name in names(&config["same_motion"]) {
            let mut bvh = read(&folder.join(&name));
            let expected = joints22(&bvh, None);
            for (i, node) in bvh.nodes.iter_mut().enumerate() {
                node.name = format!("n{i}");
            }
            let proposal = JointMap::propose(&bvh).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(proposal.shipped, None, "{name}");
            let map = JointMap::parse(Path::new("proposed.yaml"), &proposal.map.to_yaml()).unwrap();
            let found = joints22(&bvh, Some(map));
            let expected: Vec<f32> = expected.iter().map(|v| *v as f32).collect();
            // Spines of two joints have no third joint; all other joints are exact.
            let off = worst(found, &expected);
            println!("{name}: {off:.1e} m");
            assert!(off < 0.1, "{name}: {off} m, {}", proposal.map.to_yaml());
        }
        let mut chain = read(&folder.join("odd.bvh"));
        chain.nodes.iter_mut().enumerate().for_each(|(i, node)| node.name = format!("n{i}"));
        println!("{}", JointMap::propose(&chain).unwrap_err());
    }
}
