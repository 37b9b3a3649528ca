//! Distance of a controlled motion from its target positions.
//!
//! Source: OmniControl and MotionLCM. The error of a (frame, joint) with a target is the distance to it. Trajectory
//! error: the motion has an error above the threshold. Location error: the share of errors above it. Average error:
//! their mean.

const AXES: usize = 3;

/// Errors of one motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlErrors {
    /// 1 if any target is missed by more than the threshold, else 0.
    pub trajectory: f64,
    /// Share of targets missed by more than the threshold.
    pub location: f64,
    /// Mean distance to the targets.
    pub average: f64,
}

impl ControlErrors {
    /// Compares a motion with a hint of its shape, both `[.., 3]`; `told` marks the positions with a target. `None` if
    /// there is no target.
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
