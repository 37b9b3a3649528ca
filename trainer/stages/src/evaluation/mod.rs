//! The common part of evaluations: what they measure, and their reports. The metrics themselves are in `metrics`.

pub(crate) mod entry_draws;
pub(crate) mod measured;
pub(crate) mod reconstructor;
pub(crate) mod report;

pub use report::REPORT_FILE;
