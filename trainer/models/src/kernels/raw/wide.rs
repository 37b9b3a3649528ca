//! Matrix products for AVX-512. The right operand is packed in panels of up to 64 columns, which the nearest caches hold;
//! a block of the result stays in registers. The general product always packs the left operand too, which takes longer
//! than it saves at the sizes of small networks. Here it is packed if it is transposed and wide.

use std::arch::x86_64::{
    __m512, __mmask16, _MM_HINT_T0, _mm_prefetch, _mm512_add_ps, _mm512_fmadd_ps, _mm512_loadu_ps,
    _mm512_mask_storeu_ps, _mm512_maskz_loadu_ps, _mm512_mul_ps, _mm512_permutex2var_ps, _mm512_set1_ps,
    _mm512_setr_epi32, _mm512_setzero_ps, _mm512_storeu_ps,
};
use std::cell::RefCell;
use std::ops::Range;

use super::matrix::{Product, Start, View};

/// Numbers in a register.
const LANES: usize = 16;
/// Registers in a row of a panel, at most.
const ACROSS: usize = 4;
/// Rows of the left operand from which packing the right one pays.
const LEAST_ROWS: usize = 8;

/// Returns true if the product is faster here than the general one.
pub(super) fn fits(product: &Product<'_>) -> bool {
    let (m, n, _) = product.sizes;
    let right = product.b.1;
    crate::kernels::simd::has_wide() && m >= LEAST_ROWS && n >= LANES && (right.col == 1 || right.row == 1)
}

/// A register's numbers in one line of the caches.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([f32; LANES]);

thread_local! {
    /// The packed panel.
    static PANEL: RefCell<Vec<Line>> = const { RefCell::new(Vec::new()) };
    /// The packed left operand.
    static LEFT: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Rows of the left operand that are packed together: whole blocks of any height.
const STRIP: usize = 48;
/// Strips whose terms a second-level cache holds, while all panels pass by.
const STRIPS: usize = 10;
/// Terms from which the result's place is fetched while a block is summed.
const LONG: usize = 64;
/// Columns of the right operand from which packing the left one pays, and distance of the left one's terms.
const PACKS_LEFT: (usize, usize) = (256, 512);

/// The left operand, as it lies or packed in strips of k rows of [`STRIP`] elements.
#[derive(Clone, Copy)]
struct Left<'a> {
    values: &'a [f32],
    view: View,
    is_packed: bool,
}

impl<'a> Left<'a> {
    /// Packs the left operand into `room` if its terms lie far apart: they would share a few lines of the caches.
    fn of(product: &Product<'a>, room: &'a mut Vec<f32>) -> Self {
        let (m, n, k) = product.sizes;
        let (values, view) = product.a;
        if view.row != 1 || n < PACKS_LEFT.0 || view.col < PACKS_LEFT.1 {
            return Self { values, view, is_packed: false };
        }
        room.resize(m.next_multiple_of(STRIP) * k, 0.0);
        for (first, strip) in (0..m).step_by(STRIP).zip(room.chunks_exact_mut(STRIP * k)) {
            let live = (m - first).min(STRIP);
            for (p, row) in strip.chunks_exact_mut(STRIP).enumerate() {
                let at = view.offset + first + p * view.col;
                row[..live].copy_from_slice(&values[at..at + live]);
            }
        }
        Self { values: room, view: View::rows(STRIP).t(), is_packed: true }
    }

    /// The offset of the first term of row `i`, of `k` terms.
    fn offset(self, i: usize, k: usize) -> usize {
        if self.is_packed { i / STRIP * STRIP * k + i % STRIP } else { self.view.offset + i * self.view.row }
    }
}

/// Computes the product into `c`, whose rows are contiguous.
///
/// # Safety
/// [`fits`] holds. The views lie inside their slices and the memory of `c`, which overlaps neither operand. `c` is
/// initialised if the product keeps some of it.
#[expect(unsafe_code, reason = "the product works on strided pointers")]
pub(super) unsafe fn multiply(product: &Product<'_>, c: *mut f32, cv: View) {
    let packed = |panel: &mut Vec<Line>, room: &mut Vec<f32>| {
        let left = Left::of(product, room);
        let (m, n, k) = product.sizes;
        let kept = if m > STRIPS * STRIP { n.div_ceil(LANES).next_multiple_of(ACROSS) } else { ACROSS };
        panel.resize(k * kept, Line([0.0; LANES]));
        let count = panel.len() * LANES;
        // SAFETY: a line is nothing but its numbers; the rest is as promised by the caller.
        unsafe {
            let panel = std::slice::from_raw_parts_mut(panel.as_mut_ptr().cast::<f32>(), count);
            by_panels(product, left, c, cv, panel);
        }
    };
    PANEL.with_borrow_mut(|panel| LEFT.with_borrow_mut(|room| packed(panel, room)));
}

/// # Safety
/// As for [`multiply`]; `panel` has room for k rows of [`ACROSS`] registers, or of all columns if there are several
/// rounds.
#[expect(unsafe_code, reason = "the product works on strided pointers")]
unsafe fn by_panels(product: &Product<'_>, left: Left<'_>, c: *mut f32, cv: View, panel: &mut [f32]) {
    let (m, n, k) = product.sizes;
    let registers = n.div_ceil(LANES);
    let panels = registers.div_ceil(ACROSS);
    // All panels pass by a part of the rows in each round.
    let rounds = m.div_ceil(STRIPS * STRIP);
    let height = m.div_ceil(rounds).next_multiple_of(STRIP);
    for top in (0..m).step_by(height) {
        let range = top..(top + height).min(m);
        let mut first = 0;
        for i in 0..panels {
            // Panels are as equal as possible.
            let across = registers / panels + usize::from(i < registers % panels);
            let from = first * LANES;
            let columns = (across * LANES).min(n - from);
            // SAFETY: `fits` detected the features; the panel has room for k rows of `across` registers; columns lie
            // below n, and the rest is as promised by the caller.
            unsafe {
                let (b, view) = product.b;
                let right = if lies_well(b, view, from, columns) {
                    (b.as_ptr().add(view.offset + from), view.row)
                } else {
                    let at = if rounds > 1 { from * k } else { 0 };
                    let panel = &mut panel[at..at + k * across * LANES];
                    if top == 0 || rounds == 1 {
                        pack(product.b, (k, columns), from, across * LANES, panel);
                    }
                    (panel.as_ptr(), across * LANES)
                };
                let to = c.add(cv.offset + from);
                let range = range.clone();
                match across {
                    1 => rows::<12, 1>(product, left, range, (from, columns, k), right, to, cv.row),
                    2 => rows::<12, 2>(product, left, range, (from, columns, k), right, to, cv.row),
                    3 => rows::<8, 3>(product, left, range, (from, columns, k), right, to, cv.row),
                    _ => rows::<6, 4>(product, left, range, (from, columns, k), right, to, cv.row),
                }
            }
            first += across;
        }
    }
}

/// Returns true if `columns` columns of the right operand from `from` on may be read where they lie. They are then whole
/// lines of the cache, and their rows do not share a few lines.
fn lies_well(b: &[f32], view: View, from: usize, columns: usize) -> bool {
    /// Distances of rows that are multiples of it share the lines of a cache.
    const CONFLICT: usize = 256;
    let is_whole = |elements: usize| elements.is_multiple_of(LANES);
    let begins_line = b.as_ptr().wrapping_add(view.offset + from).cast::<Line>().is_aligned();
    view.col == 1 && begins_line && is_whole(columns) && is_whole(view.row) && !view.row.is_multiple_of(CONFLICT)
}

/// Copies `columns` columns of the right operand from column `from` on into rows of `width`, with zeros behind them.
///
/// # Safety
/// The processor has AVX-512, and the view lies inside the slice.
#[expect(unsafe_code, reason = "loads go through pointers")]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
unsafe fn pack((b, view): (&[f32], View), (k, columns): (usize, usize), from: usize, width: usize, panel: &mut [f32]) {
    let panel = &mut panel[..k * width];
    if view.col == 1 {
        for (p, row) in panel.chunks_exact_mut(width).enumerate() {
            let at = view.offset + p * view.row + from;
            let (live, rest) = row.split_at_mut(columns);
            live.copy_from_slice(&b[at..at + columns]);
            rest.fill(0.0);
        }
        return;
    }
    // The columns are contiguous: squares of 16 x 16 are transposed.
    for left in (0..width).step_by(LANES) {
        for top in (0..k).step_by(LANES) {
            let high = (k - top).min(LANES);
            let mask = __mmask16::MAX >> (LANES - high);
            let mut square = [_mm512_setzero_ps(); LANES];
            for (j, column) in square.iter_mut().enumerate().take(columns.saturating_sub(left)) {
                let at = view.offset + (from + left + j) * view.col + top;
                debug_assert!(at + high <= b.len(), "inside the operand");
                // SAFETY: the column has `high` more elements, and the mask leaves out the rest.
                *column = unsafe { _mm512_maskz_loadu_ps(mask, b.as_ptr().add(at)) };
            }
            transpose(&mut square);
            for (i, row) in square.iter().take(high).enumerate() {
                let to = &mut panel[(top + i) * width + left..][..LANES];
                // SAFETY: there are 16 elements.
                unsafe { _mm512_storeu_ps(to.as_mut_ptr(), *row) };
            }
        }
    }
}

/// Transposes a square of 16 registers: each of four rounds interleaves the rows of one half with those of the other.
#[inline]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
fn transpose(square: &mut [__m512; LANES]) {
    let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    let high = _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    for _ in 0..LANES.ilog2() {
        let from = *square;
        for (i, pair) in square.chunks_exact_mut(2).enumerate() {
            pair[0] = _mm512_permutex2var_ps(from[i], low, from[i + LANES / 2]);
            pair[1] = _mm512_permutex2var_ps(from[i], high, from[i + LANES / 2]);
        }
    }
}

/// The rows `range` of `columns` columns of the result: R at once, then the rest.
///
/// # Safety
/// As for [`block`], for all of these rows.
#[expect(unsafe_code, reason = "the callers check the extents")]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
unsafe fn rows<const R: usize, const V: usize>(
    product: &Product<'_>,
    left: Left<'_>,
    range: Range<usize>,
    (from, columns, k): (usize, usize, usize),
    (b, b_row): (*const f32, usize),
    c: *mut f32,
    c_row: usize,
) {
    let View { row: a_row, col: a_col, .. } = left.view;
    let mut i = range.start;
    while i < range.end {
        // SAFETY: as promised by the caller; the block's rows are among these.
        unsafe {
            let a = left.values.as_ptr().add(left.offset(i, k));
            let c = c.add(i * c_row);
            let place = Place { a, a_row, a_col, b, b_row, c, c_row };
            i += match range.end - i {
                left if left >= R => block::<R, V>(product, (columns, k), from, place),
                4.. => block::<4, V>(product, (columns, k), from, place),
                2.. => block::<2, V>(product, (columns, k), from, place),
                _ => block::<1, V>(product, (columns, k), from, place),
            };
        }
    }
}

/// Addresses of the operands and of the result of a block.
#[derive(Clone, Copy)]
struct Place {
    a: *const f32,
    a_row: usize,
    a_col: usize,
    b: *const f32,
    b_row: usize,
    c: *mut f32,
    c_row: usize,
}

/// R rows of the result, V registers wide; only `columns` columns exist. Returns R.
///
/// # Safety
/// The processor has AVX-512. `a` has the elements `r a_row + p a_col` for r below R and p below k. `b` has V registers
/// from each `p b_row` on. `c` has `columns` elements from each `r c_row` on.
#[expect(unsafe_code, reason = "the callers check the extents")]
#[inline]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
unsafe fn block<const R: usize, const V: usize>(
    product: &Product<'_>,
    (columns, k): (usize, usize),
    from: usize,
    at: Place,
) -> usize {
    let live = |v: usize| __mmask16::MAX >> (LANES - (columns - v * LANES).min(LANES));
    let mut sums = [[_mm512_setzero_ps(); V]; R];
    // SAFETY: as promised by the caller; masks leave out the columns that do not exist, and a prefetch may be of anything.
    unsafe {
        if k >= LONG {
            for r in 0..R {
                for v in 0..V {
                    _mm_prefetch::<_MM_HINT_T0>(at.c.wrapping_add(r * at.c_row + v * LANES).cast());
                }
            }
        }
        for p in 0..k {
            let mut right = [_mm512_setzero_ps(); V];
            for (v, right) in right.iter_mut().enumerate() {
                *right = _mm512_loadu_ps(at.b.add(p * at.b_row + v * LANES));
            }
            for (r, sum) in sums.iter_mut().enumerate() {
                let left = _mm512_set1_ps(*at.a.add(r * at.a_row + p * at.a_col));
                for v in 0..V {
                    sum[v] = _mm512_fmadd_ps(left, right[v], sum[v]);
                }
            }
        }
        let scale = _mm512_set1_ps(product.scale);
        for (r, sum) in sums.iter().enumerate() {
            for (v, sum) in sum.iter().enumerate() {
                let to = at.c.add(r * at.c_row + v * LANES);
                let mut sum = *sum;
                if product.scale != 1.0 {
                    sum = _mm512_mul_ps(sum, scale);
                }
                match product.start {
                    Start::Zero => {}
                    Start::Kept => sum = _mm512_add_ps(sum, _mm512_maskz_loadu_ps(live(v), to)),
                    Start::Row(row) => {
                        let of = row.as_ptr().add(from + v * LANES);
                        sum = _mm512_add_ps(sum, _mm512_maskz_loadu_ps(live(v), of));
                    }
                }
                _mm512_mask_storeu_ps(to, live(v), sum);
            }
        }
    }
    R
}
