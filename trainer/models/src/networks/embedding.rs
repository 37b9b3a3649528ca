//! Sinusoids of timesteps and guidance scales. Source: diffusers' `Timesteps` (cosines first) as MLD configures it, and
//! the LCM script's guidance embedding (sines first, other denominator, argument times 1000).
//!
//! Both are computed in f32 from the frequencies on, like the originals. Arguments reach 15,000, and networks were
//! trained with the rounding that follows.

use std::cell::RefCell;
use std::collections::HashMap;

use burn::tensor::{Device, Tensor, TensorData};

use crate::diffusion::TIMESTEPS;

/// [B, width]: `[cos(t f) | sin(t f)]` with `f_i = 10000^(-i / (width / 2))`. A thread computes each row once.
pub fn time_sinusoid(timesteps: &[usize], width: usize, device: &Device) -> Tensor<2> {
    thread_local! {
        /// Rows by width and timestep.
        static ROWS: RefCell<HashMap<(usize, usize), Vec<f32>>> = RefCell::default();
    }
    let mut values = Vec::with_capacity(timesteps.len() * width);
    ROWS.with_borrow_mut(|rows| {
        for t in timesteps {
            #[expect(clippy::cast_precision_loss, reason = "timesteps are below 1000")]
            let make = || time_rows(&[*t as f32], width);
            if *t < TIMESTEPS {
                values.extend_from_slice(rows.entry((width, *t)).or_insert_with(make));
            } else {
                values.extend(make());
            }
        }
    });
    Tensor::from_data(TensorData::new(values, [timesteps.len(), width / 2 * 2]), device)
}

/// Like [`time_sinusoid`], for fractional times.
pub fn time_sinusoid_f32(times: &[f32], width: usize, device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(time_rows(times, width), [times.len(), width / 2 * 2]), device)
}

fn time_rows(times: &[f32], width: usize) -> Vec<f32> {
    let half = width / 2;
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "f32 by definition")]
    let frequencies: Vec<f32> =
        (0..half).map(|i| ((-(10_000_f64.ln()) as f32) * i as f32 / half as f32).exp()).collect();
    let row = |t: &f32| {
        let angles = frequencies.iter().map(|f| t * f).collect::<Vec<_>>();
        let cosines: Vec<f32> = angles.iter().map(|a| a.cos()).collect();
        cosines.into_iter().chain(angles.into_iter().map(f32::sin)).collect::<Vec<_>>()
    };
    times.iter().flat_map(row).collect()
}

/// [B, width]: `[sin(1000 w f) | cos(1000 w f)]` with `f_i = 10000^(-i / (width / 2 - 1))`.
pub fn guidance_embedding(guidance: &[f32], width: usize, device: &Device) -> Tensor<2> {
    let half = width / 2;
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "f32 by definition")]
    let step = (10_000_f64.ln() / (half as f64 - 1.0)) as f32;
    #[expect(clippy::cast_precision_loss, reason = "widths are small")]
    let frequencies: Vec<f32> = (0..half).map(|i| (i as f32 * -step).exp()).collect();
    let rows = guidance.iter().flat_map(|w| {
        let angles: Vec<f32> = frequencies.iter().map(|f| w * 1000.0 * f).collect();
        let sines: Vec<f32> = angles.iter().map(|a| a.sin()).collect();
        sines.into_iter().chain(angles.into_iter().map(f32::cos)).collect::<Vec<_>>()
    });
    Tensor::from_data(TensorData::new(rows.collect(), [guidance.len(), 2 * half]), device)
}

/// Alternating `sin(p f_i)` and `cos(p f_i)` [positions, width] with `f_i = 10000^(-2i / width)`. It is the table of
/// Vaswani et al., arXiv:1706.03762, that MDM and StableMoFusion use for frames and for timesteps.
pub fn position_sinusoid(positions: impl ExactSizeIterator<Item = usize>, width: usize, device: &Device) -> Tensor<2> {
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "f32 by definition")]
    let step = -(10_000_f64.ln() / width as f64) as f32;
    #[expect(clippy::cast_precision_loss, reason = "widths are small")]
    let frequencies: Vec<f32> = (0..width.div_ceil(2)).map(|i| ((2 * i) as f32 * step).exp()).collect();
    let rows = positions.len();
    #[expect(clippy::cast_precision_loss, reason = "positions are small")]
    let row = |p: usize| {
        let angles: Vec<f32> = frequencies.iter().map(|f| p as f32 * f).collect();
        angles.into_iter().flat_map(|a| [a.sin(), a.cos()]).take(width)
    };
    let values: Vec<f32> = positions.flat_map(row).collect();
    Tensor::from_data(TensorData::new(values, [rows, width]), device)
}
