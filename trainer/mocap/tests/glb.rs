//! A `.glb` file read by an independent reader: it follows the specification's rules that a validator checks, and its
//! joints are the rig's.

use std::collections::BTreeSet;

use mocap::glb::{self, GlbError};
use mocap::rig::Rig;
use motion::quaternion as quat;
use motion::{Skeleton, features, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};
use serde_json::Value;

fn number(bytes: &[u8]) -> usize {
    u32::from_le_bytes(bytes.try_into().expect("well formed")) as usize
}

fn index(value: &Value) -> usize {
    usize::try_from(value.as_u64().unwrap_or_else(|| panic!("{value} is no index"))).expect("well formed")
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// A parsed file.
struct Gltf {
    document: Value,
    bytes: Vec<u8>,
}

impl Gltf {
    fn open(file: &[u8]) -> Self {
        assert_eq!(&file[..4], b"glTF");
        assert_eq!((number(&file[4..8]), number(&file[8..12])), (2, file.len()));
        let text = number(&file[12..16]);
        assert_eq!(&file[16..20], b"JSON");
        assert_eq!(text % 4, 0, "chunks end at multiples of four");
        let document = serde_json::from_slice(&file[20..20 + text]).expect("well formed");
        let rest = &file[20 + text..];
        assert_eq!((number(&rest[..4]), &rest[4..8]), (rest.len() - 8, &b"BIN\0"[..]));
        assert_eq!(rest.len() % 4, 0);
        Self { document, bytes: rest[8..].to_vec() }
    }

    /// The values of an accessor, and the number per element.
    fn numbers(&self, accessor: usize) -> (Vec<f64>, usize) {
        let accessor = &self.document["accessors"][accessor];
        let view = &self.document["bufferViews"][index(&accessor["bufferView"])];
        let (begin, length) = (index(&view["byteOffset"]), index(&view["byteLength"]));
        let bytes = &self.bytes[begin..begin + length];
        let width = match accessor["type"].as_str().expect("well formed") {
            "SCALAR" => 1,
            "VEC3" => 3,
            "VEC4" => 4,
            "MAT4" => 16,
            other => panic!("type {other}"),
        };
        let values: Vec<f64> = match index(&accessor["componentType"]) {
            5126 => bytes
                .chunks_exact(4)
                .map(|b| f64::from(f32::from_le_bytes(b.try_into().expect("well formed"))))
                .collect(),
            5123 => bytes
                .chunks_exact(2)
                .map(|b| f64::from(u16::from_le_bytes(b.try_into().expect("well formed"))))
                .collect(),
            other => panic!("component type {other}"),
        };
        assert_eq!(values.len(), width * index(&accessor["count"]), "a view is as long as its accessor");
        (values, width)
    }

    /// Checks the rules for every file.
    fn check(&self) {
        let document = &self.document;
        assert_eq!(document["asset"]["version"], "2.0");
        assert_eq!(index(&document["buffers"][0]["byteLength"]), self.bytes.len());
        let mut used = BTreeSet::new();
        for view in list(&document["bufferViews"]) {
            assert_eq!(index(&view["byteOffset"]) % 4, 0);
            assert!(index(&view["byteOffset"]) + index(&view["byteLength"]) <= self.bytes.len());
        }
        for (i, accessor) in list(&document["accessors"]).iter().enumerate() {
            assert!(used.insert(index(&accessor["bufferView"])), "a view for each, which so needs no stride");
            let (values, width) = self.numbers(i);
            assert!(values.iter().all(|v| v.is_finite()));
            for (bound, pick) in [("min", f64::min as fn(f64, f64) -> f64), ("max", f64::max)] {
                for (k, said) in list(&accessor[bound]).iter().enumerate() {
                    let found = values.iter().skip(k).step_by(width).copied().reduce(pick).expect("well formed");
                    assert!(said.as_f64() == Some(found), "accessor {i}: {bound} is {said}, not {found}");
                }
            }
        }
        assert_eq!(used.len(), list(&document["bufferViews"]).len(), "no view is left over");

        let nodes = list(&document["nodes"]);
        let mut parents = vec![None; nodes.len()];
        for (i, node) in nodes.iter().enumerate() {
            for child in list(&node["children"]) {
                assert_eq!(parents[index(child)].replace(i), None, "one parent each");
            }
        }
        let roots: Vec<usize> = list(&document["scenes"][0]["nodes"]).iter().map(index).collect();
        let orphans: Vec<usize> = (0..nodes.len()).filter(|i| parents[*i].is_none()).collect();
        assert_eq!(roots, orphans, "every tree is in the scene");
        self.check_figure();
        self.check_animation();
    }

    fn check_figure(&self) {
        let document = &self.document;
        let joints = list(&document["skins"][0]["joints"]);
        let figure = list(&document["nodes"]).iter().find(|node| node.get("mesh").is_some()).expect("well formed");
        assert!(figure.get("skin").is_some() && figure.get("translation").is_none());
        let binds = self.numbers(index(&document["skins"][0]["inverseBindMatrices"])).0;
        assert_eq!(binds.len(), 16 * joints.len());
        assert!(binds.chunks(16).all(|m| m[3] == 0.0 && m[7] == 0.0 && m[11] == 0.0 && m[15] == 1.0));
        for primitive in list(&document["meshes"][0]["primitives"]) {
            assert!(index(&primitive["material"]) < list(&document["materials"]).len());
            let attribute = |name: &str| {
                let at = index(&primitive["attributes"][name]);
                let view = &document["bufferViews"][index(&document["accessors"][at]["bufferView"])];
                assert_eq!(view["target"], 34962);
                (self.numbers(at).0, document["accessors"][at].clone())
            };
            let (positions, said) = attribute("POSITION");
            assert!(said.get("min").is_some() && said.get("max").is_some(), "positions have bounds");
            let corners = positions.len() / 3;
            assert!(corners > 0 && corners.is_multiple_of(3), "whole triangles");
            let (normals, _) = attribute("NORMAL");
            for (normal, face) in normals.chunks(9).zip(positions.chunks(9)) {
                let at = |k: usize| [face[3 * k], face[3 * k + 1], face[3 * k + 2]];
                let turned = quat::cross(quat::sub(at(1), at(0)), quat::sub(at(2), at(0)));
                for n in normal.chunks(3) {
                    let n = [n[0], n[1], n[2]];
                    assert!((quat::norm(n) - 1.0).abs() < 5e-4);
                    assert!(quat::dot(n, turned) > 0.0, "faces are seen from outside");
                }
            }
            let (bound, _) = attribute("JOINTS_0");
            let (weights, _) = attribute("WEIGHTS_0");
            assert_eq!((normals.len(), bound.len(), weights.len()), (3 * corners, 4 * corners, 4 * corners));
            for (joint, weight) in bound.chunks(4).zip(weights.chunks(4)) {
                assert!((weight.iter().sum::<f64>() - 1.0).abs() < 1e-6);
                assert!(joint.iter().all(|j| (*j as usize) < joints.len()));
                assert!(joint.iter().zip(weight).all(|(j, w)| *w > 0.0 || *j == 0.0));
            }
        }
    }

    fn check_animation(&self) {
        let animation = &self.document["animations"][0];
        let mut targets = BTreeSet::new();
        for channel in list(&animation["channels"]) {
            let (node, path) =
                (index(&channel["target"]["node"]), channel["target"]["path"].as_str().expect("well formed"));
            assert!(targets.insert((node, path)), "one channel for each");
            let sampler = &animation["samplers"][index(&channel["sampler"])];
            let input = index(&sampler["input"]);
            let said = &self.document["accessors"][input];
            assert!(said.get("min").is_some() && said.get("max").is_some(), "times have bounds");
            let (times, _) = self.numbers(input);
            assert!(times[0] >= 0.0 && times.windows(2).all(|pair| pair[0] < pair[1]), "times grow");
            let (values, width) = self.numbers(index(&sampler["output"]));
            assert_eq!((values.len(), width), (times.len() * width, if path == "rotation" { 4 } else { 3 }));
            if path == "rotation" {
                let length = |q: &[f64]| q.iter().map(|v| v * v).sum::<f64>().sqrt();
                assert!(values.chunks(4).all(|q| (length(q) - 1.0).abs() < 1e-6), "rotations have length 1");
            }
        }
        assert_eq!(list(&animation["samplers"]).len(), targets.len());
    }

    /// Position of each node in frame `t`.
    fn pose(&self, t: usize) -> Vec<quat::Vec3> {
        let nodes = list(&self.document["nodes"]);
        let mut local: Vec<(quat::Vec3, quat::Quat)> = nodes
            .iter()
            .map(|node| {
                let at = list(&node["translation"]);
                (std::array::from_fn(|k| at.get(k).map_or(0.0, |v| v.as_f64().expect("well formed"))), quat::IDENTITY)
            })
            .collect();
        let animation = &self.document["animations"][0];
        for channel in list(&animation["channels"]) {
            let sampler = &animation["samplers"][index(&channel["sampler"])];
            let (values, width) = self.numbers(index(&sampler["output"]));
            let value = &values[t * width..(t + 1) * width];
            let (at, rotation) = &mut local[index(&channel["target"]["node"])];
            match value {
                [x, y, z] => *at = [*x, *y, *z],
                [x, y, z, w] => *rotation = [*w, *x, *y, *z],
                _ => panic!("{width} numbers"),
            }
        }
        let mut global = vec![None; nodes.len()];
        let mut next: Vec<(usize, quat::Vec3, quat::Quat)> =
            list(&self.document["scenes"][0]["nodes"]).iter().map(|i| (index(i), [0.0; 3], quat::IDENTITY)).collect();
        while let Some((i, at, turned)) = next.pop() {
            let place = quat::add(at, quat::rotate(turned, local[i].0));
            global[i] = Some(place);
            let turned = quat::mul(turned, local[i].1);
            next.extend(list(&nodes[i]["children"]).iter().map(|child| (index(child), place, turned)));
        }
        global.into_iter().map(|place| place.expect("every node is in the scene")).collect()
    }
}

/// Clips of every kind of movement.
fn clips() -> Vec<(String, Vec<f32>)> {
    let dataset = synthetic::generate(&DataSynthetic { clips: 28, ..DataSynthetic::default() }, Seed(7));
    let caption = |clip: usize| {
        let entry = dataset.entries.iter().find(|entry| entry.clip == clip).expect("well formed");
        dataset.captions[entry.captions[0]].text.clone()
    };
    let joints = |clip: usize| features::recover_joints(&dataset.clips[clip].features, dataset.skeleton());
    (0..28).step_by(4).map(|clip| (caption(clip), joints(clip))).collect()
}

#[test]
fn a_file_keeps_the_rules_and_the_joints() {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let mut worst = 0.0_f64;
    for (caption, joints) in clips() {
        let rig = Rig::fit(&joints, skeleton).unwrap();
        let file = Gltf::open(&glb::to_bytes(&rig, skeleton.fps, 1.0, &caption).unwrap());
        file.check();
        assert_eq!(file.document["animations"][0]["name"], caption);
        let names = list(&file.document["nodes"]).iter().map(|node| node["name"].as_str().unwrap());
        let names: Vec<&str> = names.collect();
        let placed = rig.joints(skeleton.joints);
        for (t, frame) in placed.chunks_exact(3 * skeleton.joints).enumerate().step_by(9) {
            let pose = file.pose(t);
            for (joint, at) in frame.chunks_exact(3).enumerate() {
                let node = names.iter().position(|name| *name == skeleton.names[joint]).unwrap();
                worst = worst.max(quat::norm(quat::sub(pose[node], [at[0], at[1], at[2]])));
            }
        }
    }
    println!("farthest from the rig: {worst:.1e} m");
    assert!(worst < 1e-5, "{worst} m");
}

#[test]
fn a_body_in_other_units_and_a_hostile_name() {
    let skeleton = Skeleton::of(DataFormat::Kit);
    let joints: Vec<f32> = (0..3)
        .flat_map(|t| {
            skeleton
                .directions
                .iter()
                .enumerate()
                .flat_map(move |(j, d)| [0, 1, 2].map(|k| (100.0 * d[k] * j as f64) as f32 + t as f32))
        })
        .collect();
    let rig = Rig::fit(&joints, skeleton).unwrap();
    let name = "</script>\"\\ \u{1b}[2J 走";
    let file = Gltf::open(&glb::to_bytes(&rig, 12.5, skeleton.metres_per_unit, name).unwrap());
    file.check();
    assert_eq!(file.document["animations"][0]["name"], "</script>\"\\ \\u001b[2J 走");
    let root = file.pose(2)[0];
    let expected = rig.roots[2].map(|v| v * skeleton.metres_per_unit);
    assert!(quat::norm(quat::sub(root, expected)) < 1e-6, "{root:?}, {expected:?}");
}

#[test]
fn what_cannot_be_animated_is_refused() {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let (_, joints) = &clips()[0];
    let rig = Rig::fit(&joints[..5 * 66], skeleton).unwrap();
    for fps in [0.0, f64::NAN, f64::INFINITY, 1e300] {
        assert!(matches!(glb::to_bytes(&rig, fps, 1.0, ""), Err(GlbError::Times { frames: 5, .. })), "{fps}");
    }
    let mut broken = rig.clone();
    broken.roots[2][1] = f64::NAN;
    assert_eq!(glb::to_bytes(&broken, 20.0, 1.0, ""), Err(GlbError::NotFinite));
    let empty = Rig { nodes: vec![], roots: vec![], local: vec![], error: 0.0 };
    assert!(matches!(glb::to_bytes(&empty, 20.0, 1.0, ""), Err(GlbError::Size { nodes: 0, frames: 0 })));
    let point =
        Rig { nodes: rig.nodes[..1].to_vec(), roots: rig.roots.clone(), local: vec![quat::IDENTITY; 5], error: 0.0 };
    let file = Gltf::open(&glb::to_bytes(&point, 20.0, 1.0, "a point").unwrap());
    assert!(file.document.get("skins").is_none() && list(&file.document["nodes"]).len() == 1);
}
