//! Foot skating: the frequency of a foot sliding while it is on the ground.
//!
//! Source: the control protocol of MotionLCM and OmniControl. A foot is down in a step if its height is below 5 cm in
//! both frames. It skates if it is down and its horizontal speed is above 0.5 m/s, and so is the mean speed over 5
//! steps (zeros beyond the ends).

use protocol::stage::DataFormat;

const HEIGHT: f64 = 0.05;
const SPEED: f64 = 0.5;
/// Steps on either side of the centre of the moving average.
const REACH: usize = 2;
const AXES: usize = 3;

/// Left and right foot.
pub fn feet(format: DataFormat) -> [usize; 2] {
    match format {
        DataFormat::Humanml3d => [10, 11],
        DataFormat::Kit => [15, 20],
    }
}

/// Share of the steps of a motion `[frames, count, 3]` in metres in which either foot skates; 0 for a single frame.
pub fn ratio(motion: &[f64], count: usize, feet: [usize; 2], fps: f64) -> f64 {
    let frames = motion.len() / (count * AXES);
    let steps = frames.saturating_sub(1);
    let at = |t: usize, j: usize, axis: usize| motion[(t * count + j) * AXES + axis];
    let mut skates = vec![false; steps];
    for foot in feet {
        let moved = |t: usize, axis: usize| at(t + 1, foot, axis) - at(t, foot, axis);
        let speeds: Vec<f64> = (0..steps).map(|t| moved(t, 0).hypot(moved(t, 2)) * fps).collect();
        for (t, skates) in skates.iter_mut().enumerate() {
            let near = &speeds[t.saturating_sub(REACH)..(t + REACH + 1).min(steps)];
            let mean = near.iter().sum::<f64>() / (2 * REACH + 1) as f64;
            let down = at(t, foot, 1) < HEIGHT && at(t + 1, foot, 1) < HEIGHT;
            *skates |= down && speeds[t] > SPEED && mean > SPEED;
        }
    }
    if steps == 0 { 0.0 } else { skates.iter().filter(|s| **s).count() as f64 / steps as f64 }
}
