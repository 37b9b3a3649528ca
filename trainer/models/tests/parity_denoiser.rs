//! The denoiser against the fixtures `02_denoiser_*`.
