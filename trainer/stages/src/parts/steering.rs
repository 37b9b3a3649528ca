//! The residuals that a ControlNet adds to its denoiser. Source: MotionLCM (Dai et al., ECCV 2024). Not its job:
//! reading the part (`control`), running the denoiser (`networks`).

use burn::tensor::Tensor;
use models::kernels::Dropout;
use models::networks::Denoiser;

/// A ControlNet and its inputs for a batch.
#[derive(Debug, Clone)]
pub struct Steering<'a> {
    pub(crate) control: &'a Denoiser,
    /// The trajectory encoder's tokens for the batch's hints, [B, N, d].
    pub(crate) tokens_bnd: Tensor<3>,
    /// Factor on the residuals.
    pub(crate) scale: f64,
}

impl Steering<'_> {
    /// The residuals for the denoiser's blocks and their factor, for the denoiser's arguments. A batch that repeats the
    /// motions, as for guidance, repeats the tokens.
    pub(crate) fn residuals(
        &self,
        latent_bnd: &Tensor<3>,
        timesteps: &[usize],
        text_blc: &Tensor<3>,
        guidance_bg: Option<&Tensor<2>>,
    ) -> (Vec<Tensor<3>>, f64) {
        let times = latent_bnd.dims()[0] / self.tokens_bnd.dims()[0].max(1);
        let tokens = Tensor::cat(vec![self.tokens_bnd.clone(); times.max(1)], 0);
        let latent = latent_bnd.clone();
        let text = text_blc.clone();
        let guidance = guidance_bg.cloned();
        (self.control.residuals(latent, timesteps, text, guidance, tokens, &mut Dropout::off()), self.scale)
    }
}
