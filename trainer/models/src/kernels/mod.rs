//! Fused CPU kernels with hand-written backward passes, and the stock operations they replace elsewhere.
//!
//! Each public function takes and returns Burn tensors. On the `flex` backend, with or without autodiff, one call is one
//! node of the tape and one or two passes over memory; on any other backend the same function is composed of Burn's
//! operations. Both compute the same mathematics; `tests` compare them.
//!
//! Bits: a kernel's result depends on its inputs alone. Sums run in a fixed order, matrix products run on the calling
//! thread, and dropout masks are a hash of where they are used, not of a generator.
//!
//! Not its job: parameters, shapes of networks.

mod attention;
mod dropout;
mod gelu;
mod linear;
mod norm;
mod raw;
mod simd;

pub use attention::{KeyMask, cross_attention, self_attention};
pub use dropout::{Dropout, dropout};
pub use gelu::gelu;
pub use linear::linear;
pub use norm::{add_layer_norm, layer_norm};
