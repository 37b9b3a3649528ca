//! What this worker should be doing, kept equal to what the coordinator last said.
//!
//! The poll is heartbeat, report and order book in one; each answer is the whole truth, so one that is lost, late or doubled
//! changes nothing. A poll that fails changes nothing either: work goes on, and the next poll says it all again.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use protocol::Incarnation;
use protocol::message::{Assignment, DesiredAssignments, Join, Joined, Poll};
use tokio::sync::Notify;
use tokio::time::{Instant, sleep};

use crate::active_assignment::{ActiveAssignment, Flags, Reading};
use crate::client::{CallError, Client};
use crate::event_count::{EventCount, lock};
use crate::gang::endpoint::Endpoint;
use crate::prepare::Preparation;

/// Longest pause between two polls of a coordinator that is away.
const LONGEST: Duration = Duration::from_secs(1);
/// Shortest time between two polls.
const SHORTEST: Duration = Duration::from_millis(20);
/// How long a name is waited for that another process has: a process that was killed has it until its lease ends.
const NAME_PATIENCE: Duration = Duration::from_secs(60);
/// Time after which a worker says again that it waits for its coordinator.
const REMIND: Duration = Duration::from_secs(60);
/// Refusals in a row before they are believed.
const REFUSALS: u32 = 5;

/// What the poll and the stage thread share.
#[derive(Debug)]
pub(crate) struct Shared {
    held: Mutex<Vec<Arc<ActiveAssignment>>>,
    /// Rung when there may be something to start, or nothing more ever.
    pub(crate) work: EventCount,
    pub(crate) wake: Arc<Notify>,
    flags: Arc<Flags>,
    over: AtomicBool,
    endpoint: Arc<Endpoint>,
    pub(crate) preparation: Preparation,
}

impl Shared {
    pub(crate) fn new(endpoint: Arc<Endpoint>) -> Arc<Self> {
        let wake: Arc<Notify> = Arc::default();
        Arc::new(Self {
            held: Mutex::default(),
            work: EventCount::default(),
            preparation: Preparation::new(wake.clone()),
            wake,
            flags: Arc::default(),
            over: AtomicBool::new(false),
            endpoint,
        })
    }

    /// The next assignment to run. Called by the stage thread between two of them.
    pub(crate) fn next(&self) -> Option<Arc<ActiveAssignment>> {
        if self.is_leaving() {
            return None;
        }
        lock(&self.held).iter().find(|held| !held.is_done() && held.ended().is_none()).cloned()
    }

    /// Takes nothing new; what runs saves and yields.
    pub(crate) fn leave(&self) {
        self.flags.leaving.store(true, Ordering::SeqCst);
        self.preparation.end();
        for held in lock(&self.held).iter() {
            held.event_count().notify();
        }
        self.wake.notify_one();
        self.work.notify();
    }

    pub(crate) fn is_leaving(&self) -> bool {
        self.flags.leaving.load(Ordering::SeqCst)
    }

    pub(crate) fn is_over(&self) -> bool {
        self.over.load(Ordering::SeqCst)
    }

    /// Nothing will come any more; what runs is of no use.
    pub(crate) fn end(&self, reason: &str) {
        self.over.store(true, Ordering::SeqCst);
        for held in lock(&self.held).drain(..) {
            held.end(reason);
        }
        self.preparation.end();
        self.work.notify();
    }

    fn is_idle(&self, running: bool) -> bool {
        lock(&self.held).iter().all(|held| held.is_done() || !running)
    }

    /// Makes it so.
    pub(crate) fn apply(&self, desired: &DesiredAssignments) {
        let mut held = lock(&self.held);
        held.retain(|old| {
            let grant = old.grant();
            let listed = desired
                .assignments
                .iter()
                .any(|new| new.grant.task == grant.task && new.grant.attempt == grant.attempt);
            if !listed {
                old.end("the coordinator has taken it back");
            }
            listed
        });
        for assignment in &desired.assignments {
            let same = |old: &Arc<ActiveAssignment>| old.grant().task == assignment.grant.task;
            let Some(at) = held.iter().position(same) else {
                held.push(self.hold(assignment));
                continue;
            };
            match held[at].read(assignment) {
                Reading::Same | Reading::Regrouped => held[at].update(assignment.clone()),
                Reading::Anew => {
                    held[at].end("the coordinator has granted it anew");
                    held[at] = self.hold(assignment);
                }
            }
        }
        drop(held);
        self.preparation.want(&desired.prepare);
        self.work.notify();
    }

    fn hold(&self, assignment: &Assignment) -> Arc<ActiveAssignment> {
        ActiveAssignment::new(assignment.clone(), self.endpoint.clone(), self.wake.clone(), self.flags.clone())
    }

    fn poll(&self, incarnation: Incarnation, version: u64) -> Poll {
        let doing = lock(&self.held).iter().map(|held| held.doing()).collect();
        Poll { incarnation, doing, ready: self.preparation.ready(), version }
    }
}

/// Why polling ended.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// In good order.
    Left,
    /// The coordinator does not want this worker.
    Refused(String),
}

/// Offers this process until the coordinator takes it, or gives how the worker ends instead.
async fn join(client: &Client, join: &Join, shared: &Shared) -> Result<Joined, End> {
    let mut pause = Duration::from_millis(50);
    let begun = Instant::now();
    let mut said: Option<Instant> = None;
    loop {
        match client.join(join).await {
            Ok(joined) => {
                tracing::info!(worker = %join.worker, incarnation = %joined.incarnation, peer_address = join.peer_address, "joined");
                return Ok(joined);
            }
            Err(CallError::NameHeld(message)) if begun.elapsed() < NAME_PATIENCE => {
                if said.is_none_or(|said| said.elapsed() > REMIND) {
                    said = Some(Instant::now());
                    tracing::warn!("{message}; waiting");
                }
            }
            Err(error) if error.may_pass() => {
                if said.is_none_or(|said| said.elapsed() > REMIND) {
                    said = Some(Instant::now());
                    let help = match error {
                        CallError::Away(_) => "; `trainer serve` starts one there, Ctrl-C ends this worker",
                        _ => "",
                    };
                    tracing::warn!("waiting for the coordinator at {}: {error}{help}", client.url());
                }
            }
            Err(error) => {
                return Err(End::Refused(format!("the coordinator turned worker `{}` away: {error}", join.worker)));
            }
        }
        // A worker that runs nothing and is to go need not wait for a coordinator first.
        if shared.is_leaving() && shared.is_idle(false) {
            return Err(End::Left);
        }
        sleep(pause).await;
        pause = (pause * 2).min(LONGEST);
    }
}

/// How long an answer to a poll is waited for: as long as the coordinator may wait, and a third of a lease. If the connection hangs, there
/// is time for another one within the lease.
fn patience(joined: &Joined) -> Duration {
    Duration::from_millis(joined.poll_ms + joined.lease_ms / 3)
}

/// Joins and polls until the worker may go.
pub(crate) async fn follow(client: &Client, offer: &Join, shared: &Shared) -> End {
    let mut joined = match join(client, offer, shared).await {
        Ok(joined) => joined,
        Err(end) => return end,
    };
    let path = format!("/v1/workers/{}/poll", offer.worker);
    let (mut version, mut pause, mut refusals, mut leave) = (0, SHORTEST, 0, false);
    let mut away = false;
    loop {
        if (leave || shared.is_leaving()) && shared.is_idle(true) {
            return End::Left;
        }
        let poll = shared.poll(joined.incarnation, version);
        let answer = tokio::select! {
            // News of ours do not wait for news of theirs. The poll that is dropped may have been answered; the next one
            // carries the old version and is answered again.
            () = shared.wake.notified() => {
                sleep(SHORTEST).await;
                continue;
            }
            answer = client.poll(&path, &poll, patience(&joined)) => answer,
        };
        let answered = !answer.as_ref().is_err_and(CallError::may_pass);
        shared.flags.away.store(!answered, Ordering::SeqCst);
        match answer {
            Ok(desired) => {
                if std::mem::take(&mut away) {
                    tracing::info!("the coordinator is back");
                }
                (version, leave, refusals, pause) = (desired.version, desired.leave, 0, SHORTEST);
                shared.apply(&desired);
            }
            Err(CallError::NotFound(message)) => {
                tracing::warn!("the coordinator does not know this process: {message}; joining again");
                joined = match join(client, offer, shared).await {
                    Ok(joined) => joined,
                    Err(end) => return end,
                };
                version = 0;
                // A coordinator that forgets again at once is not asked in a tight loop.
                pause = (pause * 2).min(LONGEST);
            }
            Err(error) if error.may_pass() => {
                if !std::mem::replace(&mut away, true) {
                    tracing::warn!("the coordinator takes nothing, work goes on: {error}");
                }
                pause = (pause * 2).min(LONGEST);
            }
            Err(error) => {
                refusals += 1;
                if refusals == REFUSALS {
                    return End::Refused(error.to_string());
                }
                tracing::warn!("the coordinator refused a poll: {error}");
                pause = (pause * 2).min(LONGEST);
            }
        }
        sleep(pause).await;
    }
}
