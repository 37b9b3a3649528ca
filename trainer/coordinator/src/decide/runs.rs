//! Submission and control of runs.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use pipeline::Pipeline;
use protocol::message::RunState;
use protocol::{Digest, Group, GroupLimits, Owner, RunId, StageName, limits};
use registry::Write;

use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::run::Control;
use crate::state::run::Run;

impl Deciding<'_> {
    pub(crate) fn submit(
        &mut self,
        pipeline: Pipeline,
        source: String,
        key: Option<String>,
        submission: Option<Digest>,
        until: Option<StageName>,
        owner: Owner,
    ) -> Result<bool, Rejected> {
        // The caller has already looked for ended runs in the tables.
        let twin = key.as_ref().and_then(|key| self.state.idempotent.get(key));
        if let Some(twin) = twin.and_then(|number| self.state.runs.get(number)) {
            self.effects.push(Effect::Submitted(twin.id.clone()));
            return Ok(false);
        }
        check_pipeline(&pipeline, until.as_ref())?;
        let mut run = Run::new(self.state.submitted + 1, owner, Arc::new(pipeline), key, until);
        if let Some(id) = self.interrupted_twin(&run) {
            self.control(&id, Control::Resume, None)?;
            self.effects.push(Effect::Submitted(id));
            return Ok(true);
        }
        self.check_room()?;
        for old in self.interrupted() {
            // An interrupted run of another owner stays interrupted.
            let is_its_own = run.owner.controls(&old.owner.group());
            if is_its_own && old.submitted.digest() == run.submitted.digest() {
                self.change_run(old.number, |old| old.skip_rest(&format!("taken over by run `{}`", run.id)));
                self.set_run_state(old.number, RunState::Cancelled, old.parked);
            }
        }
        self.writes.push(Write::Run {
            run: run.id.clone(),
            pipeline: serde_json::to_value(&*run.submitted).expect("a pipeline serialises"),
            source,
            state: word(run.state),
            idempotency_key: run.idempotency_key.clone(),
        });
        self.writes.push(Write::RunOwner { run: run.id.clone(), owner: run.owner.group() });
        if let Some(digest) = submission {
            self.writes.push(Write::Submission { run: run.id.clone(), digest });
        }
        self.effects.push(Effect::Submitted(run.id.clone()));
        run.queued = self.room_for_runs(&run.owner.group()) == 0;
        self.record(Fact::Run { run: Box::new(run) });
        Ok(true)
    }

    /// Number of runs of a group that may still begin.
    fn room_for_runs(&self, group: &Group) -> usize {
        let at_work = self.state.groups.get(group).map_or(0, |runs| runs.at_work);
        self.state.policy.limits_of(group).runs.map_or(usize::MAX, |most| most.saturating_sub(at_work))
    }

    /// Begins queued runs, by priority, in the groups of the runs that this decision changed.
    pub(crate) fn admit_changed(&mut self) {
        let changed = self.runs.iter().filter_map(|number| self.state.runs.get(number));
        let groups: BTreeSet<Group> = changed.map(|run| run.owner.group()).collect();
        self.admit(groups);
    }

    /// Begins queued runs of these groups.
    fn admit(&mut self, groups: BTreeSet<Group>) {
        for group in groups {
            while self.room_for_runs(&group) > 0
                && let Some((_, number)) = self.state.groups.get(&group).and_then(|runs| runs.queued.first()).copied()
            {
                self.record(Fact::RunQueued { run: number, queued: false });
                self.reconcile();
            }
        }
    }

    /// Applies new limits of groups. Runs and workers beyond a lower limit continue.
    pub(crate) fn limit(&mut self, limits: Arc<BTreeMap<Group, GroupLimits>>) -> bool {
        if self.state.policy.limits == limits {
            return false;
        }
        self.state.policy.limits = limits;
        self.admit_all();
        true
    }

    /// Begins queued runs of all groups.
    pub(crate) fn admit_all(&mut self) {
        let queued = self.state.groups.iter().filter(|(_, runs)| !runs.queued.is_empty());
        let groups: BTreeSet<Group> = queued.map(|(group, _)| group.clone()).collect();
        self.admit(groups);
    }

    /// Refuses another run if the limit is reached.
    fn check_room(&self) -> Result<(), Rejected> {
        let live = self.state.runs.size();
        let most = self.state.policy.live_runs;
        if live < most {
            return Ok(());
        }
        Err(Rejected::Full(format!("{live} runs are active; expected at most {most}")))
    }

    /// Interrupted runs in the order of their submission.
    fn interrupted(&self) -> Vec<Arc<Run>> {
        let parked = self.state.parked.iter().filter_map(|number| self.state.runs.get(number));
        parked.filter(|old| old.is_interrupted()).cloned().collect()
    }

    /// The newest interrupted run equivalent to `run`, if `run` has no idempotency key.
    fn interrupted_twin(&self, run: &Run) -> Option<RunId> {
        if run.idempotency_key.is_some() {
            return None;
        }
        let same = |old: &&Arc<Run>| {
            run.owner.controls(&old.owner.group())
                && old.until == run.until
                && old.submitted.priority == run.submitted.priority
                && old.submitted.digest() == run.submitted.digest()
        };
        self.interrupted().iter().rev().find(same).map(|old| old.id.clone())
    }

    pub(crate) fn control(
        &mut self,
        id: &RunId,
        action: Control,
        archived: Option<Box<Run>>,
    ) -> Result<bool, Rejected> {
        let archived = archived.filter(|run| run.id == *id);
        let (run, known) = match (self.state.run(id), archived) {
            (Ok(run), _) => (Arc::clone(run), true),
            (Err(_), Some(run)) => (Arc::from(run), false),
            (Err(unknown), None) => return Err(unknown),
        };
        let before = run.state;
        let Some(after) = run.after(action) else {
            let action = format!("{action:?}").to_lowercase();
            return Err(Rejected::Conflict(format!(
                "`{action}` does nothing to run `{id}`, which is {}",
                before.name()
            )));
        };
        if after == before && !run.parked {
            return Ok(false);
        }
        if !known {
            self.check_room()?;
            self.record(Fact::Run { run: Box::new(Run::clone(&run)) });
        }
        if action == Control::Resume && before != RunState::Running {
            let queued = self.room_for_runs(&run.owner.group()) == 0;
            if queued != run.queued {
                self.record(Fact::RunQueued { run: run.number, queued });
            }
        }
        match action {
            Control::Pause => {}
            Control::Cancel => self.change_run(run.number, |run| run.skip_rest("cancelled")),
            Control::Resume => self.change_run(run.number, Run::reopen),
        }
        self.set_run_state(run.number, after, false);
        Ok(true)
    }

    pub(crate) fn set_run_state(&mut self, number: u64, state: RunState, parked: bool) {
        let run = self.state.runs[&number].id.clone();
        self.record(Fact::RunState { run: number, state, parked });
        // The row of an ended run is written at the end of this decision, when the run leaves memory.
        if !state.is_final() {
            self.writes.push(Write::RunState { run, state: word(state) });
        }
    }
}

/// The name of a run's state in its row.
pub(crate) fn word(state: RunState) -> String {
    state.name().to_owned()
}

/// Checks a pipeline for mistakes that even an honest client of another build can make.
fn check_pipeline(pipeline: &Pipeline, until: Option<&StageName>) -> Result<(), Rejected> {
    if pipeline.stages.len() > limits::STAGES {
        let stages = pipeline.stages.len();
        return Err(Rejected::Invalid(format!(
            "the pipeline has {stages} stages; expected at most {}",
            limits::STAGES
        )));
    }
    let mut seen = BTreeSet::new();
    for stage in &pipeline.stages {
        for input in &stage.inputs {
            if !seen.contains(&input.stage) {
                return Err(Rejected::Invalid(format!(
                    "stage `{}`: `{}` names stage `{}`, which is not an earlier stage",
                    stage.name, input.field, input.stage
                )));
            }
        }
        if !seen.insert(&stage.name) {
            return Err(Rejected::Invalid(format!("the pipeline has stage `{}` twice", stage.name)));
        }
    }
    match until {
        Some(until) if pipeline.named(until).next().is_none() => {
            let names: Vec<&str> = seen.iter().map(|name| name.as_str()).collect();
            Err(Rejected::Invalid(format!("`until`: unknown stage `{until}`; expected one of: {}", names.join(", "))))
        }
        Some(_) | None => Ok(()),
    }
}
