//! Collection of audit records: calls are noted in memory and written once a second, so that no call waits for the log.
//!
//! Every change has a record of its own. Refusals and reads are counted by caller, call, address and status: the first
//! one is recorded at once, further ones share one record per minute (reads: per ten minutes). If too many combinations
//! occur, the rest is counted together. A flood of refused calls thus causes a limited number of records; the file has
//! a limit of its own. Successful polls and uploads of workers are not recorded, because the run's own records have
//! them.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use access::{Caller, Scope};
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::Response;
use registry::audit::{AuditEntry, AuditLog};
use tokio::sync::watch;

use super::blocking::blocking;
use super::clock::wall_clock;
use super::listener::Peer;
use super::route::Route;

/// Interval between writes.
const FLUSH: Duration = Duration::from_secs(1);
/// Period for which refusals share a record.
const REFUSED_MS: i64 = 60_000;
/// Period for which reads share a record.
const READ_MS: i64 = 600_000;
/// Maximum number of combinations counted separately.
const KINDS: usize = 1024;
/// Maximum number of records waiting to be written.
const WAITING: usize = 4096;

/// The effect of a call; handlers attach it to their answer.
#[derive(Debug, Clone)]
pub(crate) enum Object {
    /// The call changed the named object.
    Changed(String),
    /// The call only read.
    Read,
}

/// The caller and route of an admitted call; the gate attaches them to the answer.
#[derive(Debug, Clone)]
pub(crate) struct Admitted {
    pub(crate) caller: Option<Arc<Caller>>,
    pub(crate) route: Route,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Kind {
    who: String,
    call: String,
    from: String,
    status: u16,
}

#[derive(Debug)]
struct Counted {
    first_ms: i64,
    last_ms: i64,
    /// Calls that no record covers yet.
    count: u64,
    due_ms: i64,
}

#[derive(Debug, Default)]
struct Pending {
    lines: Vec<AuditEntry>,
    counted: BTreeMap<Kind, Counted>,
    /// Number of changes without a record, for lack of room.
    lost: u64,
}

/// Records to write.
#[derive(Debug, Default)]
pub(crate) struct Audit(Mutex<Pending>);

impl Audit {
    fn note(&self, admitted: Option<&Admitted>, object: Option<&Object>, from: String, status: StatusCode) {
        let now_ms = i64::try_from(wall_clock().0).unwrap_or(i64::MAX);
        let refused = status.is_client_error() || status.is_server_error();
        let call = admitted.map_or_else(|| "-".to_owned(), |it| format!("{} {}", it.route.method, it.route.path));
        let who =
            admitted.and_then(|it| it.caller.as_ref()).map_or_else(|| "-".to_owned(), |it| it.owner().to_string());
        let is_read = matches!(object, Some(Object::Read)) || admitted.is_none_or(|it| it.route.method == "GET");
        let mut pending = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let kind = Kind { who, call, from, status: status.as_u16() };
        if refused {
            pending.count(kind, now_ms, REFUSED_MS);
        } else if is_read {
            pending.count(kind, now_ms, READ_MS);
        } else {
            let Kind { who, call, from, status } = kind;
            // Callers choose names; a record stores only the beginning of a long one.
            let object = match object {
                Some(Object::Changed(name)) => protocol::printable::beginning(name),
                Some(Object::Read) | None => String::new(),
            };
            let line = AuditEntry { at_ms: now_ms, until_ms: None, who, call, object, from, status, count: 1 };
            pending.line(line);
        }
    }

    /// Removes and returns the records that are due; all of them if `last` is set.
    fn take(&self, now_ms: i64, last: bool) -> Vec<AuditEntry> {
        let mut pending = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Pending { lines, counted, lost } = &mut *pending;
        let mut taken = std::mem::take(lines);
        counted.retain(|kind, counted| {
            let is_due = last || now_ms >= counted.due_ms;
            if is_due && counted.count > 0 {
                taken.push(kind.line(counted.first_ms, counted.last_ms, counted.count));
            }
            !is_due
        });
        if std::mem::take(lost) > 0 {
            tracing::warn!("the audit log lost records: too many changes in a second");
        }
        taken
    }
}

impl Kind {
    fn line(&self, first_ms: i64, last_ms: i64, count: u64) -> AuditEntry {
        let Self { who, call, from, status } = self.clone();
        let until_ms = (last_ms > first_ms).then_some(last_ms);
        AuditEntry { at_ms: first_ms, until_ms, who, call, object: String::new(), from, status, count }
    }
}

impl Pending {
    fn line(&mut self, line: AuditEntry) {
        if self.lines.len() < WAITING {
            self.lines.push(line);
        } else {
            self.lost += 1;
        }
    }

    fn count(&mut self, kind: Kind, now_ms: i64, window_ms: i64) {
        let is_full = self.counted.len() >= KINDS && !self.counted.contains_key(&kind);
        // Other combinations share one record per status; there are few statuses.
        let kind = if is_full { Kind { who: "*".into(), call: "*".into(), from: "*".into(), ..kind } } else { kind };
        match self.counted.get_mut(&kind) {
            Some(counted) => {
                if counted.count == 0 {
                    counted.first_ms = now_ms;
                }
                counted.count += 1;
                counted.last_ms = now_ms;
            }
            None => {
                self.line(kind.line(now_ms, now_ms, 1));
                let due_ms = now_ms.saturating_add(window_ms);
                self.counted.insert(kind, Counted { first_ms: now_ms, last_ms: now_ms, count: 0, due_ms });
            }
        }
    }
}

/// Returns true for worker calls that are not recorded on success.
fn is_telemetry(route: &Route) -> bool {
    route.scopes == [Scope::Worker] && !matches!(route.path, "/v1/workers" | "/v1/workers/{worker}/gone")
}

/// Notes each call with its result.
pub(crate) async fn note(State(audit): State<Arc<Audit>>, request: Request, next: Next) -> Response {
    let from = request.extensions().get::<Arc<Peer>>().map(|peer| peer.from());
    let is_health = request.uri().path() == "/v1/health";
    let response = next.run(request).await;
    let admitted = response.extensions().get::<Admitted>();
    let leave_out = response.status().as_u16() < 400 && admitted.is_none_or(|it| is_telemetry(&it.route));
    if !leave_out && !is_health {
        let object = response.extensions().get::<Object>();
        let from = from.map_or_else(|| "-".to_owned(), |from: IpAddr| from.to_canonical().to_string());
        audit.note(admitted, object, from, response.status());
    }
    response
}

/// Writes noted records until `stopped`, then a last time.
pub(crate) async fn write(audit: Arc<Audit>, log: AuditLog, mut stopped: watch::Receiver<bool>) {
    let log = Arc::new(log);
    let mut last = false;
    while !last {
        // An error means that the coordinator has ended, which counts as a stop.
        last = tokio::time::timeout(FLUSH, stopped.wait_for(|stop| *stop)).await.is_ok();
        let lines = audit.take(i64::try_from(wall_clock().0).unwrap_or(i64::MAX), last);
        if lines.is_empty() {
            continue;
        }
        let log = Arc::clone(&log);
        if let Err(error) = blocking(move || log.append(&lines)).await {
            tracing::warn!(%error, "cannot write the audit log");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn refused(audit: &Audit, from: u32) {
        audit.note(None, None, Ipv4Addr::from_bits(from).to_string(), StatusCode::UNAUTHORIZED);
    }

    #[test]
    fn refused_calls_are_counted_and_not_listed() {
        let audit = Audit::default();
        for _ in 0..2000 {
            refused(&audit, 1);
        }
        let first = audit.take(0, false);
        assert_eq!(first.iter().map(|line| line.count).collect::<Vec<_>>(), [1], "at once");
        let rest = audit.take(i64::MAX, false);
        assert_eq!(rest.iter().map(|line| line.count).collect::<Vec<_>>(), [1999], "a minute later");
        assert!(audit.take(i64::MAX, true).is_empty());
    }

    #[test]
    fn a_crowd_of_addresses_is_bounded_and_every_call_is_counted() {
        let audit = Audit::default();
        let mut lines = Vec::new();
        let calls = 20_000;
        for i in 0..calls {
            refused(&audit, i);
            if i % 500 == 0 {
                lines.extend(audit.take(0, false));
            }
        }
        lines.extend(audit.take(0, true));
        assert!(lines.len() < 2 * KINDS, "{} lines", lines.len());
        assert_eq!(lines.iter().map(|line| line.count).sum::<u64>(), u64::from(calls));
    }
}
