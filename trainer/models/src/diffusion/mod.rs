//! The noise schedule, its forward and reverse moves, and the samplers.
//!
//! Every rule here is affine in the latent and the network's output, for every kind of prediction. So each module
//! returns plain coefficients, one pair per sample, and [`affine`] applies them. Coefficients are computed in f64 (see
//! [`Schedule`]).
//!
//! Notation: `alpha_t` and `sigma_t` are the factors of signal and noise. For a diffusion `alpha_t = sqrt(ab_t)` and
//! `sigma_t = sqrt(1 - ab_t)` with `ab_t` the cumulative alpha. Timesteps are integers 0..=999. Latents are [B, N, d].
//! Nothing here draws random numbers; noise is an argument.
//!
//! Not its job: networks, losses, and the choice of timesteps and guidance scales for training examples.

mod combine;
pub mod consistency;
pub mod ddim;
pub mod ddpm;
pub mod dpm;
pub mod pcm;
mod schedule;
mod timesteps;

pub use combine::{affine, affine_one, column, guided, guided_by, unzip};
pub use consistency::{Grid, LcmTimesteps, boundary, consistency, lcm_sample, lcm_timesteps};
pub use ddim::{ddim_sample, ddim_sample_to_data, ddim_timesteps, leading_timesteps};
pub use ddpm::{ddpm_sample, ddpm_timesteps};
pub use dpm::{DpmPath, Form, Last, dpm_sample};
pub use pcm::{Phases, pcm_sample};
pub use schedule::{Schedule, TIMESTEPS, flow};
