//! Common checks of models that diffuse motion itself.

use super::{Diffusion, NoiseSchedule, Problems};
use crate::limits;

/// Checks a schedule of `timesteps` for samplers of features.
pub(super) fn check_diffusion(p: &mut Problems, diffusion: &Diffusion, timesteps: usize) {
    diffusion.check(p);
    if diffusion.schedule == NoiseSchedule::Flow {
        let message = "this stage has no sampler for the schedule `flow`";
        p.add("diffusion.schedule", message, "write `schedule: cosine` or `schedule: linear`");
    }
    if !(2..=1000).contains(&timesteps) {
        p.add("timesteps", format!("`timesteps` is {timesteps}; expected 2 to 1000"), "published: 50 and 1000");
    }
}

/// Checks the number of frames that motions are padded to.
pub(super) fn check_frames(p: &mut Problems, max_frames: usize) {
    if !(4..=10_000).contains(&max_frames) {
        p.add("max_frames", format!("`max_frames` is {max_frames}; expected 4 to 10000"), "published: 196");
    }
}

/// Refuses a network with more parameters than the limit.
pub(super) fn check_parameters(p: &mut Problems, parameters: usize) {
    if parameters > limits::PARAMETERS {
        let message =
            format!("the network has at least {parameters} parameters; expected at most {}", limits::PARAMETERS);
        p.add("network", message, "use fewer or narrower layers");
    }
}
