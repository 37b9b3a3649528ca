//! Matrix products on slices.

mod matrix;
#[cfg(target_arch = "x86_64")]
mod wide;

use std::time::Instant;

use matrix::Product;
pub(super) use matrix::{Start, View};

use super::work::Work;

/// Terms that are summed before they are added to the result. The general product would divide longer sums than 512 by the
/// sizes of the processor's caches, so that the bits depended on them. A panel of so many rows stays in the second-level
/// cache, and shorter sums are more exact.
const TERMS: usize = 256;

impl Product<'_> {
    /// The result as rows of n elements.
    ///
    /// # Panics
    /// If an operand is shorter than its view.
    pub(super) fn made(self) -> Vec<f32> {
        let (m, n, _) = self.sizes;
        let mut c = Vec::with_capacity(m * n);
        if m == 0 || n == 0 {
            return c;
        }
        self.check();
        #[expect(unsafe_code, reason = "the product is written into memory that is not zeroed first")]
        // SAFETY: the extents of the operands were checked, `c` has room for m n elements, and all of them are written.
        unsafe {
            self.count(c.as_mut_ptr(), View::rows(n));
            c.set_len(m * n);
        }
        c
    }

    /// Writes the result into `c`.
    ///
    /// # Panics
    /// If an operand or `c` is shorter than its view.
    pub(super) fn write_to(self, c: &mut [f32], cv: View) {
        let (m, n, _) = self.sizes;
        if m == 0 || n == 0 {
            return;
        }
        self.check();
        assert!(cv.last(m, n) < c.len(), "matrix out of bounds");
        #[expect(unsafe_code, reason = "every extent was checked above")]
        // SAFETY: all elements that the strides reach lie inside the slices, and `c` overlaps no operand because it is
        // borrowed exclusively.
        unsafe {
            self.count(c.as_mut_ptr(), cv);
        }
    }

    /// Computes the product, and counts it in [`Work`].
    ///
    /// # Safety
    /// As for [`multiply`](Self::multiply).
    #[expect(unsafe_code, reason = "the product works on strided pointers")]
    unsafe fn count(self, c: *mut f32, cv: View) {
        let begun = Instant::now();
        // SAFETY: as promised by the caller.
        unsafe { self.multiply(c, cv) };
        Work::add(self.sizes, begun);
    }

    /// Adds up [`TERMS`] terms at a time.
    ///
    /// # Safety
    /// The views lie inside the operands and the memory of `c`, which overlaps neither. `c` is initialised if it is kept.
    #[expect(unsafe_code, reason = "the product works on strided pointers")]
    unsafe fn multiply(self, c: *mut f32, cv: View) {
        let (m, n, k) = self.sizes;
        for top in (0..k).step_by(TERMS) {
            let later = |view: View, by: usize| View { offset: view.offset + top * by, ..view };
            let part = Product {
                sizes: (m, n, (k - top).min(TERMS)),
                a: (self.a.0, later(self.a.1, self.a.1.col)),
                b: (self.b.0, later(self.b.1, self.b.1.row)),
                start: if top == 0 { self.start } else { Start::Kept },
                ..self
            };
            #[cfg(target_arch = "x86_64")]
            if cv.col == 1 && wide::fits(&part) {
                // SAFETY: as promised by the caller; after the first part the result is initialised.
                unsafe { wide::multiply(&part, c, cv) };
                continue;
            }
            // SAFETY: as above.
            unsafe { part.general(c, cv) };
        }
    }

    /// One part of the terms, for all instruction sets and layouts.
    ///
    /// # Safety
    /// As for [`multiply`](Self::multiply).
    #[expect(unsafe_code, reason = "the product works on strided pointers")]
    unsafe fn general(mut self, c: *mut f32, cv: View) {
        let (m, n, k) = self.sizes;
        if let Start::Row(row) = self.start {
            for i in 0..m {
                for (j, value) in row.iter().enumerate() {
                    // SAFETY: the view lies inside the memory of `c`.
                    unsafe { c.add(cv.offset + i * cv.row + j * cv.col).write(*value) };
                }
            }
            self.start = Start::Kept;
        }
        let stride = |s: usize| isize::try_from(s).expect("a stride fits");
        let [(a, av), (b, bv)] = [self.a, self.b];
        let kept = matches!(self.start, Start::Kept);
        // SAFETY: as promised by the caller.
        unsafe {
            gemm::gemm(
                m,
                n,
                k,
                c.add(cv.offset),
                stride(cv.col),
                stride(cv.row),
                kept,
                a.as_ptr().add(av.offset),
                stride(av.col),
                stride(av.row),
                b.as_ptr().add(bv.offset),
                stride(bv.col),
                stride(bv.row),
                1.0,
                self.scale,
                false,
                false,
                false,
                gemm::Parallelism::None,
            );
        }
    }
}

/// `a b` as rows of n elements, with `a` m x k and `b` k x n.
pub(super) fn product(sizes: (usize, usize, usize), a: &[f32], av: View, b: &[f32], bv: View) -> Vec<f32> {
    Product { sizes, a: (a, av), b: (b, bv), scale: 1.0, start: Start::Zero }.made()
}

/// `a b` written to `place` if there is one, and returned otherwise.
pub(super) fn product_to(
    sizes: (usize, usize, usize),
    a: &[f32],
    av: View,
    b: &[f32],
    bv: View,
    place: Option<&mut [f32]>,
) -> Option<Vec<f32>> {
    let product = Product { sizes, a: (a, av), b: (b, bv), scale: 1.0, start: Start::Zero };
    let Some(place) = place else { return Some(product.made()) };
    product.write_to(place, View::rows(sizes.1));
    None
}

/// Adds `scale a b` to what `start` says, with `a` m x k, `b` k x n and `c` m x n.
#[expect(clippy::too_many_arguments, reason = "a matrix product has three matrices and three sizes")]
pub(super) fn matmul(
    sizes: (usize, usize, usize),
    a: &[f32],
    av: View,
    b: &[f32],
    bv: View,
    c: &mut [f32],
    cv: View,
    start: Start<'_>,
    scale: f32,
) {
    Product { sizes, a: (a, av), b: (b, bv), scale, start }.write_to(c, cv);
}

/// `a b` with `row` added to each row of the result, as rows of n elements.
pub(super) fn affine(sizes: (usize, usize, usize), a: &[f32], av: View, b: &[f32], bv: View, row: &[f32]) -> Vec<f32> {
    Product { sizes, a: (a, av), b: (b, bv), scale: 1.0, start: Start::Row(row) }.made()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(count: usize) -> Vec<f32> {
        (0..count).map(|i| (i as f32 * 0.37).sin()).collect()
    }

    /// Checks the products of one size, in both orders of each operand, against sums in f64.
    fn check(sizes @ (m, n, k): (usize, usize, usize)) {
        let (a, b, row, old) = (wave(m * k + 3), wave(k * n), wave(n), wave(m * (n + 2)));
        let shifted = |view: View| View { offset: 3, ..view };
        for av in [shifted(View::rows(k)), shifted(View::rows(m).t())] {
            for bv in [View::rows(n), View::rows(k).t()] {
                let exact = |i: usize, j: usize| -> f64 {
                    let left = |p: usize| f64::from(a[av.offset + i * av.row + p * av.col]);
                    (0..k).map(|p| left(p) * f64::from(b[p * bv.row + j * bv.col])).sum()
                };
                let near = |found: f32, exact: f64, what: &str| {
                    assert!(
                        (f64::from(found) - exact).abs() < 1e-6 * k as f64 + 1e-6,
                        "{sizes:?} {av:?} {bv:?} {what}: {found} {exact}"
                    );
                };
                let zero = product(sizes, &a, av, &b, bv);
                let with_row = affine(sizes, &a, av, &b, bv, &row);
                let cv = View { offset: 1, row: n + 2, col: 1 };
                let mut kept = old.clone();
                kept.push(0.0);
                matmul(sizes, &a, av, &b, bv, &mut kept, cv, Start::Kept, 0.5);
                for i in 0..m {
                    for j in 0..n {
                        near(zero[i * n + j], exact(i, j), "alone");
                        near(with_row[i * n + j], exact(i, j) + f64::from(row[j]), "with a row");
                        let at = cv.offset + i * cv.row + j;
                        near(kept[at], 0.5 * exact(i, j) + f64::from(old[at]), "added");
                    }
                    // Values between the rows of the result stay.
                    for at in cv.offset + i * cv.row + n..((i + 1) * cv.row).min(old.len()) {
                        assert_eq!(kept[at], old[at], "{sizes:?}: beside row {i}");
                    }
                }
            }
        }
    }

    #[test]
    fn products_of_all_layouts_are_sums() {
        for sizes in
            [(1, 1, 1), (8, 16, 1), (9, 17, 5), (25, 33, 16), (31, 48, 40), (14, 70, 96), (40, 130, 17), (9, 20, 600)]
        {
            check(sizes);
        }
        // Rows that fall on the same lines of a cache are packed.
        check((10, 256, 3));
        // The left operand is packed in strips, and the panels pass by its rows in rounds; the last of each is shorter.
        check((1023, 258, 3));
        check((514, 256, 257));
    }

    #[test]
    fn bits_do_not_depend_on_the_order_of_an_operand() {
        let sizes @ (m, n, k) = (1023, 258, 300);
        let (a, b) = (wave(m * k), wave(k * n));
        let turned: Vec<f32> = (0..k * m).map(|i| a[i % m * k + i / m]).collect();
        let [rows, columns] = [(&a, View::rows(k)), (&turned, View::rows(m).t())]
            .map(|(a, view)| product(sizes, a, view, &b, View::rows(n)));
        assert!(rows == columns);
    }

    #[test]
    fn bits_do_not_depend_on_the_place_in_memory() {
        let sizes @ (_, n, k) = (20, 96, 40);
        let (a, b) = (wave(20 * k), wave(n * k));
        let bits = |ahead: usize| {
            let padded: Vec<f32> = std::iter::repeat_n(0.0, ahead).chain(b.iter().copied()).collect();
            let view = View { offset: ahead, ..View::rows(n) };
            product(sizes, &a, View::rows(k), &padded, view)
        };
        // One of sixteen places in a row begins a line of the cache.
        assert!((1..16).all(|ahead| bits(ahead) == bits(0)));
    }

    #[test]
    #[should_panic(expected = "matrix out of bounds")]
    fn an_operand_that_is_too_short_is_refused() {
        product((8, 16, 4), &wave(8 * 4), View::rows(4), &wave(4 * 16 - 1), View::rows(16));
    }
}
