//! The motion VAE against the fixtures `01_*`.
