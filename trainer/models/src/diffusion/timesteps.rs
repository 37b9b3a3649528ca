//! The timesteps that samplers visit. Source: Song, Meng, Ermon, arXiv:2010.02502, with "leading" spacing and offset 1.

/// Number of timesteps of the published latent models.
pub const TIMESTEPS: usize = 1000;

/// Timesteps of the sampler for `steps` steps, noisiest first.
///
/// # Panics
/// If `steps` is not in 1..=999.
pub fn ddim_timesteps(steps: usize) -> Vec<usize> {
    assert!((1..TIMESTEPS).contains(&steps), "DDIM takes 1 to 999 steps, not {steps}");
    let stride = TIMESTEPS / steps;
    (0..steps).rev().map(|i| i * stride + 1).collect()
}

/// The timestep after a step from `t`: `t - 1000 / steps`, or 0 if that is negative.
pub fn ddim_previous(steps: usize, t: usize) -> usize {
    t.saturating_sub(TIMESTEPS / steps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timesteps_lead_with_offset_one() {
        assert_eq!(ddim_timesteps(1), [1]);
        assert_eq!(ddim_timesteps(5), [801, 601, 401, 201, 1]);
        assert_eq!(ddim_timesteps(50)[..3], [981, 961, 941]);
        assert_eq!(ddim_previous(50, 21), 1);
        assert_eq!(ddim_previous(50, 1), 0);
        assert_eq!(ddim_timesteps(999)[0], 999);
    }
}
