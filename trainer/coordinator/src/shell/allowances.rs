//! Limits per run and per token. Honest use stays below them, and no use can block others.

use std::time::Duration;

/// The limits that the operator of a server sets.
#[derive(Debug, Clone)]
pub struct Allowances {
    /// Maximum number of active runs.
    pub runs: usize,
    /// Maximum number of log bytes per run.
    pub log_bytes: u64,
    /// Maximum number of recorded metric values per run.
    pub values: u64,
    /// Age at which history goes.
    pub history: Duration,
    /// Time without progress after which a stage is noted as stalled.
    pub quiet: Duration,
    /// Maximum number of calls per second for a token without the scope `worker`.
    pub calls: u32,
}

impl Default for Allowances {
    fn default() -> Self {
        Self {
            runs: 20_000,
            log_bytes: 256 << 20,
            values: 50_000_000,
            history: Duration::from_secs(90 * 86_400),
            quiet: Duration::from_secs(30 * 60),
            calls: 100,
        }
    }
}
