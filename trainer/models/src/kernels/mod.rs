//! Fused CPU kernels with hand-written backward passes, and the stock operations they replace elsewhere.
//!
//! Each public function takes and returns Burn tensors. On the `flex` backend, with or without autodiff, one call is one
//! node of the tape and one or two passes over memory; on any other backend the same function is composed of Burn's
//! operations. Both compute the same mathematics; `tests/kernels.rs` compares them, `benches/steps.rs` times them.
//!
//! Bits: a kernel's result depends on its inputs alone. Sums run in a fixed order, matrix products run on the calling
//! thread, and dropout masks are a hash of where they are used, not of a generator.
//!
//! Not its job: parameters, shapes of networks.

mod attention;
mod dropout;
mod gelu;
mod gru;
mod linear;
mod mish;
mod norm;
mod raw;
pub(crate) mod simd;

pub use attention::{KeyMask, cross_attention, self_attention};
pub use dropout::{Dropout, dropout};
pub use gelu::gelu;
pub use gru::gru;
pub use linear::linear;
pub use mish::mish;
pub use norm::{add_layer_norm, layer_norm};

/// Runs `body` with Burn's operations in place of the fused kernels, on this thread: what the kernels are measured against.
pub fn stock<T>(body: impl FnOnce() -> T) -> T {
    #[cfg(feature = "flex")]
    {
        raw::stock(body)
    }
    #[cfg(not(feature = "flex"))]
    {
        body()
    }
}
