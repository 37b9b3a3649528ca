//! Placement of a clip in the world, and the transition of its joints into the next clip.
//!
//! A clip of HumanML3D's features starts above the origin and faces z, for any clip before it. A longer motion consists
//! of clips, each placed at the end of the one before it: turned about the vertical and shifted on the floor. Heights
//! stay.
//!
//! [`Fade`] removes the remaining difference of two clips at their junction. Source of the idea: inertialization
//! (Bollo, "Inertialization: High-Performance Animation Transitions in Gears of War", GDC 2018), a quintic of each
//! coordinate's offset that starts with its value, velocity and acceleration and ends at rest. Departs: the last three
//! frames before the junction define the three. So differences of frames stay continuous and not only derivatives. The
//! offset on the way is not clamped.

use crate::quaternion::{self as quat, Quat, Vec3};

/// A turn about the vertical and a shift on the floor.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Placement {
    /// Half the turn from the world to the clip, radians, like the sum of the yaw features.
    angle: f64,
    x: f64,
    z: f64,
}

impl Placement {
    /// The placement of a clip that starts at frame `(heading, root)` of a clip with this placement, both from
    /// [`root_path`](crate::features::root_path).
    #[must_use]
    pub fn of_frame(self, heading: Quat, root: Vec3) -> Self {
        let [x, _, z] = self.to_world(root);
        Self { angle: self.angle + heading[2].atan2(heading[0]), x, z }
    }

    /// The placement in which frame `(heading, root)` of a clip has this placement's heading and ground point.
    #[must_use]
    pub fn with_frame(self, heading: Quat, root: Vec3) -> Self {
        let turned = Self { angle: self.angle - heading[2].atan2(heading[0]), x: 0.0, z: 0.0 };
        let [x, _, z] = turned.to_world(root);
        Self { x: self.x - x, z: self.z - z, ..turned }
    }

    /// The placement with its origin below `point` of the world.
    #[must_use]
    pub fn below(self, point: Vec3) -> Self {
        Self { x: point[0], z: point[2], ..self }
    }

    /// Converts a point of the clip to the world.
    pub fn to_world(self, point: Vec3) -> Vec3 {
        let turned = quat::rotate(quat::inverse(self.turn()), point);
        [turned[0] + self.x, turned[1], turned[2] + self.z]
    }

    /// Converts a point of the world to the clip.
    pub fn to_clip(self, point: Vec3) -> Vec3 {
        quat::rotate(self.turn(), [point[0] - self.x, point[1], point[2] - self.z])
    }

    fn turn(self) -> Quat {
        let (sin, cos) = self.angle.sin_cos();
        [cos, 0.0, sin, 0.0]
    }
}

/// Number of frames before a junction whose offsets count.
pub const BEFORE: usize = 3;

/// Weights by which offsets fade to zero over a number of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fade {
    frames: usize,
}

impl Fade {
    /// A fade over `frames` frames, with zero offset after them.
    pub fn over(frames: usize) -> Self {
        Self { frames }
    }

    /// The remaining share of each of the offsets 0, 1 and 2 frames before the junction, `k` frames after it (the first
    /// frame has k = 1). It is the value at k of the quintic through those three, and through zero at the end of the
    /// fade and the two frames that follow. After that it is 0.
    pub fn weights(self, k: usize) -> [f64; BEFORE] {
        if k > self.frames {
            return [0.0; BEFORE];
        }
        let end = self.frames as f64 + 1.0;
        let nodes = [0.0, -1.0, -2.0, end, end + 1.0, end + 2.0];
        let at = k as f64;
        [0, 1, 2].map(|i| {
            let others = nodes.iter().enumerate().filter(|(j, _)| *j != i);
            others.map(|(_, node)| (at - node) / (nodes[i] - node)).product()
        })
    }
}

#[cfg(test)]
mod tests {
    use protocol::Seed;
    use protocol::stage::DataFormat;

    use super::*;
    use crate::features::{recover_joints_wide, root_path};
    use crate::{Skeleton, Stream};

    /// A body that walks in curves.
    fn rows(frames: usize) -> Vec<f32> {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let mut draw = Stream::new(Seed(5), "placement", 0, 0);
        let mut rows = vec![0.0; frames * skeleton.features];
        draw.fill_normal(&mut rows);
        for row in rows.chunks_exact_mut(skeleton.features) {
            row[..3].iter_mut().for_each(|v| *v *= 0.1);
        }
        rows
    }

    #[test]
    fn a_clip_cut_in_two_and_placed_again_is_whole() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let rows = rows(12);
        let at = 5;
        let whole = recover_joints_wide(&rows, skeleton);
        let (heading, root) = root_path(&rows, skeleton)[at];
        let place = Placement::default().of_frame(heading, root);
        let rest = recover_joints_wide(&rows[at * skeleton.features..], skeleton);
        let width = 3 * skeleton.joints;
        for (expected, local) in whole[at * width..].chunks_exact(3).zip(rest.chunks_exact(3)) {
            let local = [local[0], local[1], local[2]];
            let world = place.to_world(local);
            let back = place.to_clip(world);
            for axis in 0..3 {
                assert!((world[axis] - expected[axis]).abs() < 1e-9, "{world:?} against {expected:?}");
                assert!((back[axis] - local[axis]).abs() < 1e-9);
            }
        }
        // The placement of a frame of a placed clip.
        let (heading, root) = root_path(&rows[at * skeleton.features..], skeleton)[3];
        let twice = place.of_frame(heading, root);
        let (heading, root) = root_path(&rows, skeleton)[at + 3];
        let once = Placement::default().of_frame(heading, root);
        assert!((twice.x - once.x).abs() < 1e-9 && (twice.angle - once.angle).abs() < 1e-9);
        let back = once.with_frame(heading, root);
        assert!(back.x.abs() < 1e-9 && back.z.abs() < 1e-9 && back.angle.abs() < 1e-9, "and back: {back:?}");
        assert_eq!(once.below([7.0, 1.0, 8.0]).to_world([0.0; 3]), [7.0, 0.0, 8.0]);
    }

    #[test]
    fn an_offset_fades_without_a_jump_of_its_differences() {
        let fade = Fade::over(10);
        // Offsets of a body that moves on a line, at k = 0, -1, -2.
        let before = [0.30, 0.28, 0.26];
        let value = |k: i32| match k {
            ..=0 => before.get(k.unsigned_abs() as usize).copied().unwrap_or(0.24),
            _ => fade.weights(k as usize).iter().zip(before).map(|(w, e)| w * e).sum::<f64>(),
        };
        let second = |k: i32| value(k + 1) - 2.0 * value(k) + value(k - 1);
        for k in -1..=11 {
            assert!(second(k).abs() < 0.03, "{k}: {}", second(k));
        }
        assert!((second(0) - second(-1)).abs() < 0.03, "{} and {}", second(0), second(-1));
        assert_eq!((fade.weights(11), fade.weights(400)), ([0.0; 3], [0.0; 3]));
        assert!(value(10).abs() < 0.01 && value(5).abs() < 0.3);
        assert_eq!(Fade::over(0).weights(1), [0.0; 3], "no frames, no fade");
    }
}
