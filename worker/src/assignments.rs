//! Keeps the assignments of this worker equal to the newest orders of the coordinator.
//!
//! A poll is heartbeat, report and request for orders in one. Each answer lists all assignments, so a lost, late or
//! repeated answer changes nothing. A failed poll changes nothing either: work continues, and the next poll reports
//! everything again.

use std::convert::Infallible;
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

/// Longest pause between two polls of an unreachable coordinator.
const LONGEST: Duration = Duration::from_secs(1);
/// Shortest time between two polls.
const SHORTEST: Duration = Duration::from_millis(20);
/// Time to wait for a name that another process holds. A killed process holds its name until its lease ends.
const NAME_PATIENCE: Duration = Duration::from_secs(if cfg!(test) { 4 } else { 60 });
/// Time between two log lines of a worker that waits for its coordinator.
const REMIND: Duration = Duration::from_secs(60);
/// Consecutive refusals that end the worker.
const REFUSALS: u32 = 5;

/// State that the poll and the stage thread share.
#[derive(Debug)]
pub(crate) struct Shared {
    held: Mutex<Vec<Arc<ActiveAssignment>>>,
    /// Notified when there may be work to start, and when no more work will come.
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
            preparation: Preparation::new(endpoint.clone(), wake.clone()),
            wake,
            flags: Arc::default(),
            over: AtomicBool::new(false),
            endpoint,
        })
    }

    /// The next assignment to run. The stage thread calls it between two assignments.
    pub(crate) fn next(&self) -> Option<Arc<ActiveAssignment>> {
        if self.is_leaving() {
            return None;
        }
        lock(&self.held).iter().find(|held| !held.is_done() && held.ended().is_none()).cloned()
    }

    /// Starts leaving: takes no new work, while the running stage saves and yields.
    pub(crate) fn leave(&self) {
        self.flags.leave();
        self.preparation.end();
        for held in lock(&self.held).iter() {
            held.event_count().notify();
        }
        self.wake.notify_one();
        self.work.notify();
    }

    pub(crate) fn is_leaving(&self) -> bool {
        self.flags.leaving_for().is_some()
    }

    pub(crate) fn is_over(&self) -> bool {
        self.over.load(Ordering::SeqCst)
    }

    /// Ends all assignments: no more work will come, and running work is of no use.
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

    /// Applies orders: ends assignments that are no longer listed, updates or adds the others.
    pub(crate) fn apply(&self, desired: &DesiredAssignments) {
        let mut held = lock(&self.held);
        held.retain(|old| {
            let grant = old.grant();
            let listed = desired
                .assignments
                .iter()
                .any(|new| new.grant.task == grant.task && new.grant.attempt == grant.attempt);
            if !listed {
                old.end("the coordinator revoked the grant");
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
                Reading::Restart => {
                    held[at].end("the coordinator granted the task again");
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
        Poll { incarnation, doing, ready: self.preparation.ready(), version, leaving: self.is_leaving() }
    }
}

/// Reason for the end of polling.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// The worker has left on request.
    Left,
    /// The coordinator refuses this worker.
    Refused(String),
    /// The token is missing, unknown or lacks the scope.
    Unauthorized(String),
}

impl End {
    fn refused(error: &CallError, message: String) -> Self {
        match error {
            CallError::Unauthorized(_) => Self::Unauthorized(message),
            _ => Self::Refused(message),
        }
    }
}

/// Joins the coordinator. Retries until it accepts this process; otherwise returns the end of the worker.
async fn join(client: &Client, join: &Join, shared: &Shared) -> Result<Joined, End> {
    let mut pause = Duration::from_millis(50);
    let mut begun = Instant::now();
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
                // A coordinator that starts again renews the lease of the name's holder.
                begun = Instant::now();
                if said.is_none_or(|said| said.elapsed() > REMIND) {
                    said = Some(Instant::now());
                    let help = match error {
                        CallError::Away(_) => "; `trainer serve` starts a coordinator there; Ctrl-C ends this worker",
                        _ => "",
                    };
                    tracing::warn!("waiting for the coordinator at {}: {error}{help}", client.url());
                }
            }
            Err(error) => {
                let message = format!("the coordinator refused worker `{}`: {error}", join.worker);
                return Err(End::refused(&error, message));
            }
        }
        // An idle worker that is leaving does not wait for a coordinator.
        if shared.is_leaving() && shared.is_idle(false) {
            return Err(End::Left);
        }
        sleep(pause).await;
        pause = (pause * 2).min(LONGEST);
    }
}

/// Timeout of a poll. If a connection hangs, another one fits within the lease. Without work to report, it is the longest
/// wait of the coordinator plus a third of a lease. With work the coordinator waits less.
fn patience(joined: &Joined, poll: &Poll) -> Duration {
    let longest = joined.poll_ms + joined.lease_ms / 3;
    Duration::from_millis(if poll.doing.is_empty() { longest } else { longest.min(joined.lease_ms / 2) })
}

/// Joins and polls until the worker may leave.
pub(crate) async fn follow(client: &Client, offer: &Join, shared: &Shared) -> End {
    let Err(end) = poll_on(client, offer, shared).await;
    end
}

async fn poll_on(client: &Client, offer: &Join, shared: &Shared) -> Result<Infallible, End> {
    let mut joined = join(client, offer, shared).await?;
    let path = format!("/v1/workers/{}/poll", offer.worker);
    let mut version = 0;
    let mut pause = SHORTEST;
    let mut refusals = 0;
    let mut leave = false;
    let mut away = false;
    loop {
        if (leave || shared.is_leaving()) && shared.is_idle(true) {
            return Err(End::Left);
        }
        let poll = shared.poll(joined.incarnation, version);
        let answer = tokio::select! {
            // A new report does not wait for new orders. The dropped poll may have been answered; the next one carries
            // the old version and gets the same answer.
            () = shared.wake.notified() => {
                sleep(SHORTEST).await;
                continue;
            }
            answer = client.poll(&path, &poll, patience(&joined, &poll)) => answer,
        };
        let answered = !answer.as_ref().is_err_and(CallError::may_pass);
        shared.flags.away.store(!answered, Ordering::SeqCst);
        match answer {
            Ok(desired) => {
                if std::mem::take(&mut away) {
                    tracing::info!("the coordinator is reachable again");
                }
                (version, leave, refusals, pause) = (desired.version, desired.leave, 0, SHORTEST);
                shared.apply(&desired);
            }
            Err(CallError::NotFound(message)) => {
                tracing::warn!("the coordinator does not know this worker process: {message}; joining again");
                joined = join(client, offer, shared).await?;
                version = 0;
                // Doubles the pause, so that a coordinator that forgets the worker again at once is not polled in a
                // tight loop.
                pause = (pause * 2).min(LONGEST);
            }
            Err(error) if error.may_pass() => {
                if !std::mem::replace(&mut away, true) {
                    tracing::warn!("cannot reach the coordinator; the stage continues: {error}");
                }
                pause = (pause * 2).min(LONGEST);
            }
            Err(error) => {
                refusals += 1;
                if refusals == REFUSALS {
                    return Err(End::refused(&error, error.to_string()));
                }
                tracing::warn!("the coordinator refused a poll: {error}");
                pause = (pause * 2).min(LONGEST);
            }
        }
        sleep(pause).await;
    }
}
