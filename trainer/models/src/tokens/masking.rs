//! The schedule of masks: a cosine over equidistant points.

/// Share of tokens that are masked at `t` from 0 (all) to 1 (none): `cos(pi t / 2)`. Computed in f32 as upstream, since
/// the rounding decides counts.
pub fn cosine(t: f32) -> f32 {
    (t * std::f32::consts::PI * 0.5).cos()
}

/// Point `k` of `count` equidistant points from 0 to 1, computed in f32 as by `torch.linspace`: the second half from
/// the end.
pub fn grid(k: usize, count: usize) -> f32 {
    if count < 2 {
        return 0.0;
    }
    let step = 1.0 / (count - 1) as f32;
    if k < count / 2 { step * k as f32 } else { 1.0 - step * (count - 1 - k) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masked_counts_are_those_of_upstream() {
        let counts = |length: f32, steps: usize| -> Vec<f32> {
            let at = |k: usize| cosine(grid(k, steps)) * length;
            (0..steps).map(|k| at(k).round_ties_even().max(1.0)).collect()
        };
        assert_eq!(counts(49.0, 10), [49.0, 48.0, 46.0, 42.0, 38.0, 31.0, 25.0, 17.0, 9.0, 1.0]);
        assert_eq!(counts(20.0, 10), [20.0, 20.0, 19.0, 17.0, 15.0, 13.0, 10.0, 7.0, 3.0, 1.0]);
    }
}
