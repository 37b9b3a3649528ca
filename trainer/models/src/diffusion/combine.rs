//! Combinations of samples by factors, one for each sample or one for the batch: noise, and guidance.

use burn::tensor::{Tensor, TensorData};

/// Reshapes per-sample factors into a column [B, 1, 1] on the device of `like`.
pub fn column(values: &[f32], like: &Tensor<3>) -> Tensor<3> {
    Tensor::from_data(TensorData::new(values.to_vec(), [values.len(), 1, 1]), &like.device())
}

/// Computes `a_b z_b + e_b eps_b` for every sample b; `z`, `eps` [B, N, d], `a`, `e` [B].
pub fn affine(z: Tensor<3>, eps: Tensor<3>, a: &[f32], e: &[f32]) -> Tensor<3> {
    let a = column(a, &z);
    let e = column(e, &z);
    z * a + eps * e
}

/// Like [`affine`], with one pair of factors for the whole batch.
pub fn affine_one(z: Tensor<3>, eps: Tensor<3>, (a, e): (f64, f64)) -> Tensor<3> {
    z * (a as f32) + eps * (e as f32)
}

/// Classifier-free guidance as samplers write it: `uncond + g (cond - uncond)`.
pub fn guided(cond: Tensor<3>, uncond: Tensor<3>, g: f64) -> Tensor<3> {
    uncond.clone() + (cond - uncond) * (g as f32)
}

/// Classifier-free guidance as distillation writes it, one scale per sample: `cond + w (cond - uncond)`, so `w = g - 1`.
pub fn guided_by(cond: Tensor<3>, uncond: Tensor<3>, w: &[f32]) -> Tensor<3> {
    let w = column(w, &cond);
    cond.clone() + (cond - uncond) * w
}

/// Splits per-sample pairs into the two f32 lists that [`affine`] takes.
pub fn unzip(pairs: impl IntoIterator<Item = (f64, f64)>) -> (Vec<f32>, Vec<f32>) {
    pairs.into_iter().map(|(a, e)| (a as f32, e as f32)).unzip()
}
