//! Delivery of messages to webhooks, in the order of the history's rows.
//!
//! The last row that a hook received is stored, so a restart repeats at most one message. A message that is not
//! delivered is sent again, six times as late each time, and at last given up. The hook's later messages wait for it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ::webhooks::{Client, Hook, Hooks, Message, Undelivered};
use protocol::RunId;
use registry::{HistoryKind, HistoryQuery, HistoryRow, QueryError, Store, WriteError};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::actor_handle::ActorHandle;
use super::clock::wall_clock;

/// Number of times that a message is sent.
const TRIES: u32 = 6;
/// Number of rows read at a time.
const ROWS: u32 = 200;
/// Time between two reads.
const PAUSE: Duration = Duration::from_secs(1);
/// Time after which rows are looked for even if nothing seems to have changed.
const LOOK: Duration = Duration::from_secs(30);

/// Serves the listed hooks, and another list once it changes, until the coordinator stops.
pub(super) async fn serve(actor_handle: Arc<ActorHandle>, mut listed: watch::Receiver<Hooks>, retry: Duration) {
    let mut stopped = actor_handle.stopped();
    loop {
        // Dropping the set ends the delivery to the earlier hooks.
        let mut sending = JoinSet::new();
        let hooks = listed.borrow_and_update().clone();
        for hook in hooks.iter() {
            sending.spawn(Sender::run(Arc::clone(&actor_handle), hook.clone(), retry));
        }
        tokio::select! {
            _ = stopped.wait_for(|stop| *stop) => return,
            changed = listed.changed() => if changed.is_err() { return },
        }
    }
}

/// Records the newest row as the place of each new hook, which gets no earlier row.
pub(super) async fn enlist(store: &Store, hooks: &Hooks) -> Result<(), WriteError> {
    for hook in hooks.iter() {
        if store.delivered(&hook.name).await?.is_none() {
            let (_, newest) = store.history_span().await?;
            store.record_delivery(&hook.name, newest).await?;
        }
    }
    Ok(())
}

/// One hook and its place in the history.
struct Sender {
    actor_handle: Arc<ActorHandle>,
    hook: Hook,
    client: Client,
    retry: Duration,
    delivered: i64,
    /// The failed stage of each run that has not ended yet.
    causes: BTreeMap<RunId, HistoryRow>,
}

impl Sender {
    async fn run(actor_handle: Arc<ActorHandle>, hook: Hook, retry: Duration) {
        let client = match Client::new() {
            Ok(client) => client,
            Err(Undelivered(why)) => {
                tracing::warn!(hook = %hook.name, "cannot send messages to webhooks: {why}");
                return;
            }
        };
        let mut sender = Self { actor_handle, hook, client, retry, delivered: 0, causes: BTreeMap::new() };
        let mut changes = sender.actor_handle.changes();
        sender.delivered = loop {
            match sender.actor_handle.store.delivered(&sender.hook.name).await {
                Ok(place) => break place.unwrap_or_default(),
                Err(error) => tracing::warn!(hook = %sender.hook.name, %error, "cannot read the place of a webhook"),
            }
            sleep(PAUSE).await;
        };
        loop {
            changes.mark_unchanged();
            match sender.rows().await {
                Ok(rows) => {
                    let more = rows.len() >= ROWS as usize;
                    for row in rows {
                        sender.row(row).await;
                    }
                    if more {
                        continue;
                    }
                }
                Err(error) => tracing::warn!(hook = %sender.hook.name, %error, "cannot read the history"),
            }
            sleep(PAUSE).await;
            // A time-out is fine: the history is read again.
            if let Ok(Err(_)) = timeout(LOOK, changes.changed()).await {
                return;
            }
        }
    }

    async fn rows(&self) -> Result<Vec<HistoryRow>, QueryError> {
        let asked = HistoryQuery { run: None, worker: None, after: self.delivered, since_ms: None, limit: ROWS };
        self.actor_handle.seen_store(self.hook.project.as_ref()).timeline(&asked).await
    }

    /// Sends the message about a row, if there is one for the hook.
    async fn row(&mut self, row: HistoryRow) {
        let id = row.id;
        let cause = row.entry.run.as_ref().and_then(|run| self.causes.get(run));
        if let Some(message) = Message::of(&row, cause).filter(|message| self.hook.wants(message.topic)) {
            self.send(&message).await;
            if let Err(error) = self.actor_handle.store.record_delivery(&self.hook.name, id).await {
                tracing::warn!(hook = %self.hook.name, %error, "cannot record the delivery of a message; a restart repeats it");
            }
        }
        self.delivered = id;
        match (row.entry.kind, row.entry.run.clone()) {
            (HistoryKind::Failed, Some(run)) => drop(self.causes.insert(run, row)),
            (HistoryKind::Ended | HistoryKind::Resumed, Some(run)) => drop(self.causes.remove(&run)),
            _ => {}
        }
    }

    /// Sends a message until it is delivered or given up.
    async fn send(&self, message: &Message) {
        let mut wait = self.retry;
        let meters = &self.actor_handle.meters;
        for left in (0..TRIES).rev() {
            let now_s = wall_clock().0 / 1000;
            let Err(Undelivered(why)) = self.client.post(&self.hook, message, now_s).await else {
                return meters.sent("delivered");
            };
            let hook = &self.hook.name;
            let id = &message.id;
            if left == 0 {
                tracing::warn!(hook, id, "a message was not delivered and is given up: {why}");
                return meters.sent("given up");
            }
            tracing::warn!(hook, id, "a message was not delivered: {why}; trying again in {} s", wait.as_secs());
            meters.sent("not delivered");
            sleep(wait).await;
            wait *= 6;
        }
    }
}
