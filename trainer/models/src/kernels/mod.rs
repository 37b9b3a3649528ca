//! Fused CPU kernels with hand-written backward passes, and the stock operations that replace them on other backends.
//!
//! Each public function takes and returns Burn tensors. On the `flex` backend, with or without autodiff, one call is
//! one node of the tape and one or two passes over memory. On any other backend the same function is composed of Burn's
//! operations. Both compute the same mathematics; `tests/kernels.rs` compares them and `benches/steps.rs` times them.
//!
//! Determinism: a kernel's result depends on its inputs alone. Sums run in a fixed order, and matrix products run on
//! the calling thread. Dropout masks are hashes of their position, without a generator.
//!
//! Not its job: parameters, and the shapes of networks.

use burn::tensor::Tensor;

mod attention;
mod conv;
mod distance;
mod dropout;
#[cfg(feature = "flex")]
mod fused;
mod gelu;
mod gru;
mod joints;
mod linear;
mod mish;
mod norm;
#[cfg(feature = "flex")]
mod raw;
mod relu;
mod rms;
pub(crate) mod simd;
#[cfg(feature = "flex")]
mod tile;
mod work;

pub(crate) use attention::HIDDEN;
pub use attention::{KeyMask, causal_attention, cross_attention, self_attention};
pub use conv::{Sweep, conv, transposed_conv};
pub use distance::{Pointwise, weighted_distance};
pub use dropout::{Dropout, dropout};
#[cfg(feature = "flex")]
pub(crate) use fused::Collector;
pub use gelu::gelu;
pub use gru::gru;
pub use joints::{Derivative, joint_derivative, joints};
pub use linear::linear;
pub use mish::mish;
pub use norm::{add_layer_norm, layer_norm, leaky_layer_norm};
pub use relu::leaky_relu;
pub use rms::{rms_norm, rms_norm_silu};
pub use work::Work;

/// Gives `to` the values of `x` in row-major order. On flex no value is copied, unless `x` is a view; `into_data` copies
/// twice.
pub(crate) fn with_values<const D: usize>(x: Tensor<D>, to: impl FnOnce(&[f32])) {
    #[cfg(feature = "flex")]
    if let Some(values) = fused::plain(&x) {
        return to(fused::slice(&values));
    }
    to(x.into_data().as_slice::<f32>().expect("values are f32"));
}

/// Runs `body` with Burn's operations instead of the fused kernels on this thread, as the reference for comparisons.
pub fn stock<T>(body: impl FnOnce() -> T) -> T {
    #[cfg(feature = "flex")]
    {
        fused::stock(body)
    }
    #[cfg(not(feature = "flex"))]
    {
        body()
    }
}
