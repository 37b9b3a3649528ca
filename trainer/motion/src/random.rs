//! Randomness keyed by its purpose, independent of the number of earlier draws.
//!
//! A [`Stream`] is ChaCha8 under a key that is the SHA-256 of (seed, purpose, step, index). Two streams that differ in
//! any of the four are independent. Neither a restart nor the number of workers changes the numbers of a stream.
//!
//! Normal deviates are computed by the inverse of the normal distribution function (Wichura, "Algorithm AS 241",
//! Applied Statistics 37(3), 1988, PPND16) with a logarithm of our own. It uses only additions, multiplications,
//! divisions and square roots, which IEEE 754 rounds the same way everywhere. The system's `ln` and `cos` do not
//! guarantee that.

use protocol::{Digest, Seed};
use rand_chacha::ChaCha8Rng;
use rand_core::{RngCore, SeedableRng};

/// A sequence of random numbers that is a function of its key alone.
#[derive(Debug, Clone)]
pub struct Stream {
    generator: ChaCha8Rng,
}

impl Stream {
    /// Creates the stream of `purpose` for one `index` of one `step`.
    ///
    /// A purpose names the draw and its place, for instance `"pcm/noise"`, so that no two uses share numbers.
    pub fn new(seed: Seed, purpose: &str, step: u64, index: u64) -> Self {
        let mut key = Vec::with_capacity(48 + purpose.len());
        key.extend_from_slice(b"stride/stream/1\0");
        key.extend_from_slice(&seed.0.to_le_bytes());
        key.extend_from_slice(&step.to_le_bytes());
        key.extend_from_slice(&index.to_le_bytes());
        key.extend_from_slice(purpose.as_bytes());
        Self { generator: ChaCha8Rng::from_seed(*Digest::of(&key).as_bytes()) }
    }

    /// 64 uniform bits.
    pub fn bits(&mut self) -> u64 {
        self.generator.next_u64()
    }

    /// Uniform in `[0, 1)`, in steps of 2^-53.
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }

    /// Uniform in `[lo, hi)`.
    pub fn range(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * self.uniform()
    }

    /// Uniform in `0..n`, without bias. `n` of 0 gives 0.
    pub fn below(&mut self, n: usize) -> usize {
        let n = n as u64;
        if n < 2 {
            return 0;
        }
        // Lemire's multiply-and-shift; the few low products that would favour some values are drawn again.
        let reject_below = n.wrapping_neg() % n;
        loop {
            let product = u128::from(self.bits()) * u128::from(n);
            if product as u64 >= reject_below {
                return (product >> 64) as usize;
            }
        }
    }

    /// True with probability `p`.
    pub fn chance(&mut self, p: f64) -> bool {
        self.uniform() < p
    }

    /// A standard normal deviate. It takes one draw, so the n-th value of a stream equals that of `fill_normal`.
    pub fn normal(&mut self) -> f32 {
        inverse_normal(self.share()) as f32
    }

    /// Fills `out` with standard normal deviates.
    pub fn fill_normal(&mut self, out: &mut [f32]) {
        for out in out.chunks_mut(BLOCK) {
            let mut values = [0.5; BLOCK];
            values[..out.len()].fill_with(|| self.share());
            inverse_normals(&mut values);
            for (out, value) in out.iter_mut().zip(values) {
                *out = value as f32;
            }
        }
    }

    /// Uniform inside (0, 1), in steps of 2^-32.
    fn share(&mut self) -> f64 {
        (f64::from(self.generator.next_u32()) + 0.5) / 4_294_967_296.0
    }
}

/// The order in which epoch `epoch` visits `n` examples: a Fisher-Yates shuffle of `0..n`.
pub fn permutation(seed: Seed, purpose: &str, epoch: u64, n: usize) -> Vec<u32> {
    let mut stream = Stream::new(seed, purpose, epoch, 0);
    let mut order: Vec<u32> = (0..n as u32).collect();
    for last in (1..n).rev() {
        order.swap(last, stream.below(last + 1));
    }
    order
}

/// Deviates that are computed together.
const BLOCK: usize = 64;

/// [`inverse_normal`] of each share, in steps of 2^-32. Wider registers give the same bits, because no multiplication is
/// joined to an addition.
fn inverse_normals(values: &mut [f64; BLOCK]) {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f,avx512vl,avx512dq")]
        fn wide(values: &mut [f64; BLOCK]) {
            of_block(values);
        }
        if is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512dq")
        {
            #[expect(unsafe_code, reason = "the features were detected")]
            // SAFETY: the condition checked every feature that `wide` is compiled for.
            return unsafe { wide(values) };
        }
    }
    of_block(values);
}

#[inline(always)]
fn of_block(values: &mut [f64; BLOCK]) {
    /// Tails that are computed together.
    const TAILS: usize = 8;
    let mut tails = [0.25; BLOCK];
    let mut places = [0; BLOCK];
    let mut count = 0;
    for (place, p) in values.iter().enumerate() {
        if (p - 0.5).abs() > CENTRE {
            tails[count] = *p;
            places[count] = place;
            count += 1;
        }
    }
    for value in values.iter_mut() {
        *value = centre(*value - 0.5);
    }
    for (tails, places) in tails[..count.next_multiple_of(TAILS)].chunks_mut(TAILS).zip(places.chunks(TAILS)) {
        let mut sizes = [0.0; TAILS];
        for (size, p) in sizes.iter_mut().zip(&*tails) {
            *size = tail(*p, distance(*p));
        }
        let live = count.min(TAILS);
        places[..live].iter().zip(sizes).for_each(|(place, size)| values[*place] = size);
        count -= live;
    }
}

/// Natural logarithm of a positive, normal number. The error is below 2 units in the last place.
#[inline(always)]
fn ln(x: f64) -> f64 {
    let bits = x.to_bits();
    let mut exponent = ((bits >> 52) & 0x7ff) as i64 - 1023;
    let mut mantissa = f64::from_bits((bits & 0x000f_ffff_ffff_ffff) | 0x3ff0_0000_0000_0000);
    if mantissa > std::f64::consts::SQRT_2 {
        mantissa *= 0.5;
        exponent += 1;
    }
    // ln m = 2 atanh((m - 1) / (m + 1)); the argument is at most 0.172, so 11 odd terms reach full precision.
    let t = (mantissa - 1.0) / (mantissa + 1.0);
    let t2 = t * t;
    let mut series = 0.0;
    for k in (0..11).rev() {
        series = series * t2 + 1.0 / f64::from(2 * k + 1);
    }
    exponent as f64 * std::f64::consts::LN_2 + 2.0 * t * series
}

#[inline(always)]
fn polynomial(coefficients: &[f64; 8], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c)
}

/// The value below which a standard normal deviate falls with probability `p`, `0 < p < 1`.
fn inverse_normal(p: f64) -> f64 {
    let q = p - 0.5;
    if q.abs() <= CENTRE {
        return centre(q);
    }
    let r = distance(p);
    if r <= 5.0 {
        return tail(p, r);
    }
    let size = polynomial(&FAR_UPPER, r - 5.0) / polynomial(&FAR_LOWER, r - 5.0);
    if q < 0.0 { -size } else { size }
}

/// The variable of the formulas of the tails. It is at most 5 for shares in steps of 2^-32.
#[inline(always)]
fn distance(p: f64) -> f64 {
    (-ln(if p < 0.5 { p } else { 1.0 - p })).sqrt()
}

/// [`inverse_normal`] of `p` outside the centre, at a [`distance`] of at most 5.
#[inline(always)]
fn tail(p: f64, distance: f64) -> f64 {
    let size = polynomial(&TAIL_UPPER, distance - 1.6) / polynomial(&TAIL_LOWER, distance - 1.6);
    if p < 0.5 { -size } else { size }
}

/// Distance from 0.5 up to which [`centre`] holds.
const CENTRE: f64 = 0.425;

/// [`inverse_normal`] of `0.5 + q` in the centre.
#[inline(always)]
fn centre(q: f64) -> f64 {
    let r = 0.180_625 - q * q;
    q * polynomial(&CENTRE_UPPER, r) / polynomial(&CENTRE_LOWER, r)
}

#[expect(clippy::excessive_precision, reason = "the digits of the publication")]
const CENTRE_UPPER: [f64; 8] = [
    3.387_132_872_796_366_608,
    133.141_667_891_784_377_45,
    1_971.590_950_306_551_442_7,
    13_731.693_765_509_461_125,
    45_921.953_931_549_871_457,
    67_265.770_927_008_700_853,
    33_430.575_583_588_128_105,
    2_509.080_928_730_122_672_7,
];
#[expect(clippy::excessive_precision, reason = "the digits of the publication")]
const CENTRE_LOWER: [f64; 8] = [
    1.0,
    42.313_330_701_600_911_252,
    687.187_007_492_057_908_3,
    5_394.196_021_424_751_107_7,
    21_213.794_301_586_595_867,
    39_307.895_800_092_710_61,
    28_729.085_735_721_942_674,
    5_226.495_278_852_854_561,
];
#[expect(clippy::excessive_precision, reason = "the digits of the publication")]
const TAIL_UPPER: [f64; 8] = [
    1.423_437_110_749_683_577_34,
    4.630_337_846_156_545_295_9,
    5.769_497_221_460_691_405_5,
    3.647_848_324_763_204_605_04,
    1.270_458_252_452_368_382_58,
    0.241_780_725_177_450_611_77,
    0.022_723_844_989_269_184_583_3,
    7.745_450_142_783_414_076_4e-4,
];
#[expect(clippy::excessive_precision, reason = "the digits of the publication")]
const TAIL_LOWER: [f64; 8] = [
    1.0,
    2.053_191_626_637_758_821_87,
    1.676_384_830_183_803_849_4,
    0.689_767_334_985_100_004_55,
    0.148_103_976_427_480_074_59,
    0.015_198_666_563_616_457_196_6,
    5.475_938_084_995_344_946e-4,
    1.050_750_071_644_416_843_24e-9,
];
#[expect(clippy::excessive_precision, reason = "the digits of the publication")]
const FAR_UPPER: [f64; 8] = [
    6.657_904_643_501_103_777_2,
    5.463_784_911_164_114_369_9,
    1.784_826_539_917_291_335_8,
    0.296_560_571_828_504_891_23,
    0.026_532_189_526_576_123_093,
    0.001_242_660_947_388_078_438_6,
    2.711_555_568_743_487_578_15e-5,
    2.010_334_399_292_288_132_65e-7,
];
#[expect(clippy::excessive_precision, reason = "the digits of the publication")]
const FAR_LOWER: [f64; 8] = [
    1.0,
    0.599_832_206_555_887_937_69,
    0.136_929_880_922_735_805_31,
    0.014_875_361_290_850_614_852_5,
    7.868_691_311_456_132_591e-4,
    1.846_318_317_510_054_681_8e-5,
    1.421_511_758_316_445_888_7e-7,
    2.044_263_103_389_939_785_64e-15,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_is_its_key() {
        let draw = |seed, purpose, step, index| Stream::new(Seed(seed), purpose, step, index).bits();
        let first = draw(1, "noise", 2, 3);
        assert_eq!(first, draw(1, "noise", 2, 3));
        for other in [draw(2, "noise", 2, 3), draw(1, "crop", 2, 3), draw(1, "noise", 3, 3), draw(1, "noise", 2, 4)] {
            assert_ne!(first, other);
        }
    }

    #[test]
    fn the_inverse_matches_known_quantiles() {
        // Quantiles of the standard normal distribution to 15 digits.
        for (p, z) in [
            (0.5, 0.0),
            (0.975, 1.959_963_984_540_054),
            (0.9, 1.281_551_565_544_6),
            (0.001, -3.090_232_306_167_813),
            (1e-12, -7.034_483_825_301_131),
            (1e-5, -4.264_890_793_922_824),
        ] {
            assert!((inverse_normal(p) - z).abs() < 1e-13, "{p}: {} against {z}", inverse_normal(p));
        }
        for x in [1e-300, 1e-9, 0.3, 0.9999, 1.0, 1.5, 7.0, 1e20] {
            assert!((ln(x) - x.ln()).abs() <= 4e-16 * x.ln().abs().max(0.5), "ln {x}");
        }
    }

    #[test]
    fn normal_deviates_have_normal_moments() {
        let mut values = vec![0.0; 200_000];
        Stream::new(Seed(7), "moments", 0, 0).fill_normal(&mut values);
        let n = values.len() as f64;
        let moment = |k: i32| values.iter().map(|v| f64::from(*v).powi(k)).sum::<f64>() / n;
        assert!(moment(1).abs() < 0.01, "mean {}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.015, "variance {}", moment(2));
        assert!((moment(4) - 3.0).abs() < 0.1, "fourth {}", moment(4));
    }

    #[test]
    fn deviates_of_a_block_are_those_of_single_draws() {
        let draws = |fill: fn(&mut Stream, &mut [f32])| {
            let mut values = vec![0.0; 100_037];
            fill(&mut Stream::new(Seed(9), "block", 0, 0), &mut values);
            values
        };
        let together = draws(|stream, values| stream.fill_normal(values));
        assert!(together == draws(|stream, values| values.fill_with(|| stream.normal())));
        let mut ends = [0.5; BLOCK];
        (ends[0], ends[63]) = (0.5 / 4_294_967_296.0, 1.0 - 0.5 / 4_294_967_296.0);
        let expected = ends.map(inverse_normal);
        inverse_normals(&mut ends);
        assert_eq!(ends, expected);
        assert!(distance(0.5 / 4_294_967_296.0) < 5.0);
    }

    #[test]
    fn below_is_even_and_in_range() {
        let mut stream = Stream::new(Seed(1), "below", 0, 0);
        let mut counts = [0_u32; 7];
        for _ in 0..70_000 {
            counts[stream.below(7)] += 1;
        }
        assert!(counts.iter().all(|c| (9_500..10_500).contains(c)), "{counts:?}");
        assert_eq!((stream.below(0), stream.below(1)), (0, 0));
        assert!((0..1000).all(|_| (3.0..4.5).contains(&stream.range(3.0, 4.5))));
    }

    #[test]
    fn a_permutation_visits_everything_once() {
        let order = permutation(Seed(3), "order", 5, 100);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..100).collect::<Vec<_>>());
        assert_ne!(order, permutation(Seed(3), "order", 6, 100));
        assert!(permutation(Seed(3), "order", 0, 0).is_empty());
    }
}
