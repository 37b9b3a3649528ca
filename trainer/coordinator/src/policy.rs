//! Parameters of coordination. They are configurable so that tests can vary them; the documented promises assume the
//! defaults.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::message::LossCause;
use protocol::{Group, GroupLimits};

/// Order in which idle workers receive work. Results do not depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GrantOrder {
    /// Ascending by name.
    ByName,
    /// Descending by name.
    ByNameBackwards,
}

/// Periods, limits and budgets of coordination.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Policy {
    /// A worker that is silent for longer loses its assignments. Milliseconds.
    pub lease_ms: u64,
    /// Period of the timer; a dead worker's task is free after at most one lease and one tick. Milliseconds.
    pub tick_ms: u64,
    /// Longest wait for changes of a worker that has work. Milliseconds.
    pub poll_ms: u64,
    /// Time for a draining worker to finish before its task is released. Milliseconds.
    pub grace_ms: u64,
    /// Time for members of a gang to answer a complaint. Longer than the interval between two polls. Milliseconds.
    pub hearing_ms: u64,
    /// Time without work for a worker that was removed from a gang. Milliseconds.
    pub penalty_ms: u64,
    /// Time in which such a worker joins no gang with other members; it doubles with each suspicion. Milliseconds.
    pub shun_ms: u64,
    /// Like `shun_ms`, for a worker that slowed its gang down, which takes the gang some time to detect. Milliseconds.
    pub shun_slow_ms: u64,
    /// Upper limit of the time in which a worker joins no others. Milliseconds.
    pub shun_max_ms: u64,
    /// Time without another suspicion after which a suspicion is dropped. Milliseconds.
    pub fade_ms: u64,
    /// Time without a step after which a gang loses the member that the others wait for. Milliseconds.
    pub stall_ms: u64,
    /// First back-off; it doubles with each consecutive failure. Milliseconds.
    pub backoff_ms: u64,
    /// Longest back-off. Milliseconds.
    pub backoff_max_ms: u64,
    /// Time after which the name of an absent worker is forgotten. Milliseconds.
    pub forget_ms: u64,
    /// Time without work after which a worker is not kept for the group whose share it is. Milliseconds.
    pub share_ms: u64,
    /// Time for which a group gets no member of another group's gang after it has let one idle. Milliseconds.
    pub share_again_ms: u64,
    /// Time for a preempted training to save and yield before its task is released. Milliseconds.
    pub yield_ms: u64,
    /// Time for which a training that was resumed is not preempted. Milliseconds.
    pub stay_ms: u64,
    /// Number of decisions between snapshots of the state. A snapshot deletes the facts before it.
    pub snapshot_every: u64,
    /// Maximum number of active runs; further submissions are refused.
    pub live_runs: usize,
    /// Limits of groups, as the token file has them now.
    pub limits: Arc<BTreeMap<Group, GroupLimits>>,
    pub grants: GrantOrder,
    /// Number of our own faults that a task survives.
    pub fault_budget: u32,
    /// Number of losses of workers and networks that a task survives.
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
            share_ms: 120_000,
            share_again_ms: 1_800_000,
            yield_ms: 300_000,
            stay_ms: 60_000,
            snapshot_every: 4_000,
            live_runs: 20_000,
            limits: Arc::default(),
            grants: GrantOrder::ByName,
            fault_budget: 5,
            infrastructure_budget: 100,
        }
    }
}

impl Policy {
    /// Longest wait for changes of a worker without work, and so of any worker. It has nothing to report, and each poll
    /// costs the server a third of a millisecond. A worker gives up an answer that is a third of a lease late; its next poll
    /// still comes within the lease. Milliseconds.
    pub fn idle_poll_ms(&self) -> u64 {
        (self.poll_ms * 5).min(self.lease_ms * 3 / 5).max(self.poll_ms)
    }

    /// The limits of a group.
    pub fn limits_of(&self, group: &Group) -> GroupLimits {
        self.limits.get(group).copied().unwrap_or_default()
    }

    /// Time in which a worker joins no others after `suspicions` suspicions.
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
