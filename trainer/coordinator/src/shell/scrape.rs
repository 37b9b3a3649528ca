//! `GET /metrics`: the server's own numbers for Prometheus, as OpenMetrics text if the client asks for it and else as the
//! text of Prometheus. No label names a run, a model, a worker or a token, so that the number of series does not grow with
//! use.

use std::collections::BTreeSet;
use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use super::actor_handle::ActorHandle;
use super::failure::Failure;
use super::meters::Labels;
use super::queries::accepts;

const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
const PLAIN: &str = "text/plain; version=0.0.4; charset=utf-8";

pub(crate) async fn metrics(
    State(actor_handle): State<Arc<ActorHandle>>,
    headers: HeaderMap,
) -> Result<impl IntoResponse, Failure> {
    let mut text = String::new();
    encode(&mut text, &registry(&actor_handle)).map_err(|error| {
        Failure::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal",
            format!("cannot encode the server's metrics: {error}"),
        )
    })?;
    let open = accepts(&headers, "application/openmetrics-text");
    let (kind, text) = if open { (OPEN_METRICS, text) } else { (PLAIN, plain(&text)) };
    Ok(([(header::CONTENT_TYPE, kind), (header::VARY, "accept")], text))
}

/// The same numbers in Prometheus' own text, which names a counter as its samples and has no units and no end.
fn plain(open: &str) -> String {
    let counters: BTreeSet<&str> =
        open.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.strip_suffix(" counter")).collect();
    let renamed = |line: &str| {
        let (word, rest) = line.strip_prefix("# ")?.split_once(' ')?;
        let (name, rest) = rest.split_once(' ')?;
        counters.contains(name).then(|| format!("# {word} {name}_total {rest}"))
    };
    let kept = open.lines().filter(|line| *line != "# EOF" && !line.starts_with("# UNIT "));
    kept.map(|line| renamed(line).unwrap_or_else(|| line.to_owned()) + "\n").collect()
}

fn registry(actor_handle: &ActorHandle) -> Registry {
    let state = actor_handle.state();
    let meters = &actor_handle.meters;
    let mut registry = Registry::with_prefix("stride");
    registry.register("answers", "Answers to calls by class of status", meters.answers.clone());
    let help = "Time until a transaction of decisions is on disk";
    registry.register_with_unit("commit", help, Unit::Seconds, meters.commits.clone());
    registry.register("values", "Values that workers have recorded", meters.values.clone());
    registry.register("lines", "Log lines that workers have written", meters.lines.clone());
    let help = "Bytes of blobs that pass through the server";
    registry.register_with_unit("blob", help, Unit::Bytes, meters.blob_bytes.clone());
    registry.register("messages", "Messages to webhooks by result", meters.messages.clone());

    let runs = Family::<Labels, Gauge>::default();
    for run in state.runs.values() {
        let name = format!("{:?}", run.state).to_lowercase();
        runs.get_or_create(&vec![("state", name)]).inc();
    }
    registry.register("runs", "Runs that have not ended by state", runs);
    let workers = Family::<Labels, Gauge>::default();
    for worker in state.workers.values() {
        let working = if worker.holds.is_some() { "working" } else { "idle" };
        let name = if worker.is_away() { "away" } else { working };
        workers.get_or_create(&vec![("state", name.to_owned())]).inc();
    }
    registry.register("workers", "Workers by state", workers);
    let stages = Family::<Labels, Gauge>::default();
    for execution in state.executions.values().filter(|execution| !execution.is_over()) {
        let name = if execution.is_busy() { "working" } else { "waiting" };
        let kind = execution.settings.kind().to_owned();
        stages.get_or_create(&vec![("kind", kind), ("state", name.to_owned())]).inc();
    }
    registry.register("stages", "Stages with work to do by kind and state", stages);
    let decisions = Counter::<u64>::default();
    decisions.inc_by(state.recorded);
    registry.register("facts", "Facts that decisions have recorded since the start", decisions);

    let database: Gauge = Gauge::default();
    database.set(i64::try_from(actor_handle.store.database_bytes()).unwrap_or(i64::MAX));
    registry.register_with_unit("database", "Size of the database and its log", Unit::Bytes, database);
    let trouble: Gauge = Gauge::default();
    trouble.set(i64::from(actor_handle.storage().is_some()));
    registry.register("storage_trouble", "1 while the store cannot be read or written", trouble);
    registry
}
