//! Jumps of a motion at the junctions of its segments.
//!
//! A boundary lies between two frames. Its jump in velocity is the largest second difference of a joint's position
//! across it, times fps, in m/s. Its jump in acceleration is the largest third difference, times fps^2, in m/s^2. They
//! are the changes of velocity and acceleration within one frame. The largest is over all joints and over the two or
//! three differences across the boundary, which need three frames on either side. A boundary inside real motion has the
//! same two numbers, so a junction is compared with their 99th percentile. Our own measure: MotionLCM shows its
//! junctions and does not measure them.

use std::collections::VecDeque;

/// Number of coordinates of a joint.
const AXES: usize = 3;
/// Number of frames used on either side of a boundary.
pub const SIDE: usize = 3;
/// Number of boundaries kept for a stream: 80 minutes at 20 frames per second.
const MOST: usize = 100_000;

/// Sudden change of a motion from one frame to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jump {
    /// Change of velocity, m/s.
    pub velocity: f64,
    /// Change of acceleration, m/s^2.
    pub acceleration: f64,
}

impl Jump {
    /// Measures the jump in the middle of `window`, `[6, joints, 3]` in metres.
    ///
    /// # Panics
    /// If the window has another number of frames.
    pub fn across(window: &[&[f64]], fps: f64) -> Self {
        assert_eq!(window.len(), 2 * SIDE, "three frames on either side");
        let joints = window[0].len() / AXES;
        let largest = |from: usize, weights: &[f64]| {
            let length = |joint: usize| {
                let of = |axis: usize| -> f64 {
                    weights.iter().enumerate().map(|(k, weight)| weight * window[from + k][joint * AXES + axis]).sum()
                };
                (0..AXES).map(|axis| of(axis).powi(2)).sum::<f64>().sqrt()
            };
            (0..joints).map(length).fold(0.0, f64::max)
        };
        let velocity = (1..=2).map(|from| largest(from, &[1.0, -2.0, 1.0])).fold(0.0, f64::max);
        let acceleration = (0..=2).map(|from| largest(from, &[-1.0, 3.0, -3.0, 1.0])).fold(0.0, f64::max);
        Self { velocity: velocity * fps, acceleration: acceleration * fps * fps }
    }
}

/// The jump at each boundary of a motion `[frames, joints, 3]` in metres with three frames on either side.
pub fn jumps(motion: &[f64], joints: usize, fps: f64) -> Vec<Jump> {
    let frames: Vec<&[f64]> = motion.chunks_exact(joints * AXES).collect();
    frames.windows(2 * SIDE).map(|window| Jump::across(window, fps)).collect()
}

/// The smallest of `values` that is not below the given share of them; `None` without values. Reorders `values`.
pub fn percentile(values: &mut [f64], share: f64) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most as many as there are")]
    let rank = (values.len() as f64 * share).ceil() as usize;
    values.get(rank.clamp(1, values.len().max(1)) - 1).copied()
}

/// The 99th percentile of either kind of jump; `None` without jumps.
pub fn usual(jumps: &[Jump]) -> Option<Jump> {
    let of = |value: fn(&Jump) -> f64| percentile(&mut jumps.iter().map(value).collect::<Vec<_>>(), 0.99);
    Some(Jump { velocity: of(|jump| jump.velocity)?, acceleration: of(|jump| jump.acceleration)? })
}

/// Measures a stream frame by frame, in bounded memory.
#[derive(Debug, Clone)]
pub struct JunctionMeter {
    fps: f64,
    /// The last frames, oldest first.
    window: VecDeque<Vec<f64>>,
    /// For each of them, true for the first frame of a segment.
    first: VecDeque<bool>,
    junctions: Vec<Jump>,
    interior: Vec<Jump>,
}

impl JunctionMeter {
    /// Creates a meter for frames at `fps`.
    pub fn new(fps: f64) -> Self {
        Self { fps, window: VecDeque::new(), first: VecDeque::new(), junctions: Vec::new(), interior: Vec::new() }
    }

    /// Adds the next frame, `[joints, 3]` in metres; `junction` is true if it starts a segment after another one.
    pub fn push(&mut self, frame: &[f64], junction: bool) {
        let mut row = match self.window.len() == 2 * SIDE {
            true => self.window.pop_front().unwrap_or_default(),
            false => Vec::new(),
        };
        row.clear();
        row.extend_from_slice(frame);
        self.window.push_back(row);
        if self.first.len() == 2 * SIDE {
            self.first.pop_front();
        }
        self.first.push_back(junction);
        if self.window.len() < 2 * SIDE {
            return;
        }
        let of = match (self.first[SIDE], self.first.iter().skip(1).any(|first| *first)) {
            (true, _) => &mut self.junctions,
            (false, false) => &mut self.interior,
            (false, true) => return,
        };
        if of.len() < MOST {
            let window: Vec<&[f64]> = self.window.iter().map(Vec::as_slice).collect();
            of.push(Jump::across(&window, self.fps));
        }
    }

    /// Jumps at junctions of segments. A jump is known three frames after its boundary.
    pub fn junctions(&self) -> &[Jump] {
        &self.junctions
    }

    /// Jumps at boundaries whose differences reach across no junction.
    pub fn interior(&self) -> &[Jump] {
        &self.interior
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One joint on a line, 10 frames per second.
    fn on_a_line(x: impl Fn(f64) -> f64, frames: usize) -> Vec<f64> {
        (0..frames).flat_map(|t| [x(t as f64 / 10.0), 0.0, 0.0]).collect()
    }

    #[test]
    fn a_jump_is_a_change_in_one_frame() {
        let steady = jumps(&on_a_line(|t| 2.0 * t, 8), 1, 10.0);
        assert_eq!(steady.len(), 3);
        assert!(steady.iter().all(|jump| jump.velocity < 1e-9 && jump.acceleration < 1e-9));
        // Constant acceleration of 4 m/s^2: velocity changes by 0.4 m/s per frame, acceleration does not change.
        let falls = jumps(&on_a_line(|t| 2.0 * t * t, 8), 1, 10.0);
        assert!(falls.iter().all(|jump| (jump.velocity - 0.4).abs() < 1e-9 && jump.acceleration < 1e-9));
        // It starts at frame 5 with 1 m/s, within one frame. So the acceleration jumps by 10 m/s^2, there and back.
        let starts = jumps(&on_a_line(|t| (t - 0.5).max(0.0), 12), 1, 10.0);
        let velocity: Vec<f64> = starts.iter().map(|jump| (jump.velocity * 1e6).round() / 1e6).collect();
        assert_eq!(velocity, [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0], "at the boundaries 4|5 and 5|6, the third is 2|3");
        assert!((starts[2].acceleration - 10.0).abs() < 1e-9);
        // The joint with the largest jump counts.
        let two: Vec<f64> = (0..6).flat_map(|t| [0.0, 0.0, 0.0, 0.0, f64::from(t).powi(2) * 0.02, 0.0]).collect();
        assert!((jumps(&two, 2, 10.0)[0].velocity - 0.4).abs() < 1e-9);
        assert!(jumps(&two, 2, 10.0).len() == 1 && jumps(&two[..30], 2, 10.0).is_empty());
    }

    #[test]
    fn the_meter_tells_junctions_from_what_is_between() {
        let motion = on_a_line(|t| if t < 0.95 { t } else { t + 1.0 }, 20);
        let mut meter = JunctionMeter::new(10.0);
        for (t, frame) in motion.chunks_exact(3).enumerate() {
            meter.push(frame, t == 10);
        }
        let all = jumps(&motion, 1, 10.0);
        assert_eq!(meter.junctions(), [all[10 - SIDE]]);
        assert!((meter.junctions()[0].velocity - 10.0).abs() < 1e-9, "a metre in a frame");
        // Boundaries whose differences reach across a junction are neither.
        assert_eq!(meter.interior().len(), all.len() - 5);
        assert!(meter.interior().iter().all(|jump| jump.velocity < 1e-9));
        let usual = usual(meter.interior()).unwrap();
        assert!(usual.velocity < 1e-9 && super::usual(&[]).is_none());
    }

    #[test]
    fn a_percentile_is_one_of_the_values() {
        let mut hundred: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(percentile(&mut hundred, 0.99), Some(99.0));
        assert_eq!(percentile(&mut [3.0], 0.99), Some(3.0));
        assert_eq!(percentile(&mut [], 0.99), None);
        assert_eq!(percentile(&mut [1.0, 2.0, 3.0], 0.0), Some(1.0));
    }
}
