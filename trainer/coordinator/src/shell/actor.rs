//! The only task that decides. Events arrive in a queue; [`Batches`] decides the gathered events and returns the writes
//! to store, but performs no I/O. This file supplies the queue, the clock and the disk.
//!
//! If an essential part panics, the coordinator has failed. All waiting and new callers get an error at once, and
//! [`Handle::trouble`](super::Handle::trouble) reports it to the surrounding process. Acknowledged work is stored.

use std::sync::Arc;
use std::time::Instant;

use protocol::Digest;
use registry::{Store, Write, WriteError};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::actor_handle::{ActorHandle, Reply};
use super::allowances::Allowances;
use super::blocking::blocking;
use super::effects;
use super::secrets::Secrets;
use super::token_table::TokenTable;
use crate::batch::{Ask, Batches, Done, Turn};
use crate::journal::{self, Recovered};
use crate::state::State;
use crate::time::Moment;

/// Maximum number of bytes of a snapshot in one transaction.
const SNAPSHOT_BYTES: usize = 256 << 10;

/// Unpredictable bytes, derived from a random secret of the process and a counter.
#[derive(Debug)]
struct Entropy {
    secret: [u8; 32],
    count: u64,
}

impl Entropy {
    fn new() -> Self {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).expect("the system has random bytes");
        Self { secret, count: 0 }
    }

    fn next(&mut self) -> Digest {
        self.count += 1;
        let mut bytes = self.secret.to_vec();
        bytes.extend_from_slice(&self.count.to_le_bytes());
        Digest::of(&bytes)
    }
}

/// Starts the actor on a recovered state.
pub(crate) fn start(
    store: Store,
    recovered: Recovered,
    secrets: Secrets,
    tokens: Arc<TokenTable>,
    allowances: Allowances,
) -> (Arc<ActorHandle>, JoinHandle<()>) {
    let Recovered { snapshot, state } = recovered;
    let now = state.now;
    let snapshot_at = state.seq;
    let batches = Batches::new(state);
    let front = Arc::clone(batches.front());
    let (actor_handle, queue) = ActorHandle::new(store, secrets, now, front, tokens, snapshot, allowances);
    let actor_handle = Arc::new(actor_handle);
    let moments = Moments { actor_handle: Arc::clone(&actor_handle), entropy: Entropy::new() };
    let actor = Actor { actor_handle: Arc::clone(&actor_handle), batches, moments, snapshot_at, snapshot: None };
    let task = actor_handle.spawn("the actor", actor.run(queue));
    (actor_handle, task)
}

/// Source of the time and the randomness of decisions.
struct Moments {
    actor_handle: Arc<ActorHandle>,
    entropy: Entropy,
}

impl Moments {
    fn next(&mut self) -> Moment {
        Moment { now: self.actor_handle.now(), entropy: self.entropy.next() }
    }
}

struct Actor {
    actor_handle: Arc<ActorHandle>,
    batches: Batches<Reply>,
    moments: Moments,
    /// The decision of the newest snapshot, stored or in progress.
    snapshot_at: u64,
    /// The task that stores a snapshot.
    snapshot: Option<JoinHandle<()>>,
}

impl Actor {
    async fn run(mut self, mut queue: mpsc::Receiver<(Ask, Reply)>) {
        let mut stopped = self.actor_handle.stopped();
        loop {
            if self.batches.is_idle() {
                let first = tokio::select! {
                    biased;
                    _ = stopped.wait_for(|stop| *stop) => return,
                    first = queue.recv() => first,
                };
                let Some((ask, reply)) = first else { return };
                self.batches.ask(ask, reply);
            }
            while self.batches.has_room()
                && let Ok((ask, reply)) = queue.try_recv()
            {
                self.batches.ask(ask, reply);
            }
            self.snapshot_if_due();
            #[cfg(feature = "failpoints")]
            fail::fail_point!("actor::decide");
            let mut turn = self.batches.decide(|| self.moments.next());
            while let Turn::Store(writes) = turn {
                let begun = Instant::now();
                let written = self.actor_handle.store.write_proven(writes).await;
                self.actor_handle.meters.committed(begun.elapsed());
                self.actor_handle.wrote(&written);
                turn = self.batches.stored(written, || self.moments.next());
            }
            if let Turn::Done(done) = turn {
                self.done(done);
            }
        }
    }

    fn done(&self, done: Done<Reply>) {
        if done.durable {
            self.actor_handle.change();
        }
        for (reply, answer) in done.answers {
            // The caller may have gone away; the decision still holds.
            let _ = reply.send(answer);
        }
        for effect in &done.effects {
            effects::perform(&self.actor_handle, effect);
        }
    }

    /// Starts to store a snapshot in the background if enough decisions were made since the last one.
    fn snapshot_if_due(&mut self) {
        let state = self.batches.state();
        let is_over = self.snapshot.as_ref().is_none_or(JoinHandle::is_finished);
        if is_over && state.seq >= self.snapshot_at + state.policy.snapshot_every {
            self.snapshot_at = state.seq;
            let actor_handle = Arc::clone(&self.actor_handle);
            let state = Arc::clone(state);
            let storing = async move { snapshot(&actor_handle, &state).await };
            self.snapshot = Some(self.actor_handle.spawn("a snapshot task", storing));
        }
    }
}

/// Stores the parts of `state` that changed since the previous snapshot. Concurrent decisions build on this snapshot.
pub(crate) async fn snapshot(actor_handle: &ActorHandle, state: &Arc<State>) {
    let mut stored = actor_handle.snapshot.lock().await;
    if state.seq == stored.seq {
        return;
    }
    match store_snapshot(&actor_handle.store, &stored, state).await {
        Ok(()) => {
            tracing::debug!(state.seq, "stored a snapshot");
            *stored = Arc::clone(state);
        }
        // The facts are stored, so that only the next start takes longer.
        Err(error) => tracing::warn!(state.seq, %error, "cannot store a snapshot"),
    }
}

async fn store_snapshot(store: &Store, before: &Arc<State>, state: &Arc<State>) -> Result<(), WriteError> {
    let seq = state.seq;
    let old = Arc::clone(before);
    let new = Arc::clone(state);
    let mut changed = blocking(move || journal::changed_parts(&old, &new)).await.into_iter();
    // Other writes can run between these transactions.
    loop {
        let (parts, rest) = blocking(move || {
            let mut parts = Vec::new();
            let mut bytes = 0;
            while bytes < SNAPSHOT_BYTES
                && let Some(part) = changed.next()
            {
                let (name, text) = part.stored();
                bytes += name.len() + text.as_ref().map_or(0, String::len);
                parts.push((name, text));
            }
            (parts, changed)
        })
        .await;
        if parts.is_empty() {
            break;
        }
        changed = rest;
        store.write(vec![Write::SnapshotParts { seq, parts }]).await?;
    }
    store.write(vec![Write::Snapshot { seq, state: journal::snapshot(state) }]).await
}
