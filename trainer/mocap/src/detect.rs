//! Detection of a file's unit and upward axis.
//!
//! The unit is the one in which thigh and shank together are nearest to an adult's 82 cm. The units in use differ by a
//! factor of at least two, so body height does not matter; a small child or a giant needs an explicit unit. Up is the
//! mean direction from the ankles to the neck; the rest pose may correct it ([`crate::take::read`]).

use std::fmt;

use motion::quaternion::{self as quat, Vec3};

/// Thigh and shank of an adult, metres.
const LEG_METRES: f64 = 0.82;
/// Smallest share of the mean vector from ankles to neck along one axis for a standing figure.
const UPRIGHT: f64 = 0.7;

/// Units of files, with their length in metres.
pub const UNITS: [(&str, f64); 6] = [
    ("metre", 1.0),
    ("centimetre", 0.01),
    ("millimetre", 0.001),
    ("inch", 0.0254),
    ("foot", 0.3048),
    // The unit of the CMU database's own files, 1/0.45 inch.
    ("cmu", 0.0254 / 0.45),
];

/// An upward axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Up {
    X,
    Y,
    Z,
    NegativeX,
    NegativeY,
    NegativeZ,
}

impl Up {
    /// All axes with their names.
    pub const WORDS: [(&'static str, Up); 6] =
        [("x", Up::X), ("y", Up::Y), ("z", Up::Z), ("-x", Up::NegativeX), ("-y", Up::NegativeY), ("-z", Up::NegativeZ)];

    /// Parses an axis such as `z` or `-y`.
    pub fn parse(word: &str) -> Option<Self> {
        Self::WORDS.iter().find(|(name, _)| name.eq_ignore_ascii_case(word)).map(|(_, up)| *up)
    }

    /// Rotates a vector of the file to y up; left and right are kept.
    pub fn to_y(self, [x, y, z]: Vec3) -> Vec3 {
        match self {
            Up::Y => [x, y, z],
            Up::Z => [x, z, -y],
            Up::X => [-y, x, z],
            Up::NegativeY => [x, -y, -z],
            Up::NegativeZ => [x, -z, y],
            Up::NegativeX => [y, -x, z],
        }
    }
}

impl fmt::Display for Up {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(Self::WORDS.iter().find(|(_, up)| up == self).map_or("", |(word, _)| word))
    }
}

/// Detected unit and axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Detected {
    /// Name in [`UNITS`].
    pub unit: &'static str,
    /// Length of the unit in metres.
    pub metres_per_unit: f64,
    /// Thigh and shank in the file's unit.
    pub leg: f64,
    pub up: Up,
    /// True if the figure clearly stands along that axis; otherwise `up` is a guess.
    pub sure_of_up: bool,
}

/// Detects from frames of the 22 joints in the file's unit and axes.
pub fn detect<'a>(frames: impl Iterator<Item = &'a [Vec3]>) -> Detected {
    let mut leg = 0.0;
    let mut way = [0.0; 3];
    let mut count = 0.0_f64;
    for joints in frames {
        let length = |a: usize, b: usize| quat::norm(quat::sub(joints[a], joints[b]));
        leg += 0.5 * (length(1, 4) + length(4, 7) + length(2, 5) + length(5, 8));
        let ankles = quat::scale(quat::add(joints[7], joints[8]), 0.5);
        way = quat::add(way, quat::sub(joints[12], ankles));
        count += 1.0;
    }
    let leg = leg / count.max(1.0);
    let apart = |metres: f64| (leg * metres / LEG_METRES).ln().abs();
    let (unit, metres_per_unit) =
        UNITS.into_iter().min_by(|a, b| apart(a.1).total_cmp(&apart(b.1))).unwrap_or(("metre", 1.0));
    let axis = (0..3).fold(1, |best, axis| if way[axis].abs() > way[best].abs() { axis } else { best });
    let (up, down) = [(Up::X, Up::NegativeX), (Up::Y, Up::NegativeY), (Up::Z, Up::NegativeZ)][axis];
    let sure_of_up = way[axis].abs() > UPRIGHT * quat::norm(way);
    Detected { unit, metres_per_unit, leg, up: if way[axis] < 0.0 { down } else { up }, sure_of_up }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_axis_turns_up_without_mirroring() {
        for (word, up) in Up::WORDS {
            assert_eq!(Up::parse(word), Some(up));
            let axis = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|v| up.to_y(v));
            assert!(quat::dot(quat::cross(axis[0], axis[1]), axis[2]) > 0.5, "{word}");
            let sign = if word.starts_with('-') { -1.0 } else { 1.0 };
            let index = ["x", "y", "z"].iter().position(|w| word.ends_with(w)).unwrap();
            assert_eq!(axis[index], [0.0, sign, 0.0], "{word}");
        }
    }

    #[test]
    fn units_are_found_for_short_and_tall_people() {
        for (name, metres) in UNITS {
            for leg in [0.66, 0.82, 1.02] {
                for (up, turn) in [(Up::Y, Up::Y), (Up::Z, Up::NegativeZ)] {
                    let mut joints = vec![[0.0; 3]; 22];
                    let thigh = 0.5 * leg / metres;
                    for side in [0, 1] {
                        joints[1 + side] = [0.0, 2.0 * thigh, 0.0];
                        joints[4 + side] = [0.0, thigh, 0.0];
                    }
                    joints[12] = [0.1 * thigh, 3.0 * thigh, 0.0];
                    let joints: Vec<Vec3> = joints.into_iter().map(|v| turn.to_y(v)).collect();
                    let found = detect(std::iter::once(&joints[..]));
                    assert_eq!((found.unit, found.up, found.sure_of_up), (name, up, true), "{leg}");
                }
            }
        }
    }
}
