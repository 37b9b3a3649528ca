//! Energy of a motion by frequency.
//!
//! Features are normalised with the dataset's statistics. The orthonormal cosine transform along time, of the clip's
//! length n, has coefficient k at `k fps / (2 n)` Hz. A band's energy is the sum of the squares of its coefficients,
//! averaged over features and frames, so that clips of all lengths count alike.

use std::f64::consts::PI;

/// Cosine transforms of one length, cut into bands.
#[derive(Debug)]
pub struct Bands {
    /// Basis [n, n]: coefficient by frame.
    basis: Vec<f64>,
    /// Band of each coefficient.
    band: Vec<usize>,
    bands: usize,
    frames: usize,
}

impl Bands {
    /// Prepares motions of `frames` frames at `fps`. Bands end at `ends` in hertz, and a last band takes the rest.
    pub fn new(frames: usize, fps: f64, ends: &[f64]) -> Self {
        let n = frames as f64;
        let scale = |k: usize| if k == 0 { (1.0 / n).sqrt() } else { (2.0 / n).sqrt() };
        let value = |k: usize, i: usize| scale(k) * (PI * (2 * i + 1) as f64 * k as f64 / (2.0 * n)).cos();
        let hertz = |k: usize| k as f64 * fps / (2.0 * n);
        Self {
            basis: (0..frames).flat_map(|k| (0..frames).map(move |i| (k, i))).map(|(k, i)| value(k, i)).collect(),
            band: (0..frames).map(|k| ends.iter().take_while(|end| hertz(k) >= **end).count()).collect(),
            bands: ends.len() + 1,
            frames,
        }
    }

    /// The energy in each band of rows `[frames, width]`.
    pub fn energy(&self, rows: &[f64], width: usize) -> Vec<f64> {
        let mut energy = vec![0.0; self.bands];
        let mut coefficients = vec![0.0; width];
        for (k, basis) in self.basis.chunks_exact(self.frames.max(1)).enumerate() {
            coefficients.fill(0.0);
            for (weight, row) in basis.iter().zip(rows.chunks_exact(width)) {
                coefficients.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
            }
            energy[self.band[k]] += coefficients.iter().map(|c| c * c).sum::<f64>();
        }
        energy.iter().map(|sum| sum / (width * self.frames) as f64).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_is_in_its_band_and_energy_is_kept() {
        let frames = 40;
        let fps = 20.0;
        let bands = Bands::new(frames, fps, &[0.5, 1.0, 2.0, 4.0]);
        // Coefficient 6 of 40 frames is at 1.5 Hz.
        let wave = |i: usize| (PI * (2 * i + 1) as f64 * 6.0 / 80.0).cos();
        let rows: Vec<f64> = (0..frames).flat_map(|i| [wave(i), 0.0]).collect();
        let energy = bands.energy(&rows, 2);
        assert!(energy[2] > 0.2 && energy.iter().enumerate().all(|(b, e)| b == 2 || *e < 1e-12), "{energy:?}");
        let noisy: Vec<f64> = (0..3 * frames).map(|i| (i as f64 * 0.71).sin()).collect();
        let total = noisy.iter().map(|v| v * v).sum::<f64>() / noisy.len() as f64;
        assert!((bands.energy(&noisy, 3).iter().sum::<f64>() - total).abs() < 1e-12, "Parseval");
    }
}
