//! The layers that a ControlNet applies to its condition before adding it to the noised latent. Source: as for
//! [`Control`](super::Control).

use burn::module::Module;
use burn::tensor::Tensor;
use burn::tensor::activation::silu;

use super::{Init, Linear};

/// The condition's Linears. Their numbers are upstream's places in a sequence, which has activations between them in
/// v2.
#[derive(Module, Debug)]
pub struct ConditionEmbedding {
    /// d -> E.
    pub at_0: Linear,
    /// E -> E (v1).
    pub at_1: Option<Linear>,
    /// v1: E -> d, initialised to zero. v2: E -> E.
    pub at_2: Linear,
    /// E -> d, initialised to zero (v2).
    pub at_4: Option<Linear>,
}

impl ConditionEmbedding {
    pub(super) fn new(init: &mut Init<'_>, dim: usize, width: usize, activated: bool) -> Self {
        let zero = |init: &Init<'_>| Linear {
            weight: init.constant(0.0, [dim, width]),
            bias: Some(init.constant(0.0, [dim])),
        };
        let at_0 = Linear::new(init, dim, width);
        let inner = Linear::new(init, width, width);
        match activated {
            true => Self { at_0, at_1: None, at_2: inner, at_4: Some(zero(init)) },
            false => Self { at_0, at_1: Some(inner), at_2: zero(init), at_4: None },
        }
    }

    /// Maps [B, N, d] to [B, N, d].
    pub fn forward(&self, condition_bnd: Tensor<3>) -> Tensor<3> {
        let x = self.at_0.forward(condition_bnd);
        match (&self.at_1, &self.at_4) {
            (None, Some(last)) => last.forward(silu(self.at_2.forward(silu(x)))),
            (Some(inner), _) => self.at_2.forward(inner.forward(x)),
            (None, None) => self.at_2.forward(x),
        }
    }
}
