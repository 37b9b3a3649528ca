//! `GET /v1/events`: the rows of the history as they are added, as a stream that a client can resume.
//!
//! A stream holds one batch of rows at a time and reads the next one only when the client has taken it. Batches are at
//! least [`PAUSE`] apart, so that many changes come together. A client that is too far behind gets the event
//! `resync`: it must read everything again. Its stream continues with the newest row.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use access::Caller;
use axum::Extension;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures::Stream;
use protocol::{Group, RunId, WorkerId, limits};
use registry::{HistoryQuery, HistoryRow};
use schemars::JsonSchema;
use serde::Deserialize;
use serde_json::json;
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until, timeout};

use super::actor_handle::ActorHandle;
use super::extract::Query;
use super::failure::Failure;
use super::turn::turn;

/// Time between two batches.
const PAUSE: Duration = Duration::from_millis(250);
/// Time after which a silent stream says that it is alive.
const PING: Duration = Duration::from_secs(15);
/// Number of rows of one batch.
const BATCH: u32 = 200;
/// Header with the last row that a client has seen; browsers send it when they connect again.
pub(super) const LAST_EVENT_ID: &str = "last-event-id";

/// Query parameters: `?run=&worker=&after=&lasts=`.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct EventsQuery {
    /// Only events of this run.
    run: Option<RunId>,
    /// Only events of this worker.
    worker: Option<WorkerId>,
    /// The last row that the client has seen; without it, the stream begins with the next one.
    after: Option<i64>,
    /// Seconds after which the stream ends, for clients behind a proxy that ends long answers.
    lasts: Option<u32>,
}

/// A place among the streams of a token.
#[derive(Debug)]
struct Place {
    actor_handle: Arc<ActorHandle>,
    name: String,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.actor_handle.streams.leave(&self.name);
    }
}

/// One client's stream.
struct Listener {
    place: Place,
    changes: watch::Receiver<u64>,
    sees: Option<Group>,
    asked: HistoryQuery,
    /// Events that the client has not taken yet.
    waiting: VecDeque<Event>,
    /// Time of the next batch.
    next: Instant,
    /// More rows than one batch may be there.
    more: bool,
    /// Time at which the stream ends.
    until: Option<Instant>,
}

impl Listener {
    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.waiting.pop_front() {
                return Some(event);
            }
            let until = self.until;
            let ends = async {
                match until {
                    Some(until) => sleep_until(until).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                () = ends => return None,
                changed = self.changed() => changed.ok()?,
            }
            self.next = Instant::now() + PAUSE;
            match self.read().await {
                Ok(events) => self.waiting = events,
                // The client asks again, and gets the reason.
                Err(_) => return None,
            }
        }
    }

    /// Waits for the time of the next batch and for something to be in it.
    async fn changed(&mut self) -> Result<(), watch::error::RecvError> {
        sleep_until(self.next).await;
        if self.more { Ok(()) } else { self.changes.changed().await }
    }

    /// Reads the rows that the client does not have.
    async fn read(&mut self) -> Result<VecDeque<Event>, Failure> {
        let actor_handle = Arc::clone(&self.place.actor_handle);
        let _turn = turn(&actor_handle).await?;
        self.changes.mark_unchanged();
        let records = actor_handle.records_for(self.sees.clone());
        let mut events = VecDeque::new();
        let (oldest, newest) = records.history_span().await?;
        let lost = oldest.is_some_and(|oldest| oldest > self.asked.after.saturating_add(1)) && self.asked.after > 0;
        if lost || newest.saturating_sub(self.asked.after) > i64::from(limits::EVENTS_BEHIND) {
            self.asked.after = newest;
            events.push_back(Event::default().event("resync").id(newest.to_string()).data(json!({}).to_string()));
        }
        let rows = records.history(&self.asked).await?;
        self.more = rows.len() >= BATCH as usize;
        match rows.last() {
            Some(last) => self.asked.after = last.id,
            // Rows of others, too, are behind the client now.
            None => self.asked.after = self.asked.after.max(newest),
        }
        events.extend(rows.iter().map(event));
        Ok(events)
    }
}

fn event(row: &HistoryRow) -> Event {
    Event::default().event("history").id(row.id.to_string()).data(json!(row).to_string())
}

pub(crate) async fn events(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    headers: HeaderMap,
    Query(query): Query<EventsQuery>,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, Failure> {
    let resumed = headers.get(LAST_EVENT_ID).map(|id| id.to_str().ok().and_then(|id| id.parse::<i64>().ok()));
    let resumed = match resumed {
        None => None,
        Some(Some(id)) if id >= 0 => Some(id),
        Some(_) => return Err(Failure::invalid(format!("`{LAST_EVENT_ID}` is no id of an event"))),
    };
    let EventsQuery { run, worker, after, lasts } = query;
    if after.is_some_and(|after| after < 0) {
        return Err(Failure::invalid("`after` is less than 0".to_owned()));
    }
    let changes = actor_handle.changes();
    let records = actor_handle.records_for(caller.sees());
    let (_, newest) = records.history_span().await?;
    let after = resumed.or(after).unwrap_or(newest);
    // Refuses a run that the caller does not see.
    let asked = HistoryQuery { run, worker, after, since_ms: None, limit: BATCH };
    records.history(&HistoryQuery { limit: 1, ..asked.clone() }).await?;
    actor_handle.streams.enter(&caller.name)?;
    let place = Place { actor_handle: Arc::clone(&actor_handle), name: caller.name.clone() };
    let hello = Event::default().event("ready").id(after.to_string()).data(json!({"after": after}).to_string());
    let listener = Listener {
        place,
        changes,
        sees: caller.sees(),
        asked,
        waiting: VecDeque::from([hello]),
        next: Instant::now(),
        more: true,
        until: lasts.map(|seconds| Instant::now() + Duration::from_secs(seconds.into())),
    };
    let events = futures::stream::unfold(listener, |mut listener| async move {
        let event = listener.next().await?;
        Some((Ok(event), listener))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(PING)))
}

/// Waits until there are rows, or for at most `wait`.
pub(super) async fn wait_for_rows(
    actor_handle: &ActorHandle,
    sees: Option<Group>,
    asked: &HistoryQuery,
    wait: Duration,
) -> Result<Vec<HistoryRow>, Failure> {
    let until = Instant::now() + wait;
    let mut changes = actor_handle.changes();
    loop {
        changes.mark_unchanged();
        let rows = {
            let _turn = turn(actor_handle).await?;
            actor_handle.records_for(sees.clone()).history(asked).await?
        };
        let left = until.saturating_duration_since(Instant::now());
        if !rows.is_empty() || left.is_zero() || !matches!(timeout(left, changes.changed()).await, Ok(Ok(()))) {
            return Ok(rows);
        }
        sleep_until((Instant::now() + PAUSE).min(until)).await;
    }
}
