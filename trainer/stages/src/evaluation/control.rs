//! How far a controlled motion is from the positions that it was told to pass.
//!
//! Source: OmniControl and MotionLCM. The error of a told (frame, joint) is the distance to its position. Trajectory error: the motion
//! has one above the threshold. Location error: the share of those above it. Average error: their mean.

const AXES: usize = 3;

/// Errors of one motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlErrors {
    /// 1 if any told position is missed by more than the threshold, else 0.
    pub trajectory: f64,
    /// Share of told positions missed by more than the threshold.
    pub location: f64,
    /// Mean distance.
    pub average: f64,
}

impl ControlErrors {
    /// Of a motion against a hint of its shape, `[.., 3]` both; `told` says of which positions the hint speaks. `None` if of none.
    ///
    /// # Panics
    /// If the shapes differ.
    pub fn of(motion: &[f64], hint: &[f64], told: &[bool], threshold: f64) -> Option<Self> {
        assert!(motion.len() == hint.len() && told.len() * AXES == hint.len(), "a hint has its motion's shape");
        let distance = |i: usize| {
            let at = i * AXES..(i + 1) * AXES;
            motion[at.clone()].iter().zip(&hint[at]).map(|(m, h)| (m - h).powi(2)).sum::<f64>().sqrt()
        };
        let errors: Vec<f64> = (0..told.len()).filter(|i| told[*i]).map(distance).collect();
        if errors.is_empty() {
            return None;
        }
        let missed = errors.iter().filter(|e| **e > threshold).count();
        let n = errors.len() as f64;
        Some(Self {
            trajectory: if missed > 0 { 1.0 } else { 0.0 },
            location: missed as f64 / n,
            average: errors.iter().sum::<f64>() / n,
        })
    }
}
