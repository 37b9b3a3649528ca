//! Conversion between Burn tensors and slices, and matrix products on slices.

use burn::tensor::{Tensor, TensorData};

#[cfg(feature = "flex")]
pub(super) use flex::*;

#[cfg(feature = "flex")]
mod flex {
    use std::cell::Cell;

    use burn::backend::autodiff::NodeId;
    use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
    use burn::backend::autodiff::grads::Gradients;
    use burn::backend::flex::FlexTensor;
    use burn::backend::{Autodiff, BackendTypes, Flex};

    use super::{Tensor, TensorData};

    /// The CPU backend under autodiff.
    pub(in crate::kernels) type Tracked = Autodiff<Flex, NoCheckpointing>;

    /// A tensor on the tape.
    pub(in crate::kernels) type OnTape = <Tracked as BackendTypes>::FloatTensorPrimitive;

    /// Backend and tape of a tensor.
    pub(in crate::kernels) enum Place {
        /// On flex, on the tape.
        Tracked,
        /// On flex, without a tape.
        Plain,
        /// On any other backend.
        Other,
    }

    /// Returns true if `x` has a tape.
    pub(in crate::kernels) fn on_tape<const D: usize>(x: &Tensor<D>) -> bool {
        x.clone().try_into_primitive::<Tracked>().is_ok()
    }

    thread_local! {
        static STOCK: Cell<bool> = const { Cell::new(false) };
    }

    /// Runs `body` with every tensor of this thread treated as [`Place::Other`].
    pub(in crate::kernels) fn stock<T>(body: impl FnOnce() -> T) -> T {
        struct Restore(bool);
        impl Drop for Restore {
            fn drop(&mut self) {
                STOCK.set(self.0);
            }
        }
        let _restore = Restore(STOCK.replace(true));
        body()
    }

    /// The place of a call's tensors, from the backend of `x`; they are on the tape if any of them is (`taped`).
    pub(in crate::kernels) fn place<const D: usize>(x: &Tensor<D>, taped: bool) -> Place {
        if STOCK.get() {
            Place::Other
        } else if taped || on_tape(x) {
            Place::Tracked
        } else if x.clone().try_into_primitive::<Flex>().is_ok() {
            Place::Plain
        } else {
            Place::Other
        }
    }

    /// `x` on the tape; a tensor without one takes part as a constant.
    pub(in crate::kernels) fn track<const D: usize>(x: Tensor<D>) -> OnTape {
        match x.clone().try_into_primitive::<Tracked>() {
            Ok(tracked) => tracked,
            Err(_) => OnTape::new(plain(x)),
        }
    }

    /// The elements of `x` without its tape.
    pub(in crate::kernels) fn plain<const D: usize>(x: Tensor<D>) -> FlexTensor {
        match x.clone().try_into_primitive::<Tracked>() {
            Ok(tracked) => tracked.into_primitive(),
            Err(_) => x.try_into_primitive::<Flex>().expect("tensors of one call live on one backend"),
        }
    }

    /// The elements of `x` in row-major order; copies only if `x` is a view.
    pub(in crate::kernels) fn contiguous(x: FlexTensor) -> FlexTensor {
        if x.as_slice::<f32>().is_some() { x } else { x.to_contiguous() }
    }

    /// The elements of a contiguous tensor.
    pub(in crate::kernels) fn slice(x: &FlexTensor) -> &[f32] {
        x.as_slice::<f32>().expect("made contiguous, f32 throughout")
    }

    /// Makes a tensor of `values` in `shape`.
    pub(in crate::kernels) fn make(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
        FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
    }

    /// Adds `values` to the gradient of `node`.
    pub(in crate::kernels) fn register(grads: &mut Gradients, node: NodeId, values: Vec<f32>, shape: &[usize]) {
        grads.register::<Flex>(node, make(values, shape));
    }
}

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

/// `c = keep * c + scale * a b`, with `a` m x k, `b` k x n, `c` m x n. `keep` of 0 does not read `c`.
#[expect(clippy::too_many_arguments, reason = "a matrix product has three matrices and three sizes")]
#[cfg(feature = "flex")]
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
    let stride = |s: usize| isize::try_from(s).expect("a stride fits");
    #[expect(unsafe_code, reason = "the product works on strided pointers; every extent was checked above")]
    // SAFETY: all elements that the strides reach lie inside the slices, and `c` overlaps neither `a` nor `b` because it
    // is borrowed exclusively.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            c.as_mut_ptr().add(cv.offset),
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
