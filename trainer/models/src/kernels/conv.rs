//! Convolutions over time and their transposes, on [B, T, C] and with weights as published checkpoints store them.
//!
//! The fused path gathers the windows of a sequence as rows of a matrix, and multiplies it by the weights. Backward
//! passes gather the windows again, so that they do not stay in memory.

use burn::tensor::Tensor;
use burn::tensor::module::{conv_transpose1d, conv1d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};

#[cfg(feature = "flex")]
use super::fused;
use super::linear;

/// How a window moves over a sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sweep {
    /// Frames from one window to the next.
    pub stride: usize,
    /// Frames from one tap of a window to the next.
    pub dilation: usize,
    /// Frames of zeros on either side of the sequence.
    pub padding: usize,
}

impl Sweep {
    /// Frames from the first to the last tap of a window.
    fn reach(self, taps: usize) -> usize {
        self.dilation * (taps - 1)
    }

    /// Windows of a sequence.
    fn windows(self, frames: usize, taps: usize) -> usize {
        let reach = self.reach(taps);
        let padded = frames + 2 * self.padding;
        assert!(padded > reach, "{frames} frames are shorter than a window of {}", reach + 1);
        (padded - reach - 1) / self.stride + 1
    }

    /// Frames of a sequence with `windows` windows: the fewest.
    fn frames(self, windows: usize, taps: usize) -> usize {
        (windows - 1) * self.stride + self.reach(taps) + 1 - 2 * self.padding
    }
}

/// Convolution of `x_btc` [B, T, in] with `weight` [out, in, taps] and `bias` [out] -> [B, T', out], where `T' = (T + 2
/// padding - dilation (taps - 1) - 1) / stride + 1`.
///
/// # Panics
/// If the padded sequence is shorter than a window.
pub fn conv(x_btc: Tensor<3>, weight: Tensor<3>, bias: Option<Tensor<1>>, sweep: Sweep) -> Tensor<3> {
    let [out, inner, taps] = weight.dims();
    let Sweep { stride, dilation, padding } = sweep;
    if (taps, stride, padding) == (1, 1, 0) {
        return linear(x_btc, weight.reshape([out, inner]), bias);
    }
    #[cfg(feature = "flex")]
    if fused::takes(&x_btc) {
        return match bias {
            Some(bias) => fused::run(kernel::Conv(sweep), [x_btc.into(), weight.into(), bias.into()]),
            None => fused::run(kernel::Conv(sweep), [x_btc.into(), weight.into()]),
        };
    }
    let options = ConvOptions::new([stride], [padding], [dilation], 1);
    conv1d(x_btc.swap_dims(1, 2), weight, bias, options).swap_dims(1, 2)
}

/// The transpose of [`conv`] from [B, T, in] to [B, T', out] with `weight` [in, out, taps], plus `bias` [out]. `T' = (T -
/// 1) stride + dilation (taps - 1) + 1 - 2 padding`.
pub fn transposed_conv(x_btc: Tensor<3>, weight: Tensor<3>, bias: Tensor<1>, sweep: Sweep) -> Tensor<3> {
    #[cfg(feature = "flex")]
    if fused::takes(&x_btc) {
        return fused::run(kernel::Transposed(sweep), [x_btc.into(), weight.into(), bias.into()]);
    }
    let Sweep { stride, dilation, padding } = sweep;
    let options = ConvTransposeOptions::new([stride], [padding], [0], [dilation], 1);
    conv_transpose1d(x_btc.swap_dims(1, 2), weight, Some(bias), options).swap_dims(1, 2)
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use super::Sweep;
    use crate::kernels::fused::{Fused, Places, column_sums, make, shape, slice};
    use crate::kernels::raw::{View, affine, product};
    use crate::kernels::simd::{multiversion, repeat_row};

    /// A convolution, with a bias if there are three inputs.
    #[derive(Debug, Clone)]
    pub(super) struct Conv(pub(super) Sweep);

    /// A transposed convolution.
    #[derive(Debug, Clone)]
    pub(super) struct Transposed(pub(super) Sweep);

    /// Sizes of a convolution's windows: `count` in each of `batch` sequences of `frames` frames.
    #[derive(Debug, Clone, Copy)]
    struct Windows {
        sweep: Sweep,
        batch: usize,
        frames: usize,
        count: usize,
        taps: usize,
        channels: usize,
    }

    impl Windows {
        fn rows(&self) -> usize {
            self.batch * self.count
        }

        fn width(&self) -> usize {
            self.taps * self.channels
        }

        /// The taps of window `t` that lie on frames of the sequence.
        fn live(&self, t: usize) -> std::ops::Range<usize> {
            let Sweep { stride, dilation, padding } = self.sweep;
            let start = t * stride;
            let first = padding.saturating_sub(start).div_ceil(dilation).min(self.taps);
            let end = (self.frames + padding).saturating_sub(start).div_ceil(dilation).clamp(first, self.taps);
            first..end
        }

        /// The frame of tap `k` of window `t`, which is one of the sequence.
        fn frame(&self, t: usize, k: usize) -> usize {
            t * self.sweep.stride + k * self.sweep.dilation - self.sweep.padding
        }

        /// The windows of `x` [batch, frames, channels] as rows [batch count, taps channels].
        fn gather(&self, x: &[f32]) -> Vec<f32> {
            let channels = self.channels;
            let mut rows = Vec::with_capacity(self.rows() * self.width());
            for x in x.chunks_exact(self.frames * channels) {
                for t in 0..self.count {
                    let live = self.live(t);
                    let end = rows.len() + self.width();
                    rows.resize(rows.len() + live.start * channels, 0.0);
                    if self.sweep.dilation == 1 && !live.is_empty() {
                        let from = self.frame(t, live.start) * channels;
                        rows.extend_from_slice(&x[from..from + live.len() * channels]);
                    } else {
                        for k in live {
                            let from = self.frame(t, k) * channels;
                            rows.extend_from_slice(&x[from..from + channels]);
                        }
                    }
                    rows.resize(end, 0.0);
                }
            }
            rows
        }
    }

    multiversion! {
        /// Adds rows [batch count, taps channels] to the frames of `x` [batch, frames, channels] that their windows cover.
        fn scatter(windows: &Windows, rows: &[f32], x: &mut [f32]) {
            let channels = windows.channels;
            let width = windows.width();
            let of_sequences = rows.chunks_exact(windows.count * width);
            for (x, rows) in x.chunks_exact_mut(windows.frames * channels).zip(of_sequences) {
                for (t, row) in rows.chunks_exact(width).enumerate() {
                    for k in windows.live(t) {
                        let to = windows.frame(t, k) * channels;
                        for (x, add) in x[to..to + channels].iter_mut().zip(&row[k * channels..(k + 1) * channels]) {
                            *x += *add;
                        }
                    }
                }
            }
        }
    }

    /// [outer, channels, taps] -> [outer, taps, channels].
    fn taps_first(weight: &[f32], channels: usize, taps: usize) -> Vec<f32> {
        let mut out = vec![0.0; weight.len()];
        match taps {
            3 => turn::<3>(weight, channels, &mut out),
            4 => turn::<4>(weight, channels, &mut out),
            5 => turn::<5>(weight, channels, &mut out),
            _ => {
                for (i, w) in weight.iter().enumerate() {
                    let (row, at) = (i / (channels * taps), i % (channels * taps));
                    out[(row * taps + at % taps) * channels + at / taps] = *w;
                }
            }
        }
        out
    }

    /// A gradient [outer, taps, channels] as one of `shape` [outer, channels, taps]: written to `place` if there is one, and
    /// returned otherwise.
    fn taps_last(gradient: &[f32], shape: &[usize], place: Option<&mut [f32]>) -> Option<FlexTensor> {
        let Some(place) = place else {
            let mut out = vec![0.0; gradient.len()];
            turn_all_back(gradient, shape, &mut out);
            return Some(make(out, shape));
        };
        turn_all_back(gradient, shape, place);
        None
    }

    fn turn_all_back(weight: &[f32], shape: &[usize], out: &mut [f32]) {
        let [_, channels, taps] = *shape else { unreachable!("a weight has three axes") };
        match taps {
            3 => turn_back::<3>(weight, channels, out),
            4 => turn_back::<4>(weight, channels, out),
            5 => turn_back::<5>(weight, channels, out),
            _ => {
                for (i, out) in out.iter_mut().enumerate() {
                    let (row, at) = (i / (channels * taps), i % (channels * taps));
                    *out = weight[(row * taps + at % taps) * channels + at / taps];
                }
            }
        }
    }

    /// The common numbers of taps are constants, so that the compiler can vectorise.
    fn turn<const TAPS: usize>(weight: &[f32], channels: usize, out: &mut [f32]) {
        for (weight, out) in weight.chunks_exact(channels * TAPS).zip(out.chunks_exact_mut(channels * TAPS)) {
            let mut parts = out.chunks_exact_mut(channels);
            let parts: [&mut [f32]; TAPS] = std::array::from_fn(|_| parts.next().expect("a part a tap"));
            for (c, taps) in weight.as_chunks::<TAPS>().0.iter().enumerate() {
                for k in 0..TAPS {
                    parts[k][c] = taps[k];
                }
            }
        }
    }

    fn turn_back<const TAPS: usize>(weight: &[f32], channels: usize, out: &mut [f32]) {
        for (weight, out) in weight.chunks_exact(channels * TAPS).zip(out.chunks_exact_mut(channels * TAPS)) {
            let mut parts = weight.chunks_exact(channels);
            let parts: [&[f32]; TAPS] = std::array::from_fn(|_| parts.next().expect("a part a tap"));
            for (c, taps) in out.as_chunks_mut::<TAPS>().0.iter_mut().enumerate() {
                for k in 0..TAPS {
                    taps[k] = parts[k][c];
                }
            }
        }
    }

    impl Conv {
        fn windows(&self, x: &FlexTensor, w: &FlexTensor) -> Windows {
            let [batch, frames, channels] = shape(x)[..] else { unreachable!("a sequence has three axes") };
            let taps = shape(w)[2];
            Windows { sweep: self.0, batch, frames, count: self.0.windows(frames, taps), taps, channels }
        }

        fn value(&self, x: &FlexTensor, w: &FlexTensor, bias: Option<&FlexTensor>) -> FlexTensor {
            let windows = self.windows(x, w);
            let (out, width) = (shape(w)[0], windows.width());
            let rows = windows.gather(slice(x));
            let weight = taps_first(slice(w), windows.channels, windows.taps);
            let sizes = (windows.rows(), out, width);
            let (a, b) = (View::rows(width), View::rows(width).t());
            let y = match bias {
                Some(bias) => affine(sizes, &rows, a, &weight, b, slice(bias)),
                None => product(sizes, &rows, a, &weight, b),
            };
            make(y, &[windows.batch, windows.count, out])
        }

        /// The gradients of input and weight; the weight's is written to its place if there is one.
        fn gradients(
            &self,
            x: &FlexTensor,
            w: &FlexTensor,
            dy: &[f32],
            wanted: [bool; 2],
            place: Option<&mut [f32]>,
        ) -> [Option<FlexTensor>; 2] {
            let windows = self.windows(x, w);
            let (out, width) = (shape(w)[0], windows.width());
            let dx = || {
                let weight = taps_first(slice(w), windows.channels, windows.taps);
                let rows = product((windows.rows(), width, out), dy, View::rows(out), &weight, View::rows(width));
                let mut dx = vec![0.0; slice(x).len()];
                scatter(&windows, &rows, &mut dx);
                make(dx, &shape(x))
            };
            let dw = || {
                let rows = windows.gather(slice(x));
                let dw = product((out, width, windows.rows()), dy, View::rows(out).t(), &rows, View::rows(width));
                taps_last(&dw, &shape(w), place)
            };
            [wanted[0].then(dx), wanted[1].then(dw).flatten()]
        }
    }

    impl Fused<2> for Conv {
        type Kept = (FlexTensor, FlexTensor);

        fn forward(&self, [x, w]: [FlexTensor; 2]) -> (FlexTensor, Self::Kept) {
            (Conv::value(self, &x, &w, None), (x, w))
        }

        fn backward_to(
            &self,
            (x, w): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 2],
            [_, place]: Places<'_, 2>,
        ) -> [Option<FlexTensor>; 2] {
            self.gradients(&x, &w, slice(&dy), wanted, place)
        }
    }

    impl Fused<3> for Conv {
        type Kept = (FlexTensor, FlexTensor);

        fn forward(&self, [x, w, bias]: [FlexTensor; 3]) -> (FlexTensor, Self::Kept) {
            (Conv::value(self, &x, &w, Some(&bias)), (x, w))
        }

        fn backward_to(
            &self,
            (x, w): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 3],
            [_, of_weight, of_bias]: Places<'_, 3>,
        ) -> [Option<FlexTensor>; 3] {
            let dy = slice(&dy);
            let [dx, dw] = self.gradients(&x, &w, dy, [wanted[0], wanted[1]], of_weight);
            [dx, dw, wanted[2].then(|| column_sums(dy, shape(&w)[0], of_bias)).flatten()]
        }
    }

    impl Transposed {
        /// The windows are those of the longer sequence, the output.
        fn windows(&self, x: &FlexTensor, w: &FlexTensor) -> Windows {
            let [batch, count, _] = shape(x)[..] else { unreachable!("a sequence has three axes") };
            let [_, channels, taps] = shape(w)[..] else { unreachable!("a weight has three axes") };
            Windows { sweep: self.0, batch, frames: self.0.frames(count, taps), count, taps, channels }
        }
    }

    impl Fused<3> for Transposed {
        type Kept = (FlexTensor, FlexTensor);

        fn forward(&self, [x, w, bias]: [FlexTensor; 3]) -> (FlexTensor, Self::Kept) {
            let windows = self.windows(&x, &w);
            let (inner, width) = (shape(&w)[0], windows.width());
            let weight = taps_first(slice(&w), windows.channels, windows.taps);
            let rows =
                product((windows.rows(), width, inner), slice(&x), View::rows(inner), &weight, View::rows(width));
            let mut y = repeat_row(slice(&bias), windows.batch * windows.frames);
            scatter(&windows, &rows, &mut y);
            (make(y, &[windows.batch, windows.frames, windows.channels]), (x, w))
        }

        fn backward_to(
            &self,
            (x, w): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 3],
            [_, of_weight, of_bias]: Places<'_, 3>,
        ) -> [Option<FlexTensor>; 3] {
            let windows = self.windows(&x, &w);
            let (inner, width) = (shape(&w)[0], windows.width());
            let rows = windows.gather(slice(&dy));
            let dx = || {
                let weight = taps_first(slice(&w), windows.channels, windows.taps);
                let sizes = (windows.rows(), inner, width);
                make(product(sizes, &rows, View::rows(width), &weight, View::rows(width).t()), &shape(&x))
            };
            let dw = || {
                let sizes = (inner, width, windows.rows());
                let dw = product(sizes, slice(&x), View::rows(inner).t(), &rows, View::rows(width));
                taps_last(&dw, &shape(&w), of_weight)
            };
            let bias = || column_sums(slice(&dy), windows.channels, of_bias);
            [wanted[0].then(dx), wanted[1].then(dw).flatten(), wanted[2].then(bias).flatten()]
        }
    }
}
