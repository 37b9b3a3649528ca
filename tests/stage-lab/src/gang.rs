//! A gang of threads around one lock.
//!
//! A change of membership starts a new generation; a member that waits in an older one must regroup. Contributions to
//! an unfinished step are dropped with their generation; a finished sum stays readable.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Condvar, Mutex};

use burn::tensor::Device;
use checkpoint::Blobs;
use protocol::message::StageTask;
use protocol::{Digest, Manifest};

use super::attempt::{MemoryAttempt, Ran, Told, lock};
use stages::context::{
    Adopted, AttemptContext, Checkpoint, ContextError, Exchange, GangContext, Outcome, Rendezvous, StageError,
};
use stages::external::DataAccess;
use stages::tree::{Node, tree_sum};

/// Losses and joins of a gang's members. Members are numbered from 0; the lowest alive member
/// leads, unless it was demoted.
#[derive(Debug, Clone, Default)]
pub struct Script {
    /// Member and step: the member is lost when it would contribute to that step.
    pub lost: Vec<(usize, u64)>,
    /// Member and step: the member is lost when it commits the checkpoint of that step.
    pub lost_saving: Vec<(usize, u64)>,
    /// Member and step: another member leads when this one commits the checkpoint of that step.
    pub demoted_saving: Vec<(usize, u64)>,
    /// Members that only initialised themselves: the peer whose state they adopt is lost during the transfer, once.
    pub lost_donating: Vec<usize>,
    /// Member and step: the member starts once that step is summed. Its number is above those of the first members.
    pub joins: Vec<(usize, u64)>,
    /// All members must stop after applying this step.
    pub drain: Option<u64>,
}

#[derive(Debug, Default)]
struct State {
    generation: u64,
    members: Vec<usize>,
    /// The member that leads only if it is alone.
    demoted: Option<usize>,
    arrived: BTreeMap<usize, Option<u64>>,
    donated: Option<Vec<u8>>,
    step: u64,
    slices: BTreeMap<usize, (Node, Vec<f32>)>,
    summed: Option<(u64, Arc<Vec<f32>>)>,
    checkpoints: Vec<(u64, Manifest)>,
    /// Some member's thread has ended; no further member joins.
    over: bool,
}

impl State {
    fn regroup(&mut self, change: impl FnOnce(&mut Vec<usize>)) {
        self.generation += 1;
        change(&mut self.members);
        let demoted = self.demoted;
        self.members.sort_unstable_by_key(|member| (Some(*member) == demoted, *member));
        self.arrived.clear();
        self.donated = None;
        self.slices.clear();
    }
}

#[derive(Debug, Default)]
struct Gang {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
struct Member {
    attempt: MemoryAttempt,
    me: usize,
    gang: Arc<Gang>,
    generation: u64,
    members: Vec<usize>,
    /// True if the member had a state at the last rendezvous.
    has_own: bool,
    lost_at: Option<u64>,
    lost_saving: Option<u64>,
    demoted_saving: Option<u64>,
    loses_donor: bool,
    drain: Option<u64>,
    /// Result of the save that was not taken yet, and whether it was asked for.
    saved: Option<(Result<u64, ContextError>, bool)>,
}

fn other_length(bytes: usize) -> ContextError {
    ContextError::Unavailable(format!("a peer's state has {bytes} bytes, which is another length than this member's"))
}

impl Member {
    fn rank(&self) -> usize {
        self.members.iter().position(|m| *m == self.me).expect("a member is in its own gang")
    }
}

/// The code that a member runs.
pub type Body<'a> = dyn Fn(&mut dyn GangContext) -> Result<Outcome, StageError> + Sync + 'a;

/// End of a member's thread: its number, its result (`None` if it never became a member), and its reports.
type Ended = (usize, Option<Result<Outcome, StageError>>, Told);

/// Runs `body` with `count` members; `saved` holds its checkpoints, old and new.
pub(super) fn run(
    attempt: impl Fn() -> MemoryAttempt,
    count: usize,
    script: &Script,
    saved: &mut Vec<(u64, Manifest)>,
    body: &Body<'_>,
) -> Result<Ran, StageError> {
    let gang = Arc::new(Gang::default());
    {
        let mut state = lock(&gang.state);
        state.members = (0..count).collect();
        state.checkpoints = std::mem::take(saved);
    }
    let member = |me: usize| Member {
        attempt: attempt(),
        me,
        gang: Arc::clone(&gang),
        generation: 0,
        members: (0..count).collect(),
        has_own: false,
        lost_at: script.lost.iter().find(|(who, _)| *who == me).map(|(_, step)| *step),
        lost_saving: script.lost_saving.iter().find(|(who, _)| *who == me).map(|(_, step)| *step),
        demoted_saving: script.demoted_saving.iter().find(|(who, _)| *who == me).map(|(_, step)| *step),
        loses_donor: script.lost_donating.contains(&me),
        drain: script.drain,
        saved: None,
    };
    let starters = (0..count).map(|me| (member(me), None));
    let joiners = script.joins.iter().map(|&(me, step)| (member(me), Some(step)));
    let members: Vec<_> = starters.chain(joiners).collect();

    let results: Vec<Ended> = std::thread::scope(|scope| {
        let threads: Vec<_> = members
            .into_iter()
            .map(|(mut member, join_after)| {
                scope.spawn(move || {
                    let started = join_after.is_none_or(|step| join(&mut member, step));
                    // A panic must not leave the others waiting for this member.
                    let run = || started.then(|| body(&mut member));
                    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run));
                    let mut state = lock(&member.gang.state);
                    if !matches!(result, Ok(Some(Ok(_)) | None)) && state.members.contains(&member.me) {
                        state.regroup(|members| members.retain(|m| *m != member.me));
                    }
                    state.over |= matches!(result, Ok(Some(Ok(_))));
                    state.over |= state.members.is_empty();
                    drop(state);
                    member.gang.changed.notify_all();
                    match result {
                        Ok(result) => (member.me, result, member.attempt.told),
                        Err(panic) => std::panic::resume_unwind(panic),
                    }
                })
            })
            .collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    });

    *saved = std::mem::take(&mut lock(&gang.state).checkpoints);
    let ends_early =
        |me: usize| script.lost.iter().chain(&script.lost_saving).chain(&script.joins).any(|(who, _)| *who == me);
    // Holding members learn that the stage is over once the leader has reported.
    let reported = results.iter().any(|(_, result, _)| matches!(result, Some(Ok(_))));
    let mut ran: Option<Ran> = None;
    for (me, result, told) in results {
        match result {
            Some(Ok(outcome)) => {
                // The lowest remaining member led at the end and reports; the others must have the same outcome.
                if let Some(leader) = &ran {
                    let agree = std::mem::discriminant(&leader.outcome) == std::mem::discriminant(&outcome);
                    assert!(agree, "member {me} ended with {outcome:?}, the leader with {:?}", leader.outcome);
                } else {
                    ran = Some(Ran { outcome, told });
                }
            }
            Some(Err(StageError::Context(ContextError::GrantEnded(_)))) if reported || ends_early(me) => {}
            Some(Err(error)) => return Err(error),
            None => {}
        }
    }
    ran.ok_or_else(|| StageError::Fault("every member of the gang was lost".into()))
}

/// Waits until `step` is summed, then becomes a member. Returns false if the stage ended before.
fn join(member: &mut Member, step: u64) -> bool {
    let mut state = lock(&member.gang.state);
    while !state.over && state.summed.as_ref().is_none_or(|(at, _)| *at < step) {
        state = member.gang.changed.wait(state).unwrap_or_else(std::sync::PoisonError::into_inner);
    }
    if state.over {
        return false;
    }
    state.regroup(|members| members.push(member.me));
    member.members.clone_from(&state.members);
    drop(state);
    member.gang.changed.notify_all();
    true
}

impl AttemptContext for Member {
    fn task(&self) -> &StageTask {
        self.attempt.task()
    }
    fn device(&self) -> Device {
        self.attempt.device()
    }
    fn data(&self) -> Arc<DataAccess> {
        self.attempt.data()
    }
    fn blobs(&self) -> Arc<dyn Blobs> {
        self.attempt.blobs()
    }
    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        self.attempt.manifest(digest)
    }
    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError> {
        self.attempt.put_manifest(manifest)
    }
    fn progress(&mut self, done: u64, total: u64, unit: &str, metrics: &[(&str, f64)]) {
        self.attempt.progress(done, total, unit, metrics);
    }
    fn record(&mut self, step: u64, metrics: &[(&str, f64)]) {
        self.attempt.record(step, metrics);
    }
    fn log(&mut self, line: &str) {
        self.attempt.log(line);
    }
    fn chunk_bytes(&self) -> u64 {
        self.attempt.chunk_bytes()
    }
    fn interrupted(&self) -> bool {
        self.attempt.interrupted()
    }
}

impl GangContext for Member {
    fn latest_checkpoint(&self) -> Result<Option<Manifest>, ContextError> {
        Ok(lock(&self.gang.state).checkpoints.last().map(|(_, manifest)| manifest.clone()))
    }

    fn rendezvous(&mut self, applied: Option<u64>, bytes: &[&[u8]]) -> Result<Rendezvous, ContextError> {
        let gang = Arc::clone(&self.gang);
        let mut state = lock(&gang.state);
        loop {
            // Only a member that joined after the last step can see this.
            if state.over || !state.members.contains(&self.me) {
                return Err(ContextError::GrantEnded("the gang went on without this member".into()));
            }
            self.generation = state.generation;
            self.members.clone_from(&state.members);
            state.arrived.insert(self.me, applied);
            gang.changed.notify_all();
            while !state.over && state.generation == self.generation && state.arrived.len() < state.members.len() {
                state = gang.changed.wait(state).unwrap_or_else(std::sync::PoisonError::into_inner);
            }
            if state.over || state.generation != self.generation {
                continue;
            }
            let newest = *state.arrived.values().max().expect("this member has arrived");
            if state.arrived.values().all(|a| *a == newest) {
                return Ok(Rendezvous::Keep);
            }
            let donor = state.arrived.iter().find(|(_, a)| **a == newest).map(|(who, _)| *who);
            if donor == Some(self.me) {
                state.donated = Some(bytes.concat());
                gang.changed.notify_all();
            }
            if applied == newest {
                return Ok(Rendezvous::Keep);
            }
            while !state.over && state.generation == self.generation && state.donated.is_none() {
                state = gang.changed.wait(state).unwrap_or_else(std::sync::PoisonError::into_inner);
            }
            if state.generation == self.generation && state.donated.is_some() {
                self.has_own = applied.is_some();
                return Ok(Rendezvous::Behind);
            }
        }
    }

    fn adopt(&mut self, into: &mut [&mut [u8]]) -> Result<Adopted, ContextError> {
        let mut state = lock(&self.gang.state);
        if self.loses_donor && !self.has_own {
            self.loses_donor = false;
            let newest = state.arrived.values().max().copied();
            let donor = state.arrived.iter().find(|(_, a)| Some(**a) == newest).map(|(who, _)| *who);
            state.regroup(|members| members.retain(|m| Some(*m) != donor));
            self.gang.changed.notify_all();
        }
        let Some(donated) = state.donated.as_ref().filter(|_| state.generation == self.generation) else {
            if !self.has_own {
                // The part that arrived before the loss.
                into.iter_mut().for_each(|piece| piece.fill(0xff));
            }
            return Ok(Adopted::Cut);
        };
        let mut rest = donated.as_slice();
        for piece in into {
            let (now, later) = rest.split_at_checked(piece.len()).ok_or_else(|| other_length(donated.len()))?;
            piece.copy_from_slice(now);
            rest = later;
        }
        if rest.is_empty() { Ok(Adopted::Whole) } else { Err(other_length(donated.len())) }
    }

    fn share(&self, slices: usize) -> Range<usize> {
        let (rank, of) = (self.rank(), self.members.len());
        slices * rank / of..slices * (rank + 1) / of
    }

    fn exchange(
        &mut self,
        steps: Range<u64>,
        slices: usize,
        parts: &mut [(Node, Vec<f32>)],
    ) -> Result<Exchange, ContextError> {
        let step = steps.start;
        let gang = Arc::clone(&self.gang);
        let mut state = lock(&gang.state);
        if self.lost_at.is_some_and(|at| steps.end > at) {
            let me = self.me;
            state.regroup(|members| members.retain(|m| *m != me));
            gang.changed.notify_all();
            return Err(ContextError::GrantEnded(format!("member {me} was lost at step {step}")));
        }
        let found = |state: &State| match &state.summed {
            Some((at, sum)) if *at == step => Some(Arc::clone(sum)),
            _ => None,
        };
        let drain = self.drain.is_some_and(|at| steps.end > at);
        if state.generation != self.generation {
            return Ok(Exchange::Regroup);
        }
        if state.step != step {
            state.step = step;
            state.slices.clear();
        }
        assert!(
            parts.iter().flat_map(|(node, _)| node.clone()).eq(self.share(slices)),
            "a member gives its own slices, in order"
        );
        state.slices.extend(parts.iter().map(|(node, part)| (node.start, (node.clone(), part.clone()))));
        if state.slices.values().map(|(node, _)| node.len()).sum::<usize>() == slices {
            let parts = std::mem::take(&mut state.slices).into_values();
            state.summed = Some((step, Arc::new(tree_sum(slices, parts))));
            gang.changed.notify_all();
        }
        loop {
            if let Some(sum) = found(&state) {
                return Ok(Exchange::Sum { sum: sum.to_vec(), drain });
            }
            if state.generation != self.generation {
                return Ok(Exchange::Regroup);
            }
            state = gang.changed.wait(state).unwrap_or_else(std::sync::PoisonError::into_inner);
        }
    }

    fn large(&self) -> usize {
        self.attempt.large.unwrap_or(usize::MAX)
    }

    fn leads(&self) -> bool {
        self.rank() == 0
    }

    fn hold(&mut self) -> Result<(), ContextError> {
        let gang = Arc::clone(&self.gang);
        let mut state = lock(&gang.state);
        while !state.over && state.generation == self.generation {
            state = gang.changed.wait(state).unwrap_or_else(std::sync::PoisonError::into_inner);
        }
        if state.over { Err(ContextError::GrantEnded("rank 0 has reported the end".into())) } else { Ok(()) }
    }

    fn save(&mut self, checkpoint: Checkpoint, files: &[(&str, &[&[u8]])]) -> Result<(), ContextError> {
        assert!(self.leads(), "only the leader saves");
        assert!(self.saved.is_none(), "the save before was asked for");
        self.saved = Some((self.commit(&checkpoint, files), false));
        Ok(())
    }

    /// A save seems to be under way until it is asked for again or waited for.
    fn saved(&mut self, wait: bool) -> Option<Result<u64, ContextError>> {
        let (saved, is_asked) = self.saved.take()?;
        if wait || is_asked {
            return Some(saved);
        }
        self.saved = Some((saved, true));
        None
    }
}

impl Member {
    fn commit(&mut self, checkpoint: &Checkpoint, files: &[(&str, &[&[u8]])]) -> Result<u64, ContextError> {
        let step = checkpoint.step;
        if self.lost_saving == Some(step) {
            let me = self.me;
            lock(&self.gang.state).regroup(|members| members.retain(|m| *m != me));
            self.gang.changed.notify_all();
            return Err(ContextError::GrantEnded(format!("member {me} was lost while it saved step {step}")));
        }
        if self.demoted_saving == Some(step) {
            self.demoted_saving = None;
            let mut state = lock(&self.gang.state);
            state.demoted = Some(self.me);
            state.regroup(|_| {});
            self.gang.changed.notify_all();
            return Err(ContextError::NoLongerLeads(format!("member {} does not lead at step {step}", self.me)));
        }
        let uploaded = checkpoint.upload_pieces(&*self.blobs(), files);
        let manifest = uploaded.map_err(|error| ContextError::Storage(error.to_string()))?;
        self.put_manifest(&manifest)?;
        lock(&self.gang.state).checkpoints.push((step, manifest));
        Ok(step)
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::{CheckpointPolicy, StageSettings, TextEmbed};
    use protocol::{RunId, Seed, StageName};

    use super::*;

    const SLICES: usize = 6;
    const STEPS: u64 = 12;

    /// A loop without a network: its state is a number that each step maps to another, and the step count.
    fn body(cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let fault = |e: serde_json::Error| StageError::Fault(e.to_string());
        let saved = cx.latest_checkpoint()?;
        let (mut step, mut value): (u64, f32) = match &saved {
            Some(manifest) => serde_json::from_value(manifest.meta.clone()).map_err(fault)?,
            None => (0, 1.0),
        };
        let mut applied = saved.is_some().then_some(step);
        let meet = |cx: &mut dyn GangContext, applied: Option<u64>, mut state: (u64, f32)| {
            loop {
                let (mut step, mut value) = (state.0.to_le_bytes(), state.1.to_le_bytes());
                if cx.rendezvous(applied, &[&step, &value])? == Rendezvous::Keep {
                    return Ok::<_, StageError>(state);
                }
                if cx.adopt(&mut [&mut step, &mut value])? == Adopted::Whole {
                    state = (u64::from_le_bytes(step), f32::from_le_bytes(value));
                    return Ok(state);
                }
            }
        };
        (step, value) = meet(cx, applied, (step, value))?;
        while step < STEPS {
            let mut parts: Vec<_> = cx
                .share(SLICES)
                .map(|slice| (slice..slice + 1, vec![(value + slice as f32 * 0.1 + step as f32 * 1e3).sin()]))
                .collect();
            match cx.exchange(step..step + 1, SLICES, &mut parts)? {
                Exchange::Regroup => (step, value) = meet(cx, applied, (step, value))?,
                Exchange::Sum { sum, drain } => {
                    (step, value) = (step + 1, value + sum[0]);
                    if cx.leads() {
                        cx.record(step, &[("value", f64::from(value))]);
                    }
                    if drain {
                        if cx.leads() {
                            let meta = serde_json::json!([step, value]);
                            let metrics = BTreeMap::new();
                            let chunk_bytes = cx.chunk_bytes();
                            cx.save(Checkpoint { step, meta, metrics, chunk_bytes, may_wait: false }, &[])?;
                            assert_eq!(cx.saved(true).expect("a save was begun")?, step);
                        }
                        return Ok(Outcome::Yielded { at: step });
                    }
                }
            }
            applied = Some(step);
        }
        let output = Digest::of(&value.to_le_bytes());
        Ok(Outcome::Finished { output, metrics: BTreeMap::from([("value".to_owned(), f64::from(value))]) })
    }

    fn ran(count: usize, script: &Script, saved: &mut Vec<(u64, Manifest)>) -> Ran {
        let task = StageTask {
            run: RunId::new("test-1"),
            name: StageName::new("toy"),
            settings: StageSettings::TextEmbed(TextEmbed::default()),
            inputs: BTreeMap::new(),
            seed: Seed(0),
            checkpoint: CheckpointPolicy::default(),
        };
        let device = Device::flex();
        let attempt = || MemoryAttempt::new(task.clone(), device.clone(), Arc::default());
        run(attempt, count, script, saved, &body).unwrap()
    }

    #[test]
    fn a_gang_gives_one_value_whoever_leaves_or_joins() {
        let alone = ran(1, &Script::default(), &mut vec![]);
        assert_eq!(alone.told.records.len(), STEPS as usize);
        for count in [2, 3, 5] {
            assert_eq!(ran(count, &Script::default(), &mut vec![]).output(), alone.output());
        }
        for _ in 0..20 {
            let script = Script { lost: vec![(0, 3), (2, 5)], joins: vec![(7, 1), (8, 6)], ..Script::default() };
            assert_eq!(ran(3, &script, &mut vec![]).output(), alone.output());
        }
    }

    #[test]
    fn a_gang_that_yields_goes_on_from_its_checkpoint() {
        let alone = ran(1, &Script::default(), &mut vec![]);
        let mut saved = vec![];
        let script = Script { drain: Some(4), ..Script::default() };
        assert_eq!(ran(2, &script, &mut saved).outcome, Outcome::Yielded { at: 5 });
        assert_eq!(saved.len(), 1);
        assert_eq!(ran(3, &Script::default(), &mut saved).output(), alone.output());
    }
}
