//! Loops compiled for several instruction sets; the best one of the processor is selected at run time.
//!
//! Bodies use [`Lanes`], or plain loops over slices, which the compiler vectorises. The choice never changes on one machine,
//! and neither do the bits. Another instruction set may contract multiply-adds differently, so all workers of a gang must have the same
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

            #[cfg(target_arch = "x86_64")]
            {
                // Each has the whole body, because only closures inside a function have its features.
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                #[allow(clippy::too_many_arguments, reason = "a kernel takes its slices and sizes one by one")]
                fn wide($($arg: $ty),*) $(-> $ret)? {
                    #[allow(dead_code, reason = "not every body asks")]
                    const $set: u8 = set::WIDE;
                    $body
                }
                #[target_feature(enable = "avx2,fma")]
                #[allow(clippy::too_many_arguments, reason = "a kernel takes its slices and sizes one by one")]
                fn middle($($arg: $ty),*) $(-> $ret)? {
                    #[allow(dead_code, reason = "not every body asks")]
                    const $set: u8 = set::MIDDLE;
                    $body
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
            #[allow(dead_code, reason = "not every body asks")]
            const $set: u8 = set::BASE;
            $body
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

/// Sums what `item` makes of the elements of each column of `rows`, in lanes.
///
/// # Panics
/// If another row is shorter than the first.
#[inline(always)]
pub(super) fn sum<const SET: u8, const N: usize>(
    rows: [&[f32]; N],
    item: impl Fn([Lanes<SET>; N]) -> Lanes<SET>,
) -> f32 {
    let width = rows[0].len();
    let split = rows.map(|row| row[..width].as_chunks::<LANES>());
    let whole = width / LANES;
    // Four sums, because each addition waits for the one before it.
    let mut sums = [Lanes::splat(0.0); 4];
    let together = whole / sums.len() * sums.len();
    for first in (0..together).step_by(sums.len()) {
        for (j, sum) in sums.iter_mut().enumerate() {
            *sum = *sum + item(split.map(|(chunks, _)| Lanes::from(chunks[first + j])));
        }
    }
    let [mut a, b, c, d] = sums;
    for i in together..whole {
        a = a + item(split.map(|(chunks, _)| Lanes::from(chunks[i])));
    }
    if !width.is_multiple_of(LANES) {
        let last = item(split.map(|(_, rest)| Lanes::padded(rest)));
        a = a + Lanes::padded(&last.numbers()[..width % LANES]);
    }
    ((a + b) + (c + d)).folded()
}

/// Appends to `out` what `item` makes of the elements of each column of `rows`.
///
/// # Panics
/// If another row is shorter than the first.
#[inline(always)]
pub(super) fn append<const SET: u8, const N: usize>(
    out: &mut Vec<f32>,
    rows: [&[f32]; N],
    item: impl Fn([Lanes<SET>; N]) -> Lanes<SET>,
) {
    let width = rows[0].len();
    let split = rows.map(|row| row[..width].as_chunks::<LANES>());
    out.reserve(width);
    let (free, last) = out.spare_capacity_mut()[..width].as_chunks_mut::<LANES>();
    for (i, free) in free.iter_mut().enumerate() {
        free.write_copy_of_slice(&item(split.map(|(chunks, _)| Lanes::from(chunks[i]))).numbers());
    }
    if !last.is_empty() {
        let found = item(split.map(|(_, rest)| Lanes::padded(rest))).numbers();
        last.write_copy_of_slice(&found[..last.len()]);
    }
    let len = out.len() + width;
    #[expect(unsafe_code, reason = "the new elements are not zeroed first")]
    // SAFETY: the loop wrote all `width` elements behind the old ones.
    unsafe {
        out.set_len(len);
    }
}

/// Replaces each element of `out` by what `item` makes of it and of the same column of `rows`.
///
/// # Panics
/// If a row is shorter than `out`.
#[inline(always)]
pub(super) fn update<const SET: u8, const N: usize>(
    out: &mut [f32],
    rows: [&[f32]; N],
    item: impl Fn(Lanes<SET>, [Lanes<SET>; N]) -> Lanes<SET>,
) {
    let split = rows.map(|row| row[..out.len()].as_chunks::<LANES>());
    let (chunks, last) = out.as_chunks_mut::<LANES>();
    for (i, out) in chunks.iter_mut().enumerate() {
        *out = item(Lanes::from(*out), split.map(|(chunks, _)| Lanes::from(chunks[i]))).numbers();
    }
    if !last.is_empty() {
        let found = item(Lanes::padded(last), split.map(|(_, rest)| Lanes::padded(rest))).numbers();
        last.copy_from_slice(&found[..last.len()]);
    }
}

/// Numbers that are computed together.
pub(super) const LANES: usize = 8;

/// [`LANES`] numbers, computed with the instructions of a set. The compiler makes vectors of loops over slices, but often
/// chains of single numbers of arrays that stay in registers, such as the lanes of a sum.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lanes<const SET: u8>(Register);

#[cfg(target_arch = "x86_64")]
type Register = std::arch::x86_64::__m256;
#[cfg(not(target_arch = "x86_64"))]
type Register = [f32; LANES];

/// Defines an operation on lanes, by a register or one by one.
macro_rules! lanewise {
    ($register:expr, |$($x:ident),*| $one:expr, $($lanes:expr),*) => {{
        #[cfg(target_arch = "x86_64")]
        if SET > set::BASE {
            use std::arch::x86_64::*;
            #[expect(unsafe_code, reason = "the caller runs with the instructions of its set")]
            // SAFETY: a set is used only where its features were detected.
            return Lanes(unsafe { $register($($lanes.0),*) });
        }
        Lanes::from(std::array::from_fn(|l| {
            $(let $x = $lanes.numbers()[l];)*
            $one
        }))
    }};
}

impl<const SET: u8> From<[f32; LANES]> for Lanes<SET> {
    #[inline(always)]
    fn from(numbers: [f32; LANES]) -> Self {
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "a register is 8 numbers")]
        // SAFETY: both have the same size, and all bits are numbers.
        return Self(unsafe { std::mem::transmute::<[f32; LANES], Register>(numbers) });
        #[cfg(not(target_arch = "x86_64"))]
        Self(numbers)
    }
}

impl<const SET: u8> Lanes<SET> {
    /// The numbers one by one.
    #[inline(always)]
    pub(super) fn numbers(self) -> [f32; LANES] {
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "a register is 8 numbers")]
        // SAFETY: both have the same size, and all bits are numbers.
        return unsafe { std::mem::transmute::<Register, [f32; LANES]>(self.0) };
        #[cfg(not(target_arch = "x86_64"))]
        self.0
    }

    /// The same number in all lanes.
    #[inline(always)]
    pub(super) fn splat(x: f32) -> Self {
        Self::from([x; LANES])
    }

    /// The numbers of `row`, and zeros behind them.
    #[inline(always)]
    fn padded(row: &[f32]) -> Self {
        let mut lanes = [0.0; LANES];
        lanes[..row.len()].copy_from_slice(row);
        Self::from(lanes)
    }

    /// `self b + c`, rounded as by [`mul_add`].
    #[inline(always)]
    pub(super) fn mul_add(self, b: Self, c: Self) -> Self {
        lanewise!(_mm256_fmadd_ps, |x, y, z| mul_add::<SET>(x, y, z), self, b, c)
    }

    /// The smaller number of each lane. NaN stays NaN in `self`; in `other` it is left out.
    #[inline(always)]
    pub(super) fn min(self, other: Self) -> Self {
        // The instruction returns its second operand if one of them is NaN.
        lanewise!((|x, y| _mm256_min_ps(y, x)), |x, y| if y < x { y } else { x }, self, other)
    }

    /// The larger number of each lane. NaN stays NaN in `self`; in `other` it is left out.
    #[inline(always)]
    pub(super) fn max(self, other: Self) -> Self {
        lanewise!((|x, y| _mm256_max_ps(y, x)), |x, y| if y > x { y } else { x }, self, other)
    }

    /// The numbers without their signs.
    #[inline(always)]
    pub(super) fn abs(self) -> Self {
        self.max(Self::splat(0.0) - self)
    }

    /// `negative` where the number is below 0, `other` elsewhere and for NaN.
    #[inline(always)]
    pub(super) fn by_sign(self, negative: Self, other: Self) -> Self {
        lanewise!(
            (|x, a, b| _mm256_blendv_ps(b, a, _mm256_cmp_ps::<_CMP_LT_OQ>(x, _mm256_setzero_ps()))),
            |x, a, b| if x < 0.0 { a } else { b },
            self,
            negative,
            other
        )
    }

    /// e^x for x <= 0, within 2 units in the last place; 0 below -87, NaN for NaN.
    ///
    /// Splits x into n ln 2 + r and takes a polynomial of degree 7 in r (Taylor, |r| <= ln 2 / 2).
    #[inline(always)]
    pub(super) fn exp(self) -> Self {
        // 1.5 * 2^23: a number that is added to it is rounded to an integer. Its lowest bits then hold it.
        const ROUND: f32 = 12_582_912.0;
        const LEAST: f32 = -87.0;
        let by = Self::splat;
        let clamped = self.max(by(LEAST));
        let shifted = clamped.mul_add(by(std::f32::consts::LOG2_E), by(ROUND));
        let n = shifted - by(ROUND);
        let r = n.mul_add(by(-0.693_359_4), clamped);
        let r = n.mul_add(by(2.121_944_4e-4), r);
        let p = by(1.0 / 5040.0);
        let p = p.mul_add(r, by(1.0 / 720.0));
        let p = p.mul_add(r, by(1.0 / 120.0));
        let p = p.mul_add(r, by(1.0 / 24.0));
        let p = p.mul_add(r, by(1.0 / 6.0));
        let p = p.mul_add(r, by(0.5));
        let p = p.mul_add(r, by(1.0));
        let p = p.mul_add(r, by(1.0));
        let scale = shifted.exponents(ROUND);
        (self - by(LEAST)).by_sign(by(0.0), p * scale)
    }

    /// 2^n of the integers n that are added to `base` in each lane.
    #[inline(always)]
    fn exponents(self, base: f32) -> Self {
        const BIAS: u32 = 127;
        const PLACE: u32 = 23;
        #[expect(clippy::cast_possible_wrap, reason = "the same bits")]
        let offset = BIAS.wrapping_sub(base.to_bits()) as i32;
        lanewise!(
            (|x| {
                let n = _mm256_add_epi32(_mm256_castps_si256(x), _mm256_set1_epi32(offset));
                _mm256_castsi256_ps(_mm256_slli_epi32::<{ PLACE as i32 }>(n))
            }),
            |x| f32::from_bits(x.to_bits().wrapping_add_signed(offset) << PLACE),
            self
        )
    }

    /// `1 / (1 + e^-x)`.
    #[inline(always)]
    pub(super) fn logistic(self) -> Self {
        let one = Self::splat(1.0);
        let e = (Self::splat(0.0) - self.abs()).exp();
        let s = one / (one + e);
        self.by_sign(e * s, s)
    }

    /// erf(x) within about 1e-7, as the odd rational function x P(x^2) / Q(x^2) on |x| < 4 whose coefficients Eigen
    /// publishes (`generic_fast_erf_float`, degrees 13 and 8).
    #[inline(always)]
    pub(super) fn erf(self) -> Self {
        let by = Self::splat;
        let x = self.max(by(-4.0)).min(by(4.0));
        let s = x * x;
        let p = by(-2.726_142e-10);
        let p = p.mul_add(s, by(2.770_681_4e-8));
        let p = p.mul_add(s, by(-2.101_024e-6));
        let p = p.mul_add(s, by(-5.692_506_4e-5));
        let p = p.mul_add(s, by(-7.349_906_3e-4));
        let p = p.mul_add(s, by(-2.954_6e-3));
        let p = p.mul_add(s, by(-1.609_603_3e-2));
        let q = by(-1.456_607_2e-5);
        let q = q.mul_add(s, by(-2.133_740_6e-4));
        let q = q.mul_add(s, by(-1.682_827e-3));
        let q = q.mul_add(s, by(-7.373_329_2e-3));
        let q = q.mul_add(s, by(-1.426_474e-2));
        x * p / q
    }

    /// The sum of all lanes. Halves are added until one number is left.
    #[inline(always)]
    fn folded(self) -> f32 {
        let mut lanes = self.numbers();
        let mut half = LANES / 2;
        while half > 0 {
            for l in 0..half {
                lanes[l] += lanes[l + half];
            }
            half /= 2;
        }
        lanes[0]
    }
}

impl<const SET: u8> std::ops::Add for Lanes<SET> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        lanewise!(_mm256_add_ps, |x, y| x + y, self, other)
    }
}

impl<const SET: u8> std::ops::Sub for Lanes<SET> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        lanewise!(_mm256_sub_ps, |x, y| x - y, self, other)
    }
}

impl<const SET: u8> std::ops::Div for Lanes<SET> {
    type Output = Self;

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        lanewise!(_mm256_div_ps, |x, y| x / y, self, other)
    }
}

impl<const SET: u8> std::ops::Mul for Lanes<SET> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        lanewise!(_mm256_mul_ps, |x, y| x * y, self, other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a function of lanes gives for a number.
    fn one<const SET: u8>(x: f32, function: fn(Lanes<SET>) -> Lanes<SET>) -> f32 {
        function(Lanes::splat(x)).numbers()[0]
    }

    #[test]
    fn exp_and_erf_are_accurate() {
        fn check<const SET: u8>() {
            for i in 0..=8700_i16 {
                let x = -f32::from(i) / 100.0;
                let exact = f64::from(x).exp();
                let found = one::<SET>(x, Lanes::exp);
                assert!((f64::from(found) - exact).abs() <= 4e-7 * exact, "exp({x})");
            }
            assert_eq!(one::<SET>(-200.0, Lanes::exp), 0.0);
            assert_eq!(one::<SET>(f32::NEG_INFINITY, Lanes::exp), 0.0);
            // A hidden NaN would let a broken training continue.
            for nan in [f32::NAN, -f32::NAN] {
                for function in [Lanes::exp, Lanes::logistic, Lanes::erf, Lanes::abs] {
                    assert!(one::<SET>(nan, function).is_nan());
                }
            }
            // Abramowitz and Stegun, table 7.1.
            for (x, y) in [
                (0.0, 0.0),
                (0.1, 0.112_462_92),
                (0.5, 0.520_499_9),
                (1.0, 0.842_700_8),
                (2.0, 0.995_322_3),
                (3.5, 0.999_999_3),
            ] {
                let plus = one::<SET>(x, Lanes::erf);
                let minus = one::<SET>(-x, Lanes::erf);
                assert!((plus - y).abs() < 2e-7, "erf({x}) = {plus} against {y}");
                assert!((minus + y).abs() < 2e-7, "erf(-{x}) = {minus}");
            }
        }
        check::<{ set::BASE }>();
        #[cfg(target_arch = "x86_64")]
        if has_middle() {
            check::<{ set::MIDDLE }>();
        }
    }

    #[test]
    fn rows_of_any_width_are_updated_and_summed() {
        multiversion! {
            fn both<const SET>(x: &[f32], y: &[f32], out: &mut [f32]) -> f32 {
                update::<SET, 2>(out, [x, y], |old, [x, y]| x.mul_add(y, old));
                sum::<SET, 2>([x, y], |[x, y]| (x - y).abs())
            }
        }
        for width in 0..40 {
            let x: Vec<f32> = (0..width).map(|i| i as f32).collect();
            let y: Vec<f32> = (0..width).map(|i| if i % 2 == 0 { -1.0 } else { 2.0 * i as f32 }).collect();
            let mut out = vec![0.5; width];
            let total = both(&x, &y, &mut out);
            let expected: f32 = x.iter().zip(&y).map(|(x, y)| (x - y).abs()).sum();
            assert_eq!(total, expected, "{width}");
            assert!(out.iter().zip(x.iter().zip(&y)).all(|(out, (x, y))| *out == 0.5 + x * y), "{width}");
        }
    }
}
