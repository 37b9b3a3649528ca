//! Loops compiled for several instruction sets; the best one of the processor is selected at run time.
//!
//! The bodies are plain loops that the compiler vectorises. The choice never changes on one machine, and neither do the
//! bits. Another instruction set may contract multiply-adds differently, so all workers of a gang must have the same
//! one (`crate::instruction_set`).

/// Defines `fn name(args)` that runs `body` compiled for AVX-512, AVX2 or the baseline.
macro_rules! multiversion {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$doc])*
        $vis fn $name($($arg: $ty),*) $(-> $ret)? {
            #[inline(always)]
            fn body($($arg: $ty),*) $(-> $ret)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                fn wide($($arg: $ty),*) $(-> $ret)? {
                    body($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn middle($($arg: $ty),*) $(-> $ret)? {
                    body($($arg),*)
                }
                if $crate::kernels::simd::has_wide() {
                    #[expect(unsafe_code, reason = "the features were detected")]
                    // SAFETY: `has_wide` checked every feature that `wide` is compiled for.
                    return unsafe { wide($($arg),*) };
                }
                if $crate::kernels::simd::has_middle() {
                    #[expect(unsafe_code, reason = "the features were detected")]
                    // SAFETY: `has_middle` checked every feature that `middle` is compiled for.
                    return unsafe { middle($($arg),*) };
                }
            }
            body($($arg),*)
        }
    };
}
pub(super) use multiversion;

/// Returns true if the processor supports the AVX-512 version.
#[cfg(target_arch = "x86_64")]
pub(crate) fn has_wide() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq")
        && has_middle()
}

/// Returns true if the processor supports the AVX2 version.
#[cfg(target_arch = "x86_64")]
pub(crate) fn has_middle() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")
}

/// e^x for x <= 0, within 2 units in the last place; 0 below -87.
///
/// Splits x into n ln 2 + r and takes a polynomial of degree 6 in r (Taylor, |r| <= ln 2 / 2).
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    let clamped = if x < -87.0 { -87.0 } else { x };
    let n = (clamped * std::f32::consts::LOG2_E).round_ties_even();
    let r = clamped - n * 0.693_359_4 + n * 2.121_944_4e-4;
    let p = 1.0 / 5040.0;
    let p = p * r + 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    #[expect(clippy::cast_possible_truncation, reason = "n lies in -126..=0")]
    let scale = f32::from_bits((((n as i32) + 127) as u32) << 23);
    if x < -87.0 { 0.0 } else { p * scale }
}

/// erf(x) within about 1e-7, as the odd rational function x P(x^2) / Q(x^2) on |x| < 4 whose coefficients Eigen publishes
/// (`generic_fast_erf_float`, degrees 13 and 8).
#[inline(always)]
pub(super) fn erf(x: f32) -> f32 {
    let x = x.clamp(-4.0, 4.0);
    let s = x * x;
    let p = -2.726_142e-10;
    let p = p * s + 2.770_681_4e-8;
    let p = p * s - 2.101_024e-6;
    let p = p * s - 5.692_506_4e-5;
    let p = p * s - 7.349_906_3e-4;
    let p = p * s - 2.954_6e-3;
    let p = p * s - 1.609_603_3e-2;
    let q = -1.456_607_2e-5;
    let q = q * s - 2.133_740_6e-4;
    let q = q * s - 1.682_827e-3;
    let q = q * s - 7.373_329_2e-3;
    let q = q * s - 1.426_474e-2;
    x * p / q
}

multiversion! {
    /// `out[i] += row[i]` for every row of `rows`.
    pub(super) fn add_rows(out: &mut [f32], rows: &[f32]) {
        let width = out.len();
        for row in rows.chunks_exact(width) {
            for (o, r) in out.iter_mut().zip(row) {
                *o += *r;
            }
        }
    }
}

multiversion! {
    /// `row[i] = bias[i]` for every row of `rows`.
    pub(super) fn fill_rows(rows: &mut [f32], bias: &[f32]) {
        for row in rows.chunks_exact_mut(bias.len()) {
            row.copy_from_slice(bias);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_erf_are_accurate() {
        for i in 0..=8700_i16 {
            let x = -f32::from(i) / 100.0;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) - exact).abs() <= 4e-7 * exact, "exp({x})");
        }
        assert_eq!(exp(-200.0), 0.0);
        // Abramowitz and Stegun, table 7.1.
        for (x, y) in [
            (0.0, 0.0),
            (0.1, 0.112_462_92),
            (0.5, 0.520_499_9),
            (1.0, 0.842_700_8),
            (2.0, 0.995_322_3),
            (3.5, 0.999_999_3),
        ] {
            assert!((erf(x) - y).abs() < 2e-7, "erf({x}) = {} against {y}", erf(x));
            assert!((erf(-x) + y).abs() < 2e-7, "erf(-{x})");
        }
    }
}
