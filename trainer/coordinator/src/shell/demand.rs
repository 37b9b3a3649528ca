//! The call of launchers: the demand, or a wait for a change of it.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use protocol::demand::Demand;
use protocol::stage::Backend;
use protocol::{Labels, limits};
use schemars::JsonSchema;
use serde::Deserialize;
use tokio::time::{Instant, sleep_until, timeout_at};

use super::actor_handle::ActorHandle;
use super::extract::Query;
use super::failure::Failure;

/// Shortest time between two computations for one call.
const PAUSE: Duration = Duration::from_millis(500);

/// `?launcher=&labels=&backend=&after=&wait=`.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct DemandQuery {
    /// Random name of the launcher's process; without one, the call only looks.
    launcher: Option<String>,
    /// Labels of the workers that it starts, separated by commas.
    #[serde(default)]
    labels: String,
    /// Backend of the workers that it starts.
    #[serde(default)]
    backend: Backend,
    /// The version that the caller has; another one is answered at once.
    after: Option<u64>,
    /// Seconds to wait for another version.
    #[serde(default)]
    wait: u32,
}

pub(crate) async fn demand(
    State(actor_handle): State<Arc<ActorHandle>>,
    Query(query): Query<DemandQuery>,
) -> Result<Json<Demand>, Failure> {
    let DemandQuery { launcher, labels, backend, after, wait } = query;
    let labels: Labels = labels.parse().map_err(|error| Failure::invalid(format!("`labels`: {error}")))?;
    if launcher.as_deref().is_some_and(|name| !protocol::id::is_name(name)) {
        return Err(Failure::invalid("`launcher` is not a name".to_owned()));
    }
    let kind = (backend, labels);
    let wait = Duration::from_secs(wait.min(limits::DEMAND_WAIT_S).into());
    let lease_ms = actor_handle.state().policy.lease_ms;
    let leads = |more: Duration| {
        let now = actor_handle.now();
        let until = now.after(lease_ms).after(more.as_millis() as u64);
        launcher.as_ref().map_or(Ok(false), |launcher| actor_handle.launchers.lead(&kind, launcher, now, until))
    };
    leads(wait)?;
    let deadline = Instant::now() + wait;
    let mut changes = actor_handle.changes();
    let mut stopped = actor_handle.stopped();
    let demand = loop {
        changes.mark_unchanged();
        let demand = actor_handle.state().demand(actor_handle.now());
        if after != Some(demand.version) || Instant::now() >= deadline {
            break demand;
        }
        let has_changed = tokio::select! {
            changed = timeout_at(deadline, changes.changed()) => matches!(changed, Ok(Ok(()))),
            _ = stopped.wait_for(|stop| *stop) => return Err(actor_handle.over().into()),
        };
        if has_changed {
            sleep_until((Instant::now() + PAUSE).min(deadline)).await;
        }
    };
    let lead_ms = if leads(Duration::ZERO)? { lease_ms } else { 0 };
    Ok(Json(Demand { lead_ms, ..demand }))
}
