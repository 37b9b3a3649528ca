//! Motion along changed paths: an augmentation for small data. Source: ours. Poses depend little on the shape and
//! length of a path, so one recording can represent the same gait along others.
//!
//! The root gets an additional smooth curvature times its way, and a longer or shorter way; a standing body is not
//! changed. Positions and rotations in the heading frame, heights and contacts stay. The turn and the displacements of
//! joints follow the new path, as if the features were computed from it. Feet slide by the stretching of the way.

use protocol::stage::Augment;

use crate::features;
use crate::random::Stream;
use crate::skeleton::Skeleton;

/// Fastest additional turn, radians per second; a body does not walk along tighter curves.
const FASTEST: f64 = 2.0;
/// Shortest and longest period of the alternating part of the curvature, seconds.
const PERIODS: (f64, f64) = (2.0, 8.0);
/// Smallest and largest factor of the way.
const PACES: (f64, f64) = (0.5, 1.5);

/// A change of a path.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Additional turn of each row, radians.
    turns: Vec<f64>,
    /// Factor of the way of each row.
    pace: f64,
}

impl Change {
    /// Draws a change for `rows` `[L, D]`, which must not be normalised. Half of the curvature's variance is constant
    /// over the motion, half alternates.
    pub fn draw(rows: &[f32], skeleton: &Skeleton, augment: &Augment, draw: &mut Stream) -> Self {
        let spread = augment.bend * std::f64::consts::FRAC_1_SQRT_2;
        let constant = f64::from(draw.normal()) * spread;
        let alternating = f64::from(draw.normal()) * spread;
        let period = draw.range(PERIODS.0, PERIODS.1) * skeleton.fps;
        let phase = draw.uniform();
        let pace = (1.0 + f64::from(draw.normal()) * augment.stretch).clamp(PACES.0, PACES.1);
        let most = FASTEST / skeleton.fps;
        let turn = |(t, row): (usize, &[f32])| {
            let x = f64::from(row[1]);
            let z = f64::from(row[2]);
            let way = (x * x + z * z).sqrt() * pace * skeleton.metres_per_unit;
            // A triangle wave of variance 1: equal on every machine, unlike the sine of a system's library.
            let wave = (2.0 * ((t as f64 / period + phase).fract() * 2.0 - 1.0).abs() - 1.0) * 3.0_f64.sqrt();
            (way * (constant + alternating * wave)).clamp(-most, most)
        };
        Self { turns: rows.chunks_exact(skeleton.features).enumerate().map(turn).collect(), pace }
    }

    /// Applies the change to `rows`. The last row has no next frame and is unchanged.
    ///
    /// # Panics
    /// If it was drawn for another number of rows.
    pub fn apply(&self, rows: &mut [f32], skeleton: &Skeleton) {
        let width = skeleton.features;
        assert_eq!(rows.len(), self.turns.len() * width, "a turn for every row");
        let last = self.turns.len().saturating_sub(1);
        for (row, turn) in rows.chunks_exact_mut(width).zip(&self.turns).take(last) {
            row[0] = (f64::from(row[0]) + turn / 2.0) as f32;
            row[1..3].iter_mut().for_each(|way| *way = (f64::from(*way) * self.pace) as f32);
        }
        features::follow_path(rows, skeleton);
    }
}

/// Changes the path of `rows` by the settings `augment`; does nothing if they are off.
pub fn augment(rows: &mut [f32], skeleton: &Skeleton, augment: &Augment, draw: &mut Stream) {
    if !augment.is_none() {
        Change::draw(rows, skeleton, augment, draw).apply(rows, skeleton);
    }
}

#[cfg(test)]
mod tests {
    use protocol::Seed;
    use protocol::stage::DataSynthetic;

    use super::*;
    use crate::dataset::Entry;
    use crate::features::{recover_joints, recover_joints_wide};
    use crate::quaternion::{self as quat, Vec3};
    use crate::synthetic;

    /// A synthetic walk: rows `[80, D]`.
    fn walk() -> (Vec<f32>, &'static Skeleton) {
        let settings = DataSynthetic { clips: 40, ..DataSynthetic::default() };
        let dataset = synthetic::generate(&settings, Seed(1));
        let walks = |entry: &&Entry| {
            let walks = |caption: &usize| dataset.captions[*caption].text.contains("walks forward");
            entry.captions.iter().any(walks) && entry.start == 0 && entry.len >= 80
        };
        let entry = dataset.entries.iter().find(walks).expect("a walk");
        (dataset.clips[entry.clip].features[..80 * 263].to_vec(), dataset.skeleton())
    }

    #[test]
    fn no_turn_changes_nothing_but_rounding() {
        let (rows, skeleton) = walk();
        let mut same = rows.clone();
        Change { turns: vec![0.0; 80], pace: 1.0 }.apply(&mut same, skeleton);
        let worst = rows.iter().zip(&same).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-4, "{worst}");
    }

    #[test]
    fn a_bent_walk_is_as_long_and_ends_elsewhere_and_its_velocities_are_those_of_its_joints() {
        let (rows, skeleton) = walk();
        let bend = Augment { bend: 1.0, stretch: 0.0 };
        let change = Change::draw(&rows, skeleton, &bend, &mut Stream::new(Seed(4), "bend", 0, 0));
        let turns = &change.turns;
        assert!(turns.iter().any(|turn| turn.abs() > 0.01) && turns.iter().all(|turn| turn.abs() <= 0.1));
        let mut bent = rows.clone();
        change.apply(&mut bent, skeleton);
        let path = |rows: &[f32]| -> Vec<[f64; 2]> {
            recover_joints(rows, skeleton)
                .chunks_exact(66)
                .map(|frame| [f64::from(frame[0]), f64::from(frame[2])])
                .collect()
        };
        let far = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        let length = |path: &[[f64; 2]]| path.windows(2).map(|w| far(w[0], w[1])).sum::<f64>();
        let before = path(&rows);
        let after = path(&bent);
        assert!((length(&before) - length(&after)).abs() < 1e-3);
        assert!(far(before[79], after[79]) > 0.3, "{:?} {:?}", before[79], after[79]);
        // Poses in the heading frame, contacts and heights are the same.
        let layout = skeleton.layout();
        for (a, b) in rows.chunks_exact(263).zip(bent.chunks_exact(263)) {
            assert_eq!(a[1..layout.velocities.start], b[1..layout.velocities.start]);
            assert_eq!(a[layout.contacts.clone()], b[layout.contacts.clone()]);
        }
        // Displacements between two frames, in the heading of the earlier one.
        let joints = recover_joints_wide(&bent, skeleton);
        let heading = features::root_path(&bent, skeleton)[40].0;
        let at = |t: usize, j: usize| -> Vec3 { std::array::from_fn(|axis| joints[t * 66 + 3 * j + axis]) };
        let moved = quat::rotate(heading, quat::sub(at(41, 20), at(40, 20)));
        let row = &bent[40 * 263 + layout.velocities.start + 60..][..3];
        assert!(row.iter().zip(moved).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6), "{row:?} {moved:?}");
    }

    #[test]
    fn a_stretched_walk_is_as_much_longer() {
        let (rows, skeleton) = walk();
        let mut longer = rows.clone();
        Change { turns: vec![0.0; 80], pace: 1.25 }.apply(&mut longer, skeleton);
        let end = |rows: &[f32]| {
            let joints = recover_joints(rows, skeleton);
            f64::from(joints[79 * 66]).hypot(f64::from(joints[79 * 66 + 2]))
        };
        assert!((end(&longer) / end(&rows) - 1.25).abs() < 1e-4, "{} {}", end(&longer), end(&rows));
    }

    #[test]
    fn who_stands_is_left_alone() {
        let (mut rows, skeleton) = walk();
        rows.chunks_exact_mut(263).for_each(|row| row[1..3].fill(0.0));
        let both = Augment { bend: 1.0, stretch: 0.3 };
        let change = Change::draw(&rows, skeleton, &both, &mut Stream::new(Seed(4), "bend", 0, 0));
        assert!(change.turns.iter().all(|turn| *turn == 0.0) && change.pace != 1.0);
    }
}
