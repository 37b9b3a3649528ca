//! Samplers and the noise loss against the fixtures `03_sampler_*`.
