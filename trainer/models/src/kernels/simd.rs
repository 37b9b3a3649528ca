//! Loops compiled for several instruction sets; the best one of the processor is selected at run time.
//!
//! The bodies are plain loops that the compiler vectorises. The choice never changes on one machine, and neither do the
//! bits. Another instruction set may contract multiply-adds differently, so all workers of a gang must have the same
//! one (`crate::instruction_set`).

/// Instruction sets for which the bodies are compiled, as numbers so that a body can have one as a parameter.
pub(crate) mod set {
    /// The baseline of the platform.
    pub(crate) const BASE: u8 = 0;
    /// AVX2 and FMA: 16 registers of 8 numbers.
    pub(crate) const MIDDLE: u8 = 1;
    /// AVX-512: 32 registers of 16 numbers.
    pub(crate) const WIDE: u8 = 2;
}

/// Defines `fn name(args)` that runs `body` compiled for AVX-512, AVX2 or the baseline. A body that is defined as
/// `fn name<const SET>(args)` knows which one.
macro_rules! multiversion {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $crate::kernels::simd::multiversion! {
            $(#[$doc])* $vis fn $name<const SET>($($arg: $ty),*) $(-> $ret)? $body
        }
    };
    ($(#[$doc:meta])* $vis:vis fn $name:ident<const $set:ident>($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments, reason = "a kernel takes its slices and sizes one by one")]
        $vis fn $name($($arg: $ty),*) $(-> $ret)? {
            use $crate::kernels::simd::set;

            #[inline(always)]
            #[allow(clippy::too_many_arguments, reason = "a kernel takes its slices and sizes one by one")]
            fn body<const $set: u8>($($arg: $ty),*) $(-> $ret)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                #[allow(clippy::too_many_arguments, reason = "a kernel takes its slices and sizes one by one")]
                fn wide($($arg: $ty),*) $(-> $ret)? {
                    body::<{ set::WIDE }>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                #[allow(clippy::too_many_arguments, reason = "a kernel takes its slices and sizes one by one")]
                fn middle($($arg: $ty),*) $(-> $ret)? {
                    body::<{ set::MIDDLE }>($($arg),*)
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
            body::<{ set::BASE }>($($arg),*)
        }
    };
}
pub(crate) use multiversion;

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

/// `a b + c`, rounded once where the instruction set has that: everywhere but on x86 without FMA.
#[inline(always)]
pub(super) fn mul_add<const SET: u8>(a: f32, b: f32, c: f32) -> f32 {
    if SET > set::BASE || cfg!(target_arch = "aarch64") { a.mul_add(b, c) } else { a * b + c }
}

/// e^x for x <= 0, within 2 units in the last place; 0 below -87.
///
/// Splits x into n ln 2 + r and takes a polynomial of degree 7 in r (Taylor, |r| <= ln 2 / 2).
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    exp_by::<{ set::BASE }>(x)
}

/// Like [`exp`], with the multiplications of an instruction set.
#[inline(always)]
pub(super) fn exp_by<const SET: u8>(x: f32) -> f32 {
    let clamped = if x < -87.0 { -87.0 } else { x };
    let n = (clamped * std::f32::consts::LOG2_E).round_ties_even();
    let r = mul_add::<SET>(n, -0.693_359_4, clamped);
    let r = mul_add::<SET>(n, 2.121_944_4e-4, r);
    let p = 1.0 / 5040.0;
    let p = mul_add::<SET>(p, r, 1.0 / 720.0);
    let p = mul_add::<SET>(p, r, 1.0 / 120.0);
    let p = mul_add::<SET>(p, r, 1.0 / 24.0);
    let p = mul_add::<SET>(p, r, 1.0 / 6.0);
    let p = mul_add::<SET>(p, r, 0.5);
    let p = mul_add::<SET>(p, r, 1.0);
    let p = mul_add::<SET>(p, r, 1.0);
    #[expect(clippy::cast_possible_truncation, reason = "n lies in -126..=0")]
    let scale = f32::from_bits((((n as i32) + 127) as u32) << 23);
    if x < -87.0 { 0.0 } else { p * scale }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(super) fn logistic(x: f32) -> f32 {
    let e = exp(-x.abs());
    let s = 1.0 / (1.0 + e);
    if x >= 0.0 { s } else { e * s }
}

/// erf(x) within about 1e-7, as the odd rational function x P(x^2) / Q(x^2) on |x| < 4 whose coefficients Eigen publishes
/// (`generic_fast_erf_float`, degrees 13 and 8).
#[inline(always)]
pub(super) fn erf_by<const SET: u8>(x: f32) -> f32 {
    let x = x.clamp(-4.0, 4.0);
    let s = x * x;
    let p = -2.726_142e-10;
    let p = mul_add::<SET>(p, s, 2.770_681_4e-8);
    let p = mul_add::<SET>(p, s, -2.101_024e-6);
    let p = mul_add::<SET>(p, s, -5.692_506_4e-5);
    let p = mul_add::<SET>(p, s, -7.349_906_3e-4);
    let p = mul_add::<SET>(p, s, -2.954_6e-3);
    let p = mul_add::<SET>(p, s, -1.609_603_3e-2);
    let q = -1.456_607_2e-5;
    let q = mul_add::<SET>(q, s, -2.133_740_6e-4);
    let q = mul_add::<SET>(q, s, -1.682_827e-3);
    let q = mul_add::<SET>(q, s, -7.373_329_2e-3);
    let q = mul_add::<SET>(q, s, -1.426_474e-2);
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

/// `count` rows, each equal to `row`.
pub(super) fn repeat_row(row: &[f32], count: usize) -> Vec<f32> {
    let mut rows = Vec::with_capacity(row.len() * count);
    for _ in 0..count {
        rows.extend_from_slice(row);
    }
    rows
}

/// Sums in 16 lanes, then adds the lanes in order. It vectorises and has one order for all widths.
#[inline(always)]
pub(super) fn lanes(mut items: impl FnMut(usize) -> f32, width: usize) -> f32 {
    let mut lane = [0.0_f32; 16];
    let whole = width / 16 * 16;
    let mut i = 0;
    while i < whole {
        for (l, slot) in lane.iter_mut().enumerate() {
            *slot += items(i + l);
        }
        i += 16;
    }
    let mut rest = 0.0;
    while i < width {
        rest += items(i);
        i += 1;
    }
    lane.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_erf_are_accurate() {
        for i in 0..=8700_i16 {
            let x = -f32::from(i) / 100.0;
            let exact = f64::from(x).exp();
            for found in [exp(x), exp_by::<{ set::MIDDLE }>(x)] {
                assert!((f64::from(found) - exact).abs() <= 4e-7 * exact, "exp({x})");
            }
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
            for (plus, minus) in [
                (erf_by::<{ set::BASE }>(x), erf_by::<{ set::BASE }>(-x)),
                (erf_by::<{ set::MIDDLE }>(x), erf_by::<{ set::MIDDLE }>(-x)),
            ] {
                assert!((plus - y).abs() < 2e-7, "erf({x}) = {plus} against {y}");
                assert!((minus + y).abs() < 2e-7, "erf(-{x}) = {minus}");
            }
        }
    }
}
