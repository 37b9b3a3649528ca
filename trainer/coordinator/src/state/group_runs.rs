//! The running runs of a group. Those at work count against its limit, and the others are queued.

use std::cmp::Reverse;

use protocol::message::RunState;

use super::run::Run;
use super::shared::Set;

/// The running runs of a group.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GroupRuns {
    /// Number of runs that are not queued.
    pub at_work: usize,
    /// Numbers of the queued runs, the next one first.
    pub queued: Set<(Reverse<i32>, u64)>,
}

impl GroupRuns {
    /// Adds a run, or removes it.
    pub(super) fn count(&mut self, run: &Run, is_there: bool) {
        let place = (Reverse(run.submitted.priority), run.number);
        match (run.state == RunState::Running, run.queued, is_there) {
            (false, ..) => {}
            (true, true, true) => self.queued.insert_mut(place),
            (true, true, false) => drop(self.queued.remove_mut(&place)),
            (true, false, true) => self.at_work += 1,
            (true, false, false) => self.at_work -= 1,
        }
    }
}
