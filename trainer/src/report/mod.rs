//! Output for the user: text, progress, tables, pictures and errors.

pub(crate) mod figure;
pub(crate) mod print;
pub(crate) mod problem;
pub(crate) mod progress;
pub(crate) mod summary;
pub(crate) mod sweep_plot;
pub(crate) mod tensorboard;
