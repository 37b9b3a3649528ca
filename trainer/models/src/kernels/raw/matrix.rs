//! The operands of a matrix product, and where they lie in memory. Not its job: computing it.

/// A matrix inside a slice: element (i, j) is at `offset + i * row + j * col`.
#[derive(Debug, Clone, Copy)]
pub(in crate::kernels) struct View {
    pub(in crate::kernels) offset: usize,
    pub(in crate::kernels) row: usize,
    pub(in crate::kernels) col: usize,
}

impl View {
    /// Rows of `width` elements, one after the other.
    pub(in crate::kernels) fn rows(width: usize) -> Self {
        Self { offset: 0, row: width, col: 1 }
    }

    /// The transpose, as a view with row and column strides swapped.
    pub(in crate::kernels) fn t(self) -> Self {
        Self { offset: self.offset, row: self.col, col: self.row }
    }

    pub(super) fn last(self, rows: usize, cols: usize) -> usize {
        self.offset + (rows - 1) * self.row + (cols - 1) * self.col
    }
}

/// A product to which something may be added: `scale a b`, with `a` m x k and `b` k x n.
#[derive(Debug, Clone, Copy)]
pub(in crate::kernels) struct Product<'a> {
    /// m, n and k.
    pub(in crate::kernels) sizes: (usize, usize, usize),
    pub(in crate::kernels) a: (&'a [f32], View),
    pub(in crate::kernels) b: (&'a [f32], View),
    pub(in crate::kernels) scale: f32,
    pub(in crate::kernels) start: Start<'a>,
}

/// The values to which a product is added.
#[derive(Debug, Clone, Copy)]
pub(in crate::kernels) enum Start<'a> {
    /// Nothing; the result's old values are not read.
    Zero,
    /// The result's old values.
    Kept,
    /// The same row for each row of the result. The product is not scaled.
    Row(&'a [f32]),
}

impl Product<'_> {
    /// # Panics
    /// If an operand is shorter than its view.
    pub(super) fn check(&self) {
        let (m, n, k) = self.sizes;
        let [(a, av), (b, bv)] = [self.a, self.b];
        assert!(k > 0 && av.last(m, k) < a.len() && bv.last(k, n) < b.len(), "matrix out of bounds");
        if let Start::Row(row) = self.start {
            assert!(row.len() == n && self.scale == 1.0, "a row for each column");
        }
    }
}
