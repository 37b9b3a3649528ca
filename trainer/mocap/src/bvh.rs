//! BVH: a skeleton as nested joints, and a row of channel values for each frame.
//!
//! The format has no standard; the reader accepts the files of the common programs. The file is UTF-8 text of two
//! parts.
//!
//! ```text
//! HIERARCHY
//! ROOT name { OFFSET x y z  CHANNELS n channel...  JOINT name { ... }  End Site { OFFSET x y z } }
//! MOTION
//! Frames: T
//! Frame Time: seconds
//! (T lines with a number for each channel, joints in the order of the file)
//! ```
//!
//! Blanks, tabs, blank lines and line ends (LF, CRLF) separate words; braces need none around them. A name is the rest
//! of its line up to a brace, so it may contain blanks. Words of the grammar are read in any case.
//!
//! Meaning, in column vectors and degrees: a joint's rotation is the product of its rotation channels in their order,
//! so that `Zrotation Xrotation Yrotation` is Rz Rx Ry. A position channel replaces that component of `OFFSET`, for any
//! joint. It is in the parent's frame, independent of its place in the list. The file has neither unit nor axes; see
//! [`crate::detect`].
//!
//! Errors name file and line. All limits are checked before memory is allocated: [`MAX_BYTES`], [`MAX_NODES`],
//! [`MAX_DEPTH`], [`MAX_VALUES`], [`MAX_SECONDS`]. A file's number of frames is not trusted; rows are stored as they
//! are read.

mod parse;
mod write;

pub use write::{ROTATIONS, angles};

use std::path::PathBuf;

use motion::DataPath;
use motion::quaternion::{self as quat, Quat, Vec3};

/// Largest size of a file, in bytes.
pub const MAX_BYTES: u64 = 256 << 20;
/// Largest number of joints and end sites of a file.
pub const MAX_NODES: usize = 4_096;
/// Largest nesting of joints.
pub const MAX_DEPTH: usize = 512;
/// Largest product of frames and channels, and of frames and nodes.
pub const MAX_VALUES: usize = 16 << 20;
/// Longest duration of a recording in seconds; it limits the memory of a resampled recording.
pub const MAX_SECONDS: f64 = 3600.0;

/// A file that cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BvhError {
    /// The file system reported an error.
    #[error("{}: {source}", file.display())]
    Io {
        file: PathBuf,
        /// Error of the file system.
        source: std::io::Error,
    },
    /// The text is not BVH, or exceeds a limit.
    #[error("{}:{line}: {what}", file.display())]
    Text {
        file: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// The text found, and the text expected.
        what: String,
    },
}

/// One of a joint's degrees of freedom.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Channel {
    /// Offset along axis 0, 1 or 2, which replaces the component of the rest offset.
    Position(usize),
    /// Rotation about axis 0, 1 or 2, in degrees.
    Rotation(usize),
}

impl Channel {
    /// All six channels with their names in files.
    pub const NAMES: [(&'static str, Channel); 6] = [
        ("Xposition", Channel::Position(0)),
        ("Yposition", Channel::Position(1)),
        ("Zposition", Channel::Position(2)),
        ("Xrotation", Channel::Rotation(0)),
        ("Yrotation", Channel::Rotation(1)),
        ("Zrotation", Channel::Rotation(2)),
    ];

    /// Name in files.
    pub fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(_, channel)| *channel == self).map_or("", |(name, _)| name)
    }
}

/// A joint, or an end site.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    /// Name of the joint. An end site has its joint's name and `_end`.
    pub name: String,
    /// Index of the parent, which is smaller than the node's own; `None` for the root.
    pub parent: Option<usize>,
    /// Offset from the parent, in the parent's frame, for components without a position channel.
    pub offset: Vec3,
    /// Channels in the order of a row; empty for an end site.
    pub channels: Vec<Channel>,
    /// True for an `End Site`.
    pub end: bool,
}

/// A recording in BVH.
#[derive(Debug, Clone, PartialEq)]
pub struct Bvh {
    /// Nodes in the order of the file: parents before children.
    pub nodes: Vec<Node>,
    /// Seconds between frames, as written.
    pub frame_time: f64,
    /// Frames per second: a usual rate whose frame time rounds to the written digits, else `1 / frame_time`.
    pub rate: f64,
    /// Number of frames T.
    pub frames: usize,
    /// Values `[T, channels]`, channels of all nodes in order.
    pub values: Vec<f64>,
}

impl Bvh {
    /// Reads a BVH file.
    ///
    /// # Errors
    /// The defect, with file and line.
    pub fn read(file: &DataPath) -> Result<Self, BvhError> {
        let bytes = file.read(MAX_BYTES).map_err(|source| BvhError::Io { file: file.shown().into(), source })?;
        Self::parse(file.shown(), &bytes)
    }

    /// Number of values in a row.
    pub fn channels(&self) -> usize {
        self.nodes.iter().map(|node| node.channels.len()).sum()
    }

    /// Offset and rotation of each node relative to its parent in a frame, `[nodes]`.
    pub fn pose(&self, frame: usize) -> Vec<(Vec3, Quat)> {
        let channels = self.channels();
        let mut row = self.values[frame * channels..(frame + 1) * channels].iter();
        let mut pose = Vec::with_capacity(self.nodes.len());
        for node in &self.nodes {
            let mut offset = node.offset;
            let mut rotation = quat::IDENTITY;
            for (channel, value) in node.channels.iter().zip(row.by_ref()) {
                match channel {
                    Channel::Position(axis) => offset[*axis] = *value,
                    Channel::Rotation(axis) => {
                        rotation = quat::mul(rotation, quat::about(unit_axis(*axis), value.to_radians()))
                    }
                }
            }
            pose.push((offset, rotation));
        }
        pose
    }

    /// Position of every node in a frame, `[nodes, 3]`, in the file's unit and axes.
    pub fn placed(&self, frame: usize) -> Vec<f64> {
        let mut global: Vec<(Vec3, Quat)> = Vec::with_capacity(self.nodes.len());
        for (node, (offset, rotation)) in self.nodes.iter().zip(self.pose(frame)) {
            global.push(match node.parent.map(|parent| global[parent]) {
                None => (offset, rotation),
                Some((at, turned)) => (quat::add(at, quat::rotate(turned, offset)), quat::mul(turned, rotation)),
            });
        }
        global.iter().flat_map(|(at, _)| *at).collect()
    }

    /// Position of every node without rotation and with the root at its offset, `[nodes, 3]`.
    pub fn rest(&self) -> Vec<f64> {
        let mut at: Vec<Vec3> = Vec::with_capacity(self.nodes.len());
        for node in &self.nodes {
            at.push(node.parent.map_or(node.offset, |parent| quat::add(at[parent], node.offset)));
        }
        at.into_iter().flatten().collect()
    }

    /// [`Bvh::placed`] of all frames, `[T, nodes, 3]`.
    pub fn positions(&self) -> Vec<f64> {
        (0..self.frames).flat_map(|frame| self.placed(frame)).collect()
    }
}

fn unit_axis(axis: usize) -> Vec3 {
    [0, 1, 2].map(|k| if k == axis { 1.0 } else { 0.0 })
}

/// Usual frame rates of recordings. A frame time is printed with few digits, so the rate is the usual one that rounds
/// to it.
const USUAL_RATES: [f64; 32] = [
    5.0,
    6.0,
    8.0,
    10.0,
    12.0,
    12.5,
    15.0,
    20.0,
    24_000.0 / 1001.0,
    24.0,
    25.0,
    30_000.0 / 1001.0,
    30.0,
    40.0,
    48.0,
    50.0,
    60_000.0 / 1001.0,
    60.0,
    72.0,
    75.0,
    80.0,
    90.0,
    100.0,
    120.0,
    144.0,
    150.0,
    180.0,
    200.0,
    240.0,
    300.0,
    480.0,
    500.0,
];

/// The rate for a frame time whose last written digit is worth `digit` seconds.
fn nominal_rate(frame_time: f64, digit: f64) -> f64 {
    let apart = |rate: &f64| (1.0 / rate - frame_time).abs();
    let nearest = USUAL_RATES.into_iter().min_by(|a, b| apart(a).total_cmp(&apart(b)));
    nearest.filter(|rate| apart(rate) <= 0.5001 * digit).unwrap_or(1.0 / frame_time)
}
