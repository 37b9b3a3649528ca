//! The demand for workers, computed from the state.

use std::collections::BTreeMap;

use protocol::canonical;
use protocol::demand::{Demand, DemandGroup, DemandWorker};

use crate::state::State;
use crate::state::execution::StageExecution;
use crate::state::queue::{Claimant, Need};
use crate::state::task::{Lease, Part, Task};
use crate::time::Millis;

/// Number of waiting executions of one kind that are counted. No fleet has more slots.
const COUNTED: usize = 10_000;

impl State {
    /// The demand at `now`. `lead_ms` is left at 0.
    pub fn demand(&self, now: Millis) -> Demand {
        let mut groups: BTreeMap<Need, DemandGroup> = BTreeMap::new();
        for need in self.queue.needs() {
            let need_of_all = Need { gang: false, claimant: Claimant::default(), ..need.clone() };
            let group = groups.entry(need_of_all).or_insert_with_key(group_of);
            for (_, key) in self.queue.with(need).take(COUNTED) {
                let execution = &self.executions[&key];
                group.ready += slots(execution);
                if !execution.is_busy() {
                    let wait = execution.idle_since.map_or(0, |since| now.since(since));
                    group.oldest_wait_ms = group.oldest_wait_ms.max(wait);
                }
            }
        }
        for worker in self.workers.values().filter(|worker| !worker.is_away()) {
            if let Some(execution) = worker.holds.and_then(|(key, _)| self.executions.get(&key)) {
                groups.entry(need_of(execution)).or_insert_with_key(group_of).wanted += 1;
            }
        }
        let mut workers = Vec::new();
        for (name, worker) in self.workers.iter().filter(|(_, worker)| worker.is_available()) {
            workers.push(DemandWorker {
                worker: name.clone(),
                backend: worker.backend,
                instruction_set: worker.instruction_set.clone(),
                labels: worker.labels.clone(),
                idle: worker.holds.is_none(),
            });
        }
        for group in groups.values_mut() {
            group.wanted += group.ready;
            group.idle = workers.iter().filter(|worker| worker.idle && group.takes_worker(worker)).count() as u64;
        }
        let groups: Vec<DemandGroup> = groups.into_values().collect();
        let timeless: Vec<_> = groups.iter().map(|group| DemandGroup { oldest_wait_ms: 0, ..group.clone() }).collect();
        // 53 bits, which JSON readers with double-precision numbers preserve.
        let digest = canonical::digest(&(&timeless, &workers));
        let version = digest.as_bytes()[..8].iter().fold(0, |number, byte| number << 8 | u64::from(*byte)) >> 11;
        Demand { version, lead_ms: 0, groups, workers }
    }
}

/// The need of work under way, as groups are keyed: for gangs and single tasks alike.
fn need_of(execution: &StageExecution) -> Need {
    Need {
        gang: false,
        backend: execution.backend,
        instruction_set: execution.bound_to().map(str::to_owned),
        requires: execution.placement.requires.clone(),
        claimant: Claimant::default(),
    }
}

fn group_of(need: &Need) -> DemandGroup {
    DemandGroup {
        backend: need.backend,
        requires: need.requires.clone(),
        instruction_set: need.instruction_set.clone(),
        ready: 0,
        wanted: 0,
        idle: 0,
        oldest_wait_ms: 0,
    }
}

/// Number of workers that an execution could take now, besides those at work.
pub(crate) fn slots(execution: &StageExecution) -> u64 {
    if !execution.is_gang() {
        return execution.tasks.ready() as u64;
    }
    let range = execution.range();
    let room = |members: usize| match range.max {
        // Without an upper limit, a gang grows by one worker at a time.
        0 => range.min.saturating_sub(members).max(1),
        max => max.max(range.min).saturating_sub(members),
    };
    let of_task = |task: &Task| match &task.lease {
        Lease::Waiting { .. } => room(0),
        Lease::Held { holders, drain_by: None, .. } => room(holders.len()),
        Lease::Held { drain_by: Some(_), .. } | Lease::Done { .. } => 0,
    };
    execution.tasks.iter().filter(|task| task.part == Part::Gang).map(of_task).sum::<usize>() as u64
}
