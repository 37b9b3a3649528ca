//! Options for the limits of runs and tokens.

use clap::Args;
use coordinator::{Allowances, Config};

/// Options of a server with the defaults of [`Allowances`].
#[derive(Debug, Args)]
pub(crate) struct AllowanceArgs {
    /// Runs that have not ended, of all tokens together; one more is refused
    #[arg(long, env = "STRIDE_MAX_RUNS", default_value_t = Allowances::default().runs, value_name = "COUNT")]
    max_runs: usize,
    /// Bytes of log lines of one run, in MiB; later lines are left out
    #[arg(long, env = "STRIDE_MAX_LOG_MIB", default_value_t = Allowances::default().log_bytes >> 20, value_name = "MIB")]
    max_log_mib: u64,
    /// Values by step of one run; later ones are left out
    #[arg(long, env = "STRIDE_MAX_VALUES", default_value_t = Allowances::default().values, value_name = "COUNT")]
    max_values: u64,
    /// Calls a second of one token that is no worker's
    #[arg(long, env = "STRIDE_MAX_CALLS_PER_SECOND", default_value_t = Allowances::default().calls, value_name = "COUNT")]
    max_calls_per_second: u32,
    /// Connections of one token that is no worker's [default: an eighth of all, at most 256]
    #[arg(long, env = "STRIDE_MAX_CONNECTIONS_PER_TOKEN", value_name = "COUNT")]
    max_connections_per_token: Option<usize>,
}

impl AllowanceArgs {
    /// Puts them into a server's configuration.
    pub(crate) fn set(&self, config: &mut Config) {
        config.allowances = Allowances {
            runs: self.max_runs,
            log_bytes: self.max_log_mib << 20,
            values: self.max_values,
            calls: self.max_calls_per_second,
        };
        if let Some(most) = self.max_connections_per_token {
            config.connections.of_token = most;
        }
    }
}
