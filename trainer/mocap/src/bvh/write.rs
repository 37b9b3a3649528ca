//! Writer of BVH. All numbers have six decimals: a tenth of a micrometre in metres, and less than a micrometre at the
//! end of an arm in degrees.

use std::fmt::Write as _;

use motion::quaternion::{self as quat, Quat};

use super::{Bvh, Channel};

/// Rotations about z, then x, then y, the order that most programs write: R = Rz Rx Ry.
pub const ROTATIONS: [Channel; 3] = [Channel::Rotation(2), Channel::Rotation(0), Channel::Rotation(1)];

impl Bvh {
    /// Serialises the recording as text.
    ///
    /// The text parses to the same nodes, and to values with six decimals.
    pub fn to_text(&self) -> String {
        let mut text = String::from("HIERARCHY\n");
        // Nodes with open braces.
        let mut open: Vec<usize> = vec![];
        for (i, node) in self.nodes.iter().enumerate() {
            while open.last().is_some_and(|last| Some(*last) != node.parent) {
                open.pop();
                text += &format!("{}}}\n", "\t".repeat(open.len()));
            }
            let indent = "\t".repeat(open.len());
            let kind = match (node.end, node.parent) {
                (true, _) => "End Site".to_owned(),
                (false, None) => format!("ROOT {}", node.name),
                (false, Some(_)) => format!("JOINT {}", node.name),
            };
            let offset = node.offset.map(decimals).join(" ");
            text += &format!("{indent}{kind}\n{indent}{{\n{indent}\tOFFSET {offset}\n");
            if !node.end {
                let names: String = node.channels.iter().map(|channel| format!(" {}", channel.name())).collect();
                text += &format!("{indent}\tCHANNELS {}{names}\n", node.channels.len());
            }
            open.push(i);
        }
        while !open.is_empty() {
            open.pop();
            text += &format!("{}}}\n", "\t".repeat(open.len()));
        }
        text += &format!("MOTION\nFrames: {}\nFrame Time: {}\n", self.frames, decimals(self.frame_time));
        for row in self.values.chunks_exact(self.channels().max(1)) {
            for (i, value) in row.iter().enumerate() {
                let blank = if i == 0 { "" } else { " " };
                // Writing to a string cannot fail.
                let _ = write!(text, "{blank}{}", decimals(*value));
            }
            text.push('\n');
        }
        text
    }
}

/// Formats with six decimals, without a sign before zero.
fn decimals(value: f64) -> String {
    let text = format!("{value:.6}");
    if text == "-0.000000" { "0.000000".to_owned() } else { text }
}

/// The three angles of [`ROTATIONS`] in degrees. `before` are those of the frame before: of all equivalent triples the
/// nearest to it is returned, so that curves do not jump. If x is 90 degrees up or down, only the sum of the other two is
/// determined, and z keeps its value.
pub fn angles(rotation: Quat, before: [f64; 3]) -> [f64; 3] {
    let m = quat::to_matrix(rotation);
    // R = Rz Rx Ry. Row 2 is (-cos x sin y, sin x, cos x cos y); column 1 is (-sin z cos x, cos z cos x, sin x).
    let x = m[2][1].clamp(-1.0, 1.0).asin();
    let (z, y) = if m[2][1].abs() < 1.0 - 1e-12 {
        ((-m[0][1]).atan2(m[1][1]), (-m[2][0]).atan2(m[2][2]))
    } else {
        // R is a function of z + y (up) or z - y (down) at the pole.
        let turn = m[1][0].atan2(m[0][0]);
        let z = before[0].to_radians();
        (z, if m[2][1] > 0.0 { turn - z } else { z - turn })
    };
    let near = |angle: f64, before: f64| angle + 360.0 * ((before - angle) / 360.0).round();
    let one = [z, x, y].map(f64::to_degrees);
    let other = [one[0] + 180.0, 180.0 - one[1], one[2] + 180.0];
    let candidates = [one, other].map(|angles| [0, 1, 2].map(|k| near(angles[k], before[k])));
    let distance = |angles: &[f64; 3]| (0..3).map(|k| (angles[k] - before[k]).abs()).sum::<f64>();
    if distance(&candidates[1]) < distance(&candidates[0]) - 1e-9 { candidates[1] } else { candidates[0] }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::bvh::Node;

    #[test]
    fn angles_are_the_rotation_and_do_not_jump() {
        let axes = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let back =
            |a: [f64; 3]| (0..3).fold(quat::IDENTITY, |q, k| quat::mul(q, quat::about(axes[k], a[k].to_radians())));
        let mut before = [0.0; 3];
        for step in 0..2000 {
            let t = f64::from(step) * 0.01;
            let q = back([130.0 * t, 100.0 * (1.3 * t).sin(), -90.0 * t]);
            let found = angles(q, before);
            let apart: f64 = back(found).iter().zip(q).map(|(a, b)| a * b).sum();
            assert!(apart.abs() > 1.0 - 1e-9, "{step}: {found:?}");
            assert!(
                step == 0 || found.iter().zip(before).all(|(a, b)| (a - b).abs() < 30.0),
                "{step}: {before:?} to {found:?}"
            );
            before = found;
        }
        for q in [back([20.0, 90.0, 50.0]), back([20.0, -90.0, 50.0])] {
            let again = back(angles(q, [3.0, 0.0, 0.0]));
            assert!(again.iter().zip(q).map(|(a, b)| a * b).sum::<f64>().abs() > 1.0 - 1e-9);
        }
    }

    #[test]
    fn a_file_reads_back_as_it_was_written() {
        let node = |name: &str, parent: Option<usize>, channels: &[Channel], end: bool| Node {
            name: name.into(),
            parent,
            offset: [1.5, -2.0, 0.25],
            channels: channels.to_vec(),
            end,
        };
        let bvh = Bvh {
            nodes: vec![
                node("root", None, &[Channel::Position(1), Channel::Rotation(0)], false),
                node("left arm", Some(0), &ROTATIONS, false),
                node("left arm_end", Some(1), &[], true),
                node("right", Some(0), &[], false),
                node("hand", Some(3), &ROTATIONS, false),
            ],
            frame_time: 0.05,
            rate: 20.0,
            frames: 2,
            values: (0..16).map(|v| f64::from(v) - 7.5).collect(),
        };
        assert_eq!(Bvh::parse(Path::new("x.bvh"), bvh.to_text().as_bytes()).unwrap(), bvh);
    }
}
