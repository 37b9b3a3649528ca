//! A recording as the 22 joints of HumanML3D, in metres, y up.

use motion::quaternion::Vec3;

use crate::bvh::Bvh;
use crate::detect::{Detected, Up, detect};
use crate::joint_map::{JointMap, MapError};

/// Number of frames used to detect unit and axis.
const LOOKED_AT: usize = 200;

/// The user's settings for reading files; fields that are `None` are detected.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reading {
    pub map: Option<JointMap>,
    pub metres_per_unit: Option<f64>,
    pub up: Option<Up>,
}

/// A recording converted to HumanML3D's joints.
#[derive(Debug, Clone, PartialEq)]
pub struct Take {
    /// Joints `[T, J, 3]`, metres, y up; left is at +x for a body that faces +z.
    pub joints: Vec<f64>,
    /// Frames per second.
    pub rate: f64,
    /// The upward axis of the file.
    pub up: Up,
    /// The interpretation of the file, for users; equal for files of one kind.
    pub said: String,
}

/// Interpretation of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Read {
    pub map: JointMap,
    /// The built-in map that was proposed; `None` for a user's map or one by shape.
    pub shipped: Option<&'static str>,
    /// Detected unit and axis, used or not.
    pub detected: Detected,
    pub metres_per_unit: f64,
    pub up: Up,
}

/// Detects the interpretation of a file, except for the user's settings.
///
/// # Errors
/// No map fits.
pub fn read(bvh: &Bvh, reading: &Reading) -> Result<Read, MapError> {
    let (map, shipped) = match &reading.map {
        Some(map) => (map.clone(), None),
        None => {
            let proposal = JointMap::propose(bvh)?;
            (proposal.map, proposal.shipped)
        }
    };
    let places = map.resolve(bvh)?;
    let step = bvh.frames.div_ceil(LOOKED_AT).max(1);
    let frames: Vec<Vec<Vec3>> =
        (0..bvh.frames).step_by(step).map(|frame| places.joints(&bvh.placed(frame), 1.0)).collect();
    let mut detected = detect(frames.iter().map(Vec::as_slice));
    let rest = detect(std::iter::once(places.joints(&bvh.rest(), 1.0).as_slice()));
    // A crawling or lying body resembles a body that stands along another axis. A rest pose that stands along y or z
    // decides then. Rest poses with all bones along one axis do not.
    if rest.sure_of_up && matches!(rest.up, Up::Y | Up::Z) && rest.up != detected.up {
        detected.up = rest.up;
        detected.sure_of_up = false;
    }
    let metres_per_unit = reading.metres_per_unit.unwrap_or(detected.metres_per_unit);
    let up = reading.up.unwrap_or(detected.up);
    Ok(Read { map, shipped, detected, metres_per_unit, up })
}

impl Take {
    /// Reads the joints of a file at its own rate.
    ///
    /// # Errors
    /// No map fits, or the given one does not.
    pub fn of_bvh(bvh: &Bvh, reading: &Reading) -> Result<Self, MapError> {
        let how = read(bvh, reading)?;
        let places = how.map.resolve(bvh)?;
        let mut joints = Vec::with_capacity(bvh.frames * 66);
        for frame in 0..bvh.frames {
            let placed = places.joints(&bvh.placed(frame), how.metres_per_unit);
            joints.extend(placed.into_iter().flat_map(|v| how.up.to_y(v)).map(|v| v * how.metres_per_unit));
        }
        Ok(Self { joints, rate: bvh.rate, up: how.up, said: how.in_short() })
    }
}

impl Read {
    /// Summary without properties that differ between recordings of one program.
    fn in_short(&self) -> String {
        let unit = self.detected.unit;
        let unit = if self.metres_per_unit == self.detected.metres_per_unit {
            unit.to_owned()
        } else {
            format!("{} m", self.metres_per_unit)
        };
        format!("joint map `{}`, unit {unit}, {} up", self.map.name, self.up)
    }
}

impl std::fmt::Display for Read {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Detected { unit, metres_per_unit, leg, up, sure_of_up } = &self.detected;
        let how = match self.shipped {
            Some(_) => "fits the names",
            None if self.map.name == "by shape" => "proposed from the skeleton's shape; check it",
            None => "given",
        };
        write!(f, "joint map `{}` ({how}), ", self.map.name)?;
        if self.metres_per_unit == *metres_per_unit {
            write!(f, "unit {unit} (legs of {:.2} m), ", leg * metres_per_unit)?;
        } else {
            let legs = leg * self.metres_per_unit;
            write!(f, "unit {} m as given (legs of {legs:.2} m; {unit} is more likely), ", self.metres_per_unit)?;
        }
        let guess = if *sure_of_up || self.up != *up {
            ""
        } else {
            " (as in the rest pose, or a guess: the figure does not stand)"
        };
        let told = if self.up == *up { "" } else { " as given" };
        write!(f, "{} up{told}{guess}", self.up)
    }
}

/// Resamples frames `[T, width]`: frame k is at k / `to` seconds, interpolated linearly between its neighbours. Nothing
/// is extrapolated after the last frame.
pub fn resample(joints: &[f64], width: usize, from: f64, to: f64) -> Vec<f64> {
    let frames: Vec<&[f64]> = joints.chunks_exact(width).collect();
    let Some(last) = frames.len().checked_sub(1) else { return vec![] };
    // A rate that divides the other one must hit its frames in spite of rounding.
    let count = (last as f64 * to / from + 1e-6).floor() as usize + 1;
    let mut out = Vec::with_capacity(count * width);
    for k in 0..count {
        let time = k as f64 * from / to;
        let first = ((time + 1e-6).floor() as usize).min(last);
        let part = (time - first as f64).max(0.0);
        let next = frames[(first + 1).min(last)];
        if part < 1e-6 {
            out.extend_from_slice(frames[first]);
        } else {
            out.extend(frames[first].iter().zip(next).map(|(a, b)| a + part * (b - a)));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::resample;

    #[test]
    fn frames_are_hit_or_interpolated_and_none_is_made_up() {
        let track: Vec<f64> = (0..61).map(f64::from).collect();
        let expected = |step: f64, n: usize| -> Vec<f64> { (0..n).map(|k| k as f64 * step).collect() };
        assert_eq!(resample(&track, 1, 60.0, 20.0), expected(3.0, 21));
        assert_eq!(resample(&track, 1, 20.0, 20.0), track);
        let close = |a: Vec<f64>, b: Vec<f64>| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
        assert!(close(resample(&track, 1, 30.0, 20.0), expected(1.5, 41)));
        assert!(close(resample(&track, 1, 30.0, 12.5), expected(2.4, 26)));
        assert!(close(resample(&track, 1, 20.0, 30.0), expected(2.0 / 3.0, 91)));
        assert_eq!(resample(&[1.0, 2.0], 2, 30.0, 20.0), [1.0, 2.0]);
        assert!(resample(&[], 1, 30.0, 20.0).is_empty());
    }
}
