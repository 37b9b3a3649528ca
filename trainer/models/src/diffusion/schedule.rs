//! The schedule `scaled_linear` .00085 -> .012 over 1000 timesteps.
//!
//! Source: Rombach et al., arXiv:2112.10752 (the square roots of the betas are equidistant), as MLD and MotionLCM use it.
//! Every published weight was trained with the table rounded to f32, and near t = 0 that rounding is visible in
//! `1 - ab_t`; so the table is rounded likewise and only then widened.

/// Timesteps of the published schedule.
pub const TIMESTEPS: usize = 1000;

const BETA_FIRST: f64 = 0.000_85;
const BETA_LAST: f64 = 0.012;

/// `beta_t` and `ab_t` for t in 0..1000. Terminal signal is not zero: `ab_999` = .00466.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    betas: Vec<f32>,
    alpha_bar: Vec<f32>,
}

impl Default for Schedule {
    fn default() -> Self {
        Self::published()
    }
}

impl Schedule {
    /// The schedule of MLD, MotionLCM and MotionPCM.
    pub fn published() -> Self {
        let (first, last) = (BETA_FIRST.sqrt() as f32, BETA_LAST.sqrt() as f32);
        let step = (last - first) / (TIMESTEPS - 1) as f32;
        // Equidistant from the nearer end, which is how the published table was rounded.
        let betas: Vec<f32> = (0..TIMESTEPS)
            .map(|t| {
                let root = if t < TIMESTEPS / 2 {
                    step.mul_add(t as f32, first)
                } else {
                    (-step).mul_add((TIMESTEPS - 1 - t) as f32, last)
                };
                root * root
            })
            .collect();
        let mut product = 1.0_f64;
        let alpha_bar = betas
            .iter()
            .map(|beta| {
                product *= f64::from(1.0 - beta);
                product as f32
            })
            .collect();
        Self { betas, alpha_bar }
    }

    /// `beta_t`.
    ///
    /// # Panics
    /// If `t` is not a timestep; so do all functions of a timestep.
    pub fn beta(&self, t: usize) -> f64 {
        f64::from(self.betas[t])
    }

    /// `ab_t`, the share of signal in the variance.
    pub fn alpha_bar(&self, t: usize) -> f64 {
        f64::from(self.alpha_bar[t])
    }

    /// `alpha_t = sqrt(ab_t)`.
    pub fn alpha(&self, t: usize) -> f64 {
        self.alpha_bar(t).sqrt()
    }

    /// `sigma_t = sqrt(1 - ab_t)`.
    pub fn sigma(&self, t: usize) -> f64 {
        (1.0 - self.alpha_bar(t)).sqrt()
    }

    /// `z_t = A z_0 + E noise`: (alpha_t, sigma_t).
    pub fn add_noise(&self, t: usize) -> (f64, f64) {
        (self.alpha(t), self.sigma(t))
    }

    /// `z_0 = A z_t + E eps`: the clean latent that a noise prediction implies.
    pub fn clean(&self, t: usize) -> (f64, f64) {
        (1.0 / self.alpha(t), -self.sigma(t) / self.alpha(t))
    }

    /// `z_s = A z_t + E eps`, the deterministic DDIM move from `t` to `s`. `jump(t, t)` is exactly the identity.
    ///
    /// Source: Song, Meng, Ermon, arXiv:2010.02502, eq. 12 with eta = 0.
    pub fn jump(&self, t: usize, s: usize) -> (f64, f64) {
        if t == s {
            return (1.0, 0.0);
        }
        let a = self.alpha(s) / self.alpha(t);
        (a, self.sigma(s) - a * self.sigma(t))
    }

    /// `z_s = A z_m + E noise`, the noising from level `m` to a noisier level `s >= m`.
    pub fn transition(&self, m: usize, s: usize) -> (f64, f64) {
        let ratio = self.alpha_bar(s) / self.alpha_bar(m);
        (ratio.sqrt(), (1.0 - ratio).max(0.0).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: (f64, f64), expected: (f64, f64)) {
        let off = (found.0 - expected.0).abs().max((found.1 - expected.1).abs());
        assert!(off < 2e-5, "found {found:?}, expected {expected:?}");
    }

    #[test]
    fn table_has_the_published_values() {
        let s = Schedule::published();
        for (t, bar) in [
            (0, 0.999_149_98),
            (1, 0.998_296_03),
            (99, 0.895_462_44),
            (199, 0.755_238_08),
            (299, 0.592_182_84),
            (399, 0.426_086_08),
            (499, 0.277_669_41),
            (599, 0.161_752_37),
            (699, 0.083_128_25),
            (799, 0.037_194_96),
            (899, 0.014_298_66),
            (999, 0.004_660_09),
        ] {
            let off = s.alpha_bar(t) - bar;
            assert!(off.abs() < 5e-8, "t {t}: off by {off:e}");
        }
    }

    #[test]
    fn jumps_have_the_published_factors() {
        let s = Schedule::published();
        near(s.jump(999, 0), (14.642_594, -14.579_281));
        near(s.jump(999, 499), (7.719_100, -6.851_193));
        near(s.jump(499, 0), (1.896_930, -1.583_046));
        near(s.jump(999, 699), (4.223_544, -3.256_157));
        near(s.jump(699, 499), (1.827_636, -0.900_124));
        near(s.jump(499, 199), (1.649_217, -0.906_936));
        near(s.jump(199, 0), (1.150_200, -0.539_888));
        near(s.transition(0, 499), (0.527_168, 0.849_761));
        near(s.transition(499, 999), (0.129_549, 0.991_573));
    }

    #[test]
    fn jumps_compose_and_the_empty_one_is_the_identity() {
        let s = Schedule::published();
        for (t, m, end) in [(999, 499, 0), (812, 300, 17), (20, 19, 1)] {
            let (a1, e1) = s.jump(t, m);
            let (a2, e2) = s.jump(m, end);
            let (a, e) = s.jump(t, end);
            assert!((a2 * a1 - a).abs() < 1e-12 && (a2 * e1 + e2 - e).abs() < 1e-12);
            assert_eq!(s.jump(t, t), (1.0, 0.0));
        }
    }
}
