//! Options for the limits of runs and tokens.

use std::time::Duration;

use clap::Args;
use coordinator::{Allowances, Config};

/// Options of a server with the defaults of [`Allowances`].
#[derive(Debug, Args)]
pub(crate) struct AllowanceArgs {
    /// Limit of runs that have not ended, over all tokens; one more is refused
    #[arg(long, env = "STRIDE_MAX_RUNS", default_value_t = Allowances::default().runs, value_name = "COUNT")]
    max_runs: usize,
    /// Limit of one run's log lines in MiB; later lines are left out
    #[arg(long, env = "STRIDE_MAX_LOG_MIB", default_value_t = Allowances::default().log_bytes >> 20, value_name = "MIB")]
    max_log_mib: u64,
    /// Limit of one run's metric values; later ones are left out
    #[arg(long, env = "STRIDE_MAX_VALUES", default_value_t = Allowances::default().values, value_name = "COUNT")]
    max_values: u64,
    /// Days that the history of runs, stages and workers is kept
    #[arg(long, env = "STRIDE_KEEP_HISTORY_DAYS", default_value_t = Allowances::default().history.as_secs() / 86_400, value_name = "DAYS")]
    keep_history_days: u64,
    /// Minutes without progress after which a stage that work has begun on is said to stand still
    #[arg(long, env = "STRIDE_STALLED_AFTER_MINUTES", default_value_t = Allowances::default().quiet.as_secs() / 60, value_parser = clap::value_parser!(u64).range(1..), value_name = "MINUTES")]
    stalled_after_minutes: u64,
    /// Calls per second of one token, workers' tokens excepted
    #[arg(long, env = "STRIDE_MAX_CALLS_PER_SECOND", default_value_t = Allowances::default().calls, value_name = "COUNT")]
    max_calls_per_second: u32,
    /// Connections of one token, workers' tokens excepted [default: an eighth of all, at most 256]
    #[arg(long, env = "STRIDE_MAX_CONNECTIONS_PER_TOKEN", value_name = "COUNT")]
    max_connections_per_token: Option<usize>,
}

impl AllowanceArgs {
    /// Sets the limits in a server's configuration.
    pub(crate) fn set(&self, config: &mut Config) {
        config.allowances = Allowances {
            runs: self.max_runs,
            log_bytes: self.max_log_mib << 20,
            values: self.max_values,
            history: Duration::from_secs(self.keep_history_days.saturating_mul(86_400)),
            quiet: Duration::from_secs(self.stalled_after_minutes.saturating_mul(60)),
            calls: self.max_calls_per_second,
        };
        if let Some(most) = self.max_connections_per_token {
            config.connections.of_token = most;
        }
    }
}
