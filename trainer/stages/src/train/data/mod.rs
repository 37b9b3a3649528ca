//! Examples of trainings: a clip or its latents or tokens, its caption, and their keyed draws.

pub(crate) mod features;
pub(crate) mod flow;
pub(crate) mod latents;
pub(crate) mod tokens;
pub(crate) mod windows;
