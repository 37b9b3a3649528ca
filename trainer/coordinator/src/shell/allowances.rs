//! Limits of each run and each token: honest use stays below them, and no use can block others.

/// The limits of a server that its operator sets.
#[derive(Debug, Clone)]
pub struct Allowances {
    /// Runs that have not ended.
    pub runs: usize,
    /// Bytes of log lines of one run.
    pub log_bytes: u64,
    /// Values by step of one run.
    pub values: u64,
    /// Calls a second of one token that is no worker's.
    pub calls: u32,
}

impl Default for Allowances {
    fn default() -> Self {
        Self { runs: 20_000, log_bytes: 256 << 20, values: 50_000_000, calls: 100 }
    }
}
