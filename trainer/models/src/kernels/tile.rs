//! Small matrix products whose operands lie in the nearest cache: without packing, on the calling thread. A call costs
//! what its multiplications cost, where the general product spends most of its time on packing.

use super::simd::{LANES, mul_add, set};

/// The left operand: element (i, j) is at `i * row + j * col`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Left<'a> {
    pub(super) values: &'a [f32],
    pub(super) row: usize,
    pub(super) col: usize,
}

/// `c = a b` with `a` m x k, `b` k x n and `c` m x n, whose rows begin `b_row` and `c_row` apart. Each element sums its
/// products in the order of k.
///
/// # Panics
/// If n is not a multiple of [`LANES`], or an operand is shorter than that.
#[inline(always)]
pub(super) fn multiply<const SET: u8>(
    (m, n, k): (usize, usize, usize),
    a: Left<'_>,
    (b, b_row): (&[f32], usize),
    (c, c_row): (&mut [f32], usize),
) {
    if m == 0 || n == 0 {
        return;
    }
    assert!(n.is_multiple_of(LANES) && k > 0, "the shape of a small product");
    let fits = (m - 1) * a.row + (k - 1) * a.col < a.values.len()
        && (k - 1) * b_row + n <= b.len()
        && (m - 1) * c_row + n <= c.len();
    assert!(fits, "matrix out of bounds");
    let left = a.values.as_ptr();
    let right = b.as_ptr();
    let to = c.as_mut_ptr();
    let mut at = 0;
    while at < n {
        let wide = (n - at).min(3 * LANES);
        #[expect(unsafe_code, reason = "checks of every element would take longer than the product")]
        // SAFETY: all elements that the strides reach lie inside the slices, as was checked above.
        unsafe {
            let right = right.add(at);
            let to = to.add(at);
            match wide / LANES {
                1 => columns::<SET, LANES>((m, k), left, (a.row, a.col), (right, b_row), (to, c_row)),
                2 => columns::<SET, { 2 * LANES }>((m, k), left, (a.row, a.col), (right, b_row), (to, c_row)),
                _ => columns::<SET, { 3 * LANES }>((m, k), left, (a.row, a.col), (right, b_row), (to, c_row)),
            }
        }
        at += wide;
    }
}

/// N columns of the product, as many rows at once as the registers hold.
///
/// # Safety
/// As for [`block`], for all m rows.
#[expect(unsafe_code, reason = "the callers check the extents")]
#[inline(always)]
unsafe fn columns<const SET: u8, const N: usize>(
    (m, k): (usize, usize),
    a: *const f32,
    (row, col): (usize, usize),
    (b, b_row): (*const f32, usize),
    (c, c_row): (*mut f32, usize),
) {
    let mut at = 0;
    while at < m {
        // SAFETY: as promised by the caller; the block's rows are among the m.
        unsafe {
            let a = a.add(at * row);
            let c = c.add(at * c_row);
            at += match m - at {
                6.. if SET == set::WIDE => block::<SET, 6, N>(k, a, (row, col), (b, b_row), (c, c_row)),
                4.. => block::<SET, 4, N>(k, a, (row, col), (b, b_row), (c, c_row)),
                2.. => block::<SET, 2, N>(k, a, (row, col), (b, b_row), (c, c_row)),
                _ => block::<SET, 1, N>(k, a, (row, col), (b, b_row), (c, c_row)),
            };
        }
    }
}

/// R rows and N columns of the product, in registers. Returns R.
///
/// # Safety
/// `a` has the elements `r row + i col` for r below R and i below k, `b` N elements from each `i b_row`, and `c` N from
/// each `r c_row`.
#[expect(unsafe_code, reason = "the callers check the extents")]
#[inline(always)]
unsafe fn block<const SET: u8, const R: usize, const N: usize>(
    k: usize,
    a: *const f32,
    (row, col): (usize, usize),
    (b, b_row): (*const f32, usize),
    (c, c_row): (*mut f32, usize),
) -> usize {
    let mut sums = [[0.0_f32; N]; R];
    for i in 0..k {
        // SAFETY: as promised by the caller.
        let line = unsafe { b.add(i * b_row).cast::<[f32; N]>().read_unaligned() };
        for (r, sum) in sums.iter_mut().enumerate() {
            // SAFETY: as promised by the caller.
            let x = unsafe { *a.add(r * row + i * col) };
            for l in 0..N {
                sum[l] = mul_add::<SET>(x, line[l], sum[l]);
            }
        }
    }
    for (r, sum) in sums.iter().enumerate() {
        // SAFETY: as promised by the caller.
        unsafe { c.add(r * c_row).cast::<[f32; N]>().write_unaligned(*sum) };
    }
    R
}

/// Writes the transpose of `rows` x `cols`, whose rows begin `from_row` apart, times `scale`. Rows of `to` are as long
/// as the next multiple of [`LANES`]; what is beyond `rows` in them becomes 0.
#[inline(always)]
pub(super) fn transpose(from: &[f32], from_row: usize, (rows, cols): (usize, usize), scale: f32, to: &mut [f32]) {
    let to_row = rows.next_multiple_of(LANES);
    for at in (0..rows).step_by(LANES) {
        let live = (rows - at).min(LANES);
        let lines: [&[f32]; LANES] = std::array::from_fn(|r| &from[(at + r.min(live - 1)) * from_row..][..cols]);
        let keep: [f32; LANES] = std::array::from_fn(|r| if r < live { scale } else { 0.0 });
        for j in 0..cols {
            let line = &mut to[j * to_row + at..][..LANES];
            for r in 0..LANES {
                line[r] = lines[r][j] * keep[r];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::simd::multiversion;

    multiversion! {
        fn both<const SET>(m: usize, n: usize, k: usize, a: &[f32], by_rows: bool, b: &[f32], c: &mut [f32]) {
            let a = if by_rows { Left { values: a, row: k, col: 1 } } else { Left { values: a, row: 1, col: m } };
            multiply::<SET>((m, n, k), a, (b, n), (c, n));
        }
    }

    #[test]
    fn a_small_product_is_the_product() {
        for (m, n, k) in [(1, 8, 1), (5, 16, 3), (6, 24, 18), (18, 24, 24), (13, 64, 54), (64, 40, 7)] {
            let wave = |count: usize| (0..count).map(|i| (i as f32 * 0.37).sin()).collect::<Vec<_>>();
            let a = wave(m * k);
            let b = wave(k * n);
            for by_rows in [true, false] {
                let mut c = vec![f32::NAN; m * n];
                both(m, n, k, &a, by_rows, &b, &mut c);
                for i in 0..m {
                    for j in 0..n {
                        let at = |l: usize| if by_rows { i * k + l } else { l * m + i };
                        let exact: f64 = (0..k).map(|l| f64::from(a[at(l)]) * f64::from(b[l * n + j])).sum();
                        assert!((f64::from(c[i * n + j]) - exact).abs() < 1e-5, "{m}x{n}x{k}: element ({i}, {j})");
                    }
                }
            }
        }
    }

    #[test]
    fn a_transpose_is_padded_with_zeros() {
        let from: Vec<f32> = (0..3 * 10).map(|i| i as f32 + 1.0).collect();
        let mut to = vec![f32::NAN; 8 * 4];
        transpose(&from, 10, (3, 4), 2.0, &mut to);
        for j in 0..4 {
            for i in 0..8 {
                assert_eq!(to[j * 8 + i], if i < 3 { 2.0 * from[i * 10 + j] } else { 0.0 });
            }
        }
    }
}
