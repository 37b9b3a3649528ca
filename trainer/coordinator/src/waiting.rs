//! Says in words who has the workers that a stage waits for. The command line and the page show the words as they are.

use protocol::units::counted;

use crate::state::State;
use crate::state::execution::StageExecution;
use crate::state::run::Run;

impl State {
    /// Says why a run is queued.
    pub(crate) fn why_queued(&self, run: &Run) -> String {
        let group = run.owner.group();
        let runs = self.groups.get(&group);
        let at_work = counted(runs.map_or(0, |runs| runs.at_work), "run");
        let most = self.policy.limits_of(&group).runs.unwrap_or_default();
        format!("queued: {at_work} of {group} at work, at most {most} allowed")
    }

    /// Says who has the workers that an execution could use; `None` if one is idle or none fits.
    pub(crate) fn where_workers_are(&self, execution: &StageExecution) -> Option<String> {
        let own = self.claimant_of(execution)?;
        if let Some(most) = self.policy.limits_of(&own.group).workers
            && self.workers_of(&own.group) >= most
        {
            return Some(format!("{} already has {}, the most allowed", own.group, counted(most, "worker")));
        }
        let mut equal = 0;
        let mut lower = 0;
        let mut yielding = 0;
        let mut foreign = 0;
        for worker in self.workers.values().filter(|worker| worker.is_available() && execution.takes(worker)) {
            // An idle worker fetches the inputs, or is kept for other work for a short time.
            let (key, i) = worker.holds?;
            let other = &self.executions[&key];
            match self.claimant_of(other) {
                Some(claimant) if claimant.group != own.group => foreign += 1,
                Some(_) if other.tasks[i].is_preempted() => yielding += 1,
                Some(claimant) if own.precedes(&claimant) => lower += 1,
                Some(_) => equal += 1,
                // Its run was cancelled; the worker has not yielded yet.
                None => foreign += 1,
            }
        }
        let counts = [
            (equal, "with work of equal or higher priority"),
            (yielding, "about to save and make way"),
            (lower, "with work of a lower priority, which ends first"),
            (foreign, "with other work"),
        ];
        let all = equal + lower + yielding + foreign;
        let mut parts = Vec::new();
        for (count, what) in counts.into_iter().filter(|(count, _)| *count > 0) {
            parts.push(match count {
                1 if all == 1 => format!("the only one is {what}"),
                1 => format!("1 is {what}"),
                _ if count == all => format!("all {count} are {what}"),
                _ => format!("{count} are {what}"),
            });
        }
        (all > 0).then(|| parts.join(", "))
    }
}
