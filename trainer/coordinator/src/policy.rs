//! The numbers of coordination. Configuration, so that tests can vary them; the defaults are the promises.

use protocol::message::LossCause;

/// Which of several idle workers is served first. What comes of the work does not depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GrantOrder {
    /// The first by name.
    ByName,
    /// The last by name.
    ByNameBackwards,
}

/// Times, budgets and periods.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Policy {
    /// A worker that was not heard of for so long loses its assignments. Milliseconds.
    pub lease_ms: u64,
    /// How often the clock is looked at; a dead worker's task is free after at most a lease and a tick. Milliseconds.
    pub tick_ms: u64,
    /// How long a poll waits for news. Milliseconds.
    pub poll_ms: u64,
    /// How long work that was asked to drain may take before it is released. Milliseconds.
    pub grace_ms: u64,
    /// How long the members of a gang have to speak after one has complained of another. Longer than between two polls. Milliseconds.
    pub hearing_ms: u64,
    /// How long a worker gets nothing to do that had to leave a gang. Milliseconds.
    pub penalty_ms: u64,
    /// How long such a worker joins no others; it doubles with each suspicion. Milliseconds.
    pub shun_ms: u64,
    /// The same for a worker that slowed its gang down, which takes its gang time to find out. Milliseconds.
    pub shun_slow_ms: u64,
    /// Longest time that a worker joins no others. Milliseconds.
    pub shun_max_ms: u64,
    /// A suspicion fades after so long without another. Milliseconds.
    pub fade_ms: u64,
    /// A gang in which nobody has had a step more for so long loses the member that the others wait for. Milliseconds.
    pub stall_ms: u64,
    /// First back-off; it doubles with each failure in a row. Milliseconds.
    pub backoff_ms: u64,
    /// Longest back-off. Milliseconds.
    pub backoff_max_ms: u64,
    /// How long a worker's name is kept that is gone or silent. Milliseconds.
    pub forget_ms: u64,
    /// After how many decisions the state is stored as a whole and the facts before it go.
    pub snapshot_every: u64,
    /// Runs that have not ended; one more is refused.
    pub live_runs: usize,
    /// Who is served first.
    pub grants: GrantOrder,
    /// Faults of ours that a task survives.
    pub fault_budget: u32,
    /// Losses of workers and networks that a task survives.
    pub infrastructure_budget: u32,
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            lease_ms: 15_000,
            tick_ms: 1_000,
            poll_ms: 2_000,
            grace_ms: 30_000,
            hearing_ms: 2_500,
            penalty_ms: 3_000,
            shun_ms: 6_000,
            shun_slow_ms: 120_000,
            shun_max_ms: 3_600_000,
            fade_ms: 600_000,
            stall_ms: 3_600_000,
            backoff_ms: 500,
            backoff_max_ms: 30_000,
            forget_ms: 3_600_000,
            snapshot_every: 4_000,
            live_runs: 20_000,
            grants: GrantOrder::ByName,
            fault_budget: 5,
            infrastructure_budget: 100,
        }
    }
}

impl Policy {
    /// How long a worker joins no others that is suspected for the `suspicions`th time.
    pub fn shunned_ms(&self, cause: LossCause, suspicions: u32) -> u64 {
        let first = match cause {
            LossCause::Unreachable => self.shun_ms,
            LossCause::Slow => self.shun_slow_ms,
            LossCause::Disagrees => self.shun_max_ms,
        };
        first.saturating_mul(1 << suspicions.saturating_sub(1).min(16)).min(self.shun_max_ms)
    }

    /// The wait after `failures` failures in a row.
    pub fn backoff(&self, failures: u32) -> u64 {
        let doublings = failures.saturating_sub(1).min(16);
        self.backoff_ms.saturating_mul(1 << doublings).min(self.backoff_max_ms)
    }
}
