//! Motions as binary glTF: a moving skeleton with a figure, so that every viewer shows something.
//!
//! Source: the glTF 2.0 specification (Khronos, ISO/IEC 12113:2022). The file is one scene with a node for each node of
//! the [`Rig`], a skin over them, a mesh that follows it, and one animation. The animation has the root's translation
//! and the rotation of every rotating node, sampled at the motion's frames, linear in between. Metres, y up, facing +z
//! in the rest pose, as glTF requires.
//!
//! The mesh has a spindle for each bone and a ball for the head, each bound to the one node that it moves with. Three
//! materials distinguish left and right. The rest pose is on the floor at the origin.
//!
//! Layout: a header, a chunk of JSON padded with blanks, a chunk of bytes padded with zeros. Every accessor has a view
//! of its own that starts at a multiple of four, so no view needs a stride. Quaternions are (x, y, z, w) and of unit
//! length in f32. Their sign is continuous from frame to frame, so that interpolation takes the short way.

use motion::quaternion::{self as quat, Vec3};
use protocol::printable;
use serde_json::{Value, json};

use crate::body::Side;
use crate::rig::{Rig, RigNode};

const FLOAT: u32 = 5126;
const UNSIGNED_SHORT: u32 = 5123;
const ARRAY_BUFFER: u32 = 34962;

/// Largest number of nodes of a rig: joints are numbered in 16 bits.
const MOST_NODES: usize = 4_096;
/// Largest product of frames and nodes: half a GiB of rotations.
const MOST_ROTATIONS: usize = 32 << 20;

/// Largest distance in metres: f32 still separates a bone's ends by centimetres there, and sums of bones stay finite.
const FARTHEST: f64 = 1e5;

/// Colours of the three sides, sRGB, as in the drawings.
const COLOURS: [(Side, &str, [u8; 3]); 3] = [
    (Side::Middle, "middle", [70, 74, 84]),
    (Side::Left, "left", [36, 110, 200]),
    (Side::Right, "right", [214, 84, 48]),
];

/// Largest thickness of a bone in metres, and as a share of its length.
const THICK: f64 = 0.035;
const THICK_PART: f64 = 0.16;
/// Radius of the head, metres.
const HEAD: f64 = 0.105;

/// A motion that cannot be written as glTF.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GlbError {
    /// Nothing to animate, or more than a skin can hold.
    #[error(
        "the motion has {nodes} nodes and {frames} frames; expected at least one frame, 1 to {MOST_NODES} nodes and at \
         most {MOST_ROTATIONS} rotations"
    )]
    Size {
        /// Number of nodes of the rig.
        nodes: usize,
        /// Number of frames T.
        frames: usize,
    },
    /// Times of frames must be distinct in f32.
    #[error("{frames} frames at {fps} frames per second need times beyond single precision")]
    Times {
        /// Number of frames T.
        frames: usize,
        /// Frames per second.
        fps: f64,
    },
    /// A position or rotation is not finite, or too far away to be drawn.
    #[error("the motion has a number that is not finite, or a position farther than {FARTHEST} m")]
    NotFinite,
}

/// The side in a joint's name.
fn side(name: &str) -> Side {
    let name = name.to_lowercase();
    match (name.contains("left"), name.contains("right")) {
        (true, false) => Side::Left,
        (false, true) => Side::Right,
        _ => Side::Middle,
    }
}

/// Serialises a motion as a `.glb` file. `name` is the animation's name, such as its prompt.
///
/// # Errors
/// If there is nothing to animate, values are not finite, or frames are too close in time.
pub fn to_bytes(rig: &Rig, fps: f64, metres_per_unit: f64, name: &str) -> Result<Vec<u8>, GlbError> {
    let nodes = rig.nodes.len();
    let frames = rig.frames();
    if nodes == 0 || nodes > MOST_NODES || frames == 0 || nodes * frames > MOST_ROTATIONS {
        return Err(GlbError::Size { nodes, frames });
    }
    let offsets = rig.nodes.iter().flat_map(|node| node.offset);
    let numbers = offsets.chain(rig.roots.iter().flatten().copied()).chain(rig.local.iter().flatten().copied());
    if !metres_per_unit.is_finite() || !numbers.into_iter().all(|v| (v * metres_per_unit).abs() <= FARTHEST) {
        return Err(GlbError::NotFinite);
    }
    let times: Vec<f32> = (0..frames).map(|t| (t as f64 / fps) as f32).collect();
    if !times.iter().all(|t| t.is_finite()) || times.windows(2).any(|pair| pair[0] >= pair[1]) {
        return Err(GlbError::Times { frames, fps });
    }

    let rest = rest_pose(&rig.nodes, metres_per_unit);
    let mut file = File::default();
    let binds: Vec<f32> = rest.iter().flat_map(|at| inverse_bind(*at)).collect();
    let binds = file.floats(&binds, 16, "MAT4", None);
    let (primitives, materials) = mesh(rig, &rest, metres_per_unit, &mut file);
    let (channels, samplers) = animation(rig, &times, metres_per_unit, &mut file);

    let mut described: Vec<Value> = rig.nodes.iter().enumerate().map(|(i, _)| node(&rig.nodes, i, &rest)).collect();
    let mut roots = vec![0];
    let mut document = json!({
        "asset": {"version": "2.0", "generator": "stride"},
        "scene": 0,
        "animations": [{"name": printable(name), "channels": channels, "samplers": samplers}],
    });
    // A skeleton without bones has no mesh.
    if !primitives.is_empty() {
        roots.push(nodes);
        described.push(json!({"name": "figure", "mesh": 0, "skin": 0}));
        document["meshes"] = json!([{"name": "figure", "primitives": primitives}]);
        document["materials"] = json!(materials);
        let joints: Vec<usize> = (0..nodes).collect();
        document["skins"] = json!([{"joints": joints, "inverseBindMatrices": binds, "skeleton": 0}]);
    }
    document["nodes"] = json!(described);
    document["scenes"] = json!([{"nodes": roots}]);
    Ok(file.finish(document))
}

/// The primitives of the figure, one for each side and colour, and their materials.
fn mesh(rig: &Rig, rest: &[Vec3], metres_per_unit: f64, file: &mut File) -> (Vec<Value>, Vec<Value>) {
    let mut primitives = Vec::new();
    let mut materials = Vec::new();
    for (side, word, colour) in COLOURS {
        let shape = figure(rig, rest, metres_per_unit, side);
        if shape.positions.is_empty() {
            continue;
        }
        let weights = vec![[1.0_f32, 0.0, 0.0, 0.0]; shape.joints.len()].concat();
        primitives.push(json!({
            "attributes": {
                "POSITION": file.floats(&shape.positions, 3, "VEC3", Some(ARRAY_BUFFER)),
                "NORMAL": file.floats(&shape.normals, 3, "VEC3", Some(ARRAY_BUFFER)),
                "JOINTS_0": file.joints(&shape.joints),
                "WEIGHTS_0": file.floats(&weights, 4, "VEC4", Some(ARRAY_BUFFER)),
            },
            "material": materials.len(),
        }));
        let [r, g, b] = colour.map(linear);
        materials.push(json!({
            "name": word,
            "pbrMetallicRoughness": {"baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8},
        }));
    }
    (primitives, materials)
}

/// A node in the rest pose. The root is placed so that the feet are on the floor.
fn node(nodes: &[RigNode], i: usize, rest: &[Vec3]) -> Value {
    let children: Vec<usize> = (0..nodes.len()).filter(|child| nodes[*child].parent == Some(i)).collect();
    let at = nodes[i].parent.map_or(rest[i], |parent| quat::sub(rest[i], rest[parent]));
    let mut value = json!({"name": printable(&nodes[i].name), "translation": at.map(|v| v as f32)});
    if !children.is_empty() {
        value["children"] = json!(children);
    }
    value
}

/// Positions of the nodes without rotation, metres, the lowest on the floor.
fn rest_pose(nodes: &[RigNode], metres_per_unit: f64) -> Vec<Vec3> {
    let mut rest: Vec<Vec3> = Vec::with_capacity(nodes.len());
    for node in nodes {
        let parent = node.parent.map_or([0.0; 3], |parent| rest[parent]);
        let offset = if node.parent.is_some() { quat::scale(node.offset, metres_per_unit) } else { [0.0; 3] };
        rest.push(quat::add(parent, offset));
    }
    let lowest = rest.iter().map(|at| at[1]).fold(f64::INFINITY, f64::min);
    rest.iter().map(|at| [at[0], at[1] - lowest, at[2]]).collect()
}

/// The matrix from the rest pose to a joint's own frame, by column; there is no rotation at rest.
fn inverse_bind(at: Vec3) -> [f32; 16] {
    let [x, y, z] = at.map(|v| -v as f32);
    [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, y, z, 1.0]
}

/// Converts an sRGB channel to linear light.
fn linear(channel: u8) -> f64 {
    let c = f64::from(channel) / 255.0;
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

/// Channels and samplers of the animation.
fn animation(rig: &Rig, times: &[f32], metres_per_unit: f64, file: &mut File) -> (Vec<Value>, Vec<Value>) {
    let input = file.floats(times, 1, "SCALAR", None);
    let mut channels = Vec::new();
    let mut samplers = Vec::new();
    let mut channel = |node: usize, path: &str, output: usize| {
        channels.push(json!({"sampler": samplers.len(), "target": {"node": node, "path": path}}));
        samplers.push(json!({"input": input, "output": output, "interpolation": "LINEAR"}));
    };
    let roots: Vec<f32> = rig.roots.iter().flat_map(|at| at.map(|v| (v * metres_per_unit) as f32)).collect();
    channel(0, "translation", file.floats(&roots, 3, "VEC3", None));
    for i in 0..rig.nodes.len() {
        let track: Vec<quat::Quat> = rig.local.iter().skip(i).step_by(rig.nodes.len()).copied().collect();
        if track.iter().all(|q| *q == quat::IDENTITY) {
            continue;
        }
        let floats = track.iter().flat_map(|q| {
            let [w, x, y, z] = quat::normalise(*q);
            [x, y, z, w].map(|v| v as f32)
        });
        channel(i, "rotation", file.floats(&floats.collect::<Vec<_>>(), 4, "VEC4", None));
    }
    (channels, samplers)
}

/// Triangles; each corner has a normal and the node that it moves with.
#[derive(Debug, Default)]
struct Shape {
    positions: Vec<f32>,
    normals: Vec<f32>,
    joints: Vec<u16>,
}

impl Shape {
    fn corner(&mut self, at: Vec3, normal: Vec3, joint: usize) {
        self.positions.extend(at.map(|v| v as f32));
        self.normals.extend(normal.map(|v| v as f32));
        self.joints.push(u16::try_from(joint).expect("fewer nodes than MOST_NODES"));
    }

    /// Adds a spindle from `a` to `b`, thickest near `a`.
    fn spindle(&mut self, a: Vec3, b: Vec3, joint: usize) {
        let along = quat::sub(b, a);
        let length = quat::norm(along);
        if length < 1e-6 {
            return;
        }
        let axis = quat::unit(along);
        let helper = if axis[1].abs() < 0.9 { [0.0, 1.0, 0.0] } else { [1.0, 0.0, 0.0] };
        let u = quat::unit(quat::cross(axis, helper));
        let v = quat::cross(axis, u);
        let radius = THICK.min(THICK_PART * length);
        let waist = quat::add(a, quat::scale(along, 0.18));
        let ring = [u, v, quat::scale(u, -1.0), quat::scale(v, -1.0)].map(|r| quat::add(waist, quat::scale(r, radius)));
        for k in 0..4 {
            let p = ring[k];
            let q = ring[(k + 1) % 4];
            // Counter-clockwise from outside: the ring turns from u to v about the axis.
            self.flat([b, p, q], joint);
            self.flat([a, q, p], joint);
        }
    }

    fn flat(&mut self, corners: [Vec3; 3], joint: usize) {
        let [a, b, c] = corners;
        let normal = quat::unit(quat::cross(quat::sub(b, a), quat::sub(c, a)));
        corners.iter().for_each(|at| self.corner(*at, normal, joint));
    }

    /// Adds a ball: the octahedron with its faces divided twice.
    fn ball(&mut self, centre: Vec3, radius: f64, joint: usize) {
        let mut faces: Vec<[Vec3; 3]> = Vec::new();
        for sign in 0..8 {
            let [x, y, z] = [0, 1, 2].map(|k| if sign >> k & 1 == 0 { 1.0 } else { -1.0 });
            let a = [x, 0.0, 0.0];
            let b = [0.0, y, 0.0];
            let c = [0.0, 0.0, z];
            faces.push(if x * y * z > 0.0 { [a, b, c] } else { [a, c, b] });
        }
        let middle = |a: Vec3, b: Vec3| quat::unit(quat::add(a, b));
        for _ in 0..2 {
            let four = |[a, b, c]: [Vec3; 3]| {
                let d = middle(a, b);
                let e = middle(b, c);
                let f = middle(c, a);
                [[a, d, f], [d, b, e], [f, e, c], [d, e, f]]
            };
            faces = faces.into_iter().flat_map(four).collect();
        }
        for normal in faces.into_flattened() {
            self.corner(quat::add(centre, quat::scale(normal, radius)), normal, joint);
        }
    }
}

/// The bones of one side in the rest pose; the middle also has the head.
fn figure(rig: &Rig, rest: &[Vec3], metres_per_unit: f64, wanted: Side) -> Shape {
    let mut shape = Shape::default();
    for (i, node) in rig.nodes.iter().enumerate() {
        if let (Some(parent), true) = (node.parent, side(&node.name) == wanted) {
            shape.spindle(rest[parent], rest[i], parent);
        }
    }
    for (i, offset) in rig.ends().into_iter().filter(|(i, _)| side(&rig.nodes[*i].name) == wanted) {
        let end = quat::add(rest[i], quat::scale(offset, metres_per_unit));
        if wanted == Side::Middle && rig.nodes[i].parent.is_some() {
            shape.ball(end, HEAD, i);
        } else {
            shape.spindle(rest[i], end, i);
        }
    }
    shape
}

/// A file in progress.
#[derive(Debug, Default)]
struct File {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl File {
    /// Adds a view for `bytes`; the next one starts at a multiple of four.
    fn view(&mut self, bytes: impl Iterator<Item = u8>, target: Option<u32>) -> usize {
        let begin = self.bytes.len();
        self.bytes.extend(bytes);
        let mut view = json!({"buffer": 0, "byteOffset": begin, "byteLength": self.bytes.len() - begin});
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(view);
        self.views.len() - 1
    }

    /// Adds an accessor of elements of `width` numbers, with their bounds.
    fn floats(&mut self, values: &[f32], width: usize, kind: &str, target: Option<u32>) -> usize {
        let bound = |k: usize, pick: fn(f32, f32) -> f32| {
            // As doubles, so that the text has every digit of the f32.
            f64::from(values.iter().skip(k).step_by(width).copied().reduce(pick).unwrap_or_default())
        };
        let bounds = |pick: fn(f32, f32) -> f32| (0..width).map(|k| bound(k, pick)).collect::<Vec<_>>();
        let view = self.view(values.iter().flat_map(|v| v.to_le_bytes()), target);
        self.accessors.push(json!({
            "bufferView": view,
            "componentType": FLOAT,
            "count": values.len() / width,
            "type": kind,
            "min": bounds(f32::min),
            "max": bounds(f32::max),
        }));
        self.accessors.len() - 1
    }

    /// Adds an accessor of the node that each corner follows; the three others have no weight.
    fn joints(&mut self, joints: &[u16]) -> usize {
        let four = joints.iter().flat_map(|joint| [*joint, 0, 0, 0]);
        let view = self.view(four.flat_map(u16::to_le_bytes), Some(ARRAY_BUFFER));
        self.accessors.push(json!({
            "bufferView": view,
            "componentType": UNSIGNED_SHORT,
            "count": joints.len(),
            "type": "VEC4",
        }));
        self.accessors.len() - 1
    }

    /// Assembles header and both chunks.
    fn finish(self, mut document: Value) -> Vec<u8> {
        document["accessors"] = json!(self.accessors);
        document["bufferViews"] = json!(self.views);
        document["buffers"] = json!([{"byteLength": self.bytes.len()}]);
        let mut text = document.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let length = 12 + 8 + text.len() + 8 + self.bytes.len();
        let word = |n: usize| u32::try_from(n).expect("a motion of less than 4 GiB").to_le_bytes();
        let mut file = Vec::with_capacity(length);
        file.extend(b"glTF");
        file.extend(2_u32.to_le_bytes());
        file.extend(word(length));
        file.extend(word(text.len()));
        file.extend(b"JSON");
        file.extend(text);
        file.extend(word(self.bytes.len()));
        file.extend(b"BIN\0");
        file.extend(self.bytes);
        file
    }
}
