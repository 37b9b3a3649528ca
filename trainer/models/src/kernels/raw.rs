//! Matrix products on slices.

/// A matrix inside a slice: element (i, j) is at `offset + i * row + j * col`.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    pub(super) offset: usize,
    pub(super) row: usize,
    pub(super) col: usize,
}

impl View {
    /// Rows of `width` elements, one after the other.
    pub(super) fn rows(width: usize) -> Self {
        Self { offset: 0, row: width, col: 1 }
    }

    /// The transpose, as a view with row and column strides swapped.
    pub(super) fn t(self) -> Self {
        Self { offset: self.offset, row: self.col, col: self.row }
    }

    fn last(self, rows: usize, cols: usize) -> usize {
        self.offset + (rows - 1) * self.row + (cols - 1) * self.col
    }
}

/// `a b` as rows of n elements, with `a` m x k and `b` k x n.
pub(super) fn product((m, n, k): (usize, usize, usize), a: &[f32], av: View, b: &[f32], bv: View) -> Vec<f32> {
    let mut c = Vec::with_capacity(m * n);
    if m == 0 || n == 0 {
        return c;
    }
    assert!(k > 0 && av.last(m, k) < a.len() && bv.last(k, n) < b.len(), "matrix out of bounds");
    #[expect(unsafe_code, reason = "the product is written into memory that is not zeroed first")]
    // SAFETY: the extents of `a` and `b` were checked, `c` has room for m n elements, and a product with k > 0 that does
    // not read `c` writes all of them.
    unsafe {
        multiply((m, n, k), a, av, b, bv, c.as_mut_ptr(), View::rows(n), 0.0, 1.0);
        c.set_len(m * n);
    }
    c
}

/// `c = keep * c + scale * a b`, with `a` m x k, `b` k x n, `c` m x n. `keep` of 0 does not read `c`.
#[expect(clippy::too_many_arguments, reason = "a matrix product has three matrices and three sizes")]
pub(super) fn matmul(
    (m, n, k): (usize, usize, usize),
    a: &[f32],
    av: View,
    b: &[f32],
    bv: View,
    c: &mut [f32],
    cv: View,
    keep: f32,
    scale: f32,
) {
    if m == 0 || n == 0 {
        return;
    }
    assert!(
        k > 0 && av.last(m, k) < a.len() && bv.last(k, n) < b.len() && cv.last(m, n) < c.len(),
        "matrix out of bounds"
    );
    #[expect(unsafe_code, reason = "every extent was checked above")]
    // SAFETY: all elements that the strides reach lie inside the slices, and `c` overlaps neither `a` nor `b` because it
    // is borrowed exclusively.
    unsafe {
        multiply((m, n, k), a, av, b, bv, c.as_mut_ptr(), cv, keep, scale);
    }
}

/// # Safety
/// The views lie inside `a`, `b` and the memory of `c`, which overlaps neither. `c` is initialised unless `keep` is 0.
#[expect(clippy::too_many_arguments, reason = "a matrix product has three matrices and three sizes")]
#[expect(unsafe_code, reason = "the product works on strided pointers")]
unsafe fn multiply(
    (m, n, k): (usize, usize, usize),
    a: &[f32],
    av: View,
    b: &[f32],
    bv: View,
    c: *mut f32,
    cv: View,
    keep: f32,
    scale: f32,
) {
    let stride = |s: usize| isize::try_from(s).expect("a stride fits");
    // SAFETY: as promised by the caller.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            c.add(cv.offset),
            stride(cv.col),
            stride(cv.row),
            keep != 0.0,
            a.as_ptr().add(av.offset),
            stride(av.col),
            stride(av.row),
            b.as_ptr().add(bv.offset),
            stride(bv.col),
            stride(bv.row),
            keep,
            scale,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}
