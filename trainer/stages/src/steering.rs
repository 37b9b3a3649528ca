//! What a ControlNet adds to the denoiser that it steers. Source: MotionLCM (Dai et al., ECCV 2024). Not its job: reading the part (`control`), asking the
//! denoiser (`networks`).

use burn::tensor::Tensor;
use models::kernels::Dropout;
use models::networks::Denoiser;

/// A ControlNet and what it is told of a batch.
#[derive(Debug, Clone)]
pub struct Steering<'a> {
    /// The ControlNet.
    pub(crate) control: &'a Denoiser,
    /// What the trajectory encoder made of the batch's hints, [B, N, d].
    pub(crate) tokens_bnd: Tensor<3>,
    /// What the residuals are multiplied by.
    pub(crate) scale: f64,
}

impl Steering<'_> {
    /// What is added to the denoiser's blocks, and times how much, for the arguments that it is given. A batch that stands there several times, as
    /// for guidance, is told the same each time.
    pub(crate) fn residuals(
        &self,
        latent_bnd: &Tensor<3>,
        timesteps: &[usize],
        text_blc: &Tensor<3>,
        guidance_bg: Option<&Tensor<2>>,
    ) -> (Vec<Tensor<3>>, f64) {
        let times = latent_bnd.dims()[0] / self.tokens_bnd.dims()[0].max(1);
        let tokens = Tensor::cat(vec![self.tokens_bnd.clone(); times.max(1)], 0);
        let (latent, text, guidance) = (latent_bnd.clone(), text_blc.clone(), guidance_bg.cloned());
        (self.control.residuals(latent, timesteps, text, guidance, tokens, &mut Dropout::off()), self.scale)
    }
}
