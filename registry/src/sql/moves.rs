//! Changes of models and aliases: registration, promotion, rollback. Each runs inside the writer's transaction.

use std::collections::BTreeMap;

use protocol::{Alias, ArtifactKind, Digest, ModelName};
use serde_json::Value;

use super::error::write_error;
use super::statement::{Conn, int, json, one, query, run};
use super::{history, models};
use crate::catalog::{PromoteOrder, RollbackOrder, Which};
use crate::history::{HistoryEntry, HistoryKind};
use crate::versions::{self, Action, Gate, GateResult, ModelRef, Pick, Promotion, Version};
use crate::{QueryError, WriteError, clock};

/// Registers an artifact, or adds metrics to its existing version. Returns the version's number.
pub(super) async fn register(
    conn: &mut Conn<'_>,
    model: &ModelName,
    artifact: Digest,
    kind: ArtifactKind,
    metrics: &BTreeMap<String, f64>,
    source: &Value,
) -> Result<u64, WriteError> {
    if kind != ArtifactKind::Model {
        let kind = json(&kind);
        return Err(WriteError::Conflict(format!(
            "artifact {artifact} is of kind {kind}; only kind \"model\" can be registered"
        )));
    }
    let now = clock::now_ms();
    let add = query("INSERT INTO models (model, at_ms) VALUES (?, ?) ON CONFLICT DO NOTHING");
    run(conn, add.bind(model.as_str()).bind(now)).await?;
    declare(conn, model, source).await?;

    // One row, because this runs inside the writer's transaction and a model may have thousands of versions.
    let find = query("SELECT version, metrics FROM versions WHERE model = ? AND artifact = ?");
    let find = find.bind(model.as_str()).bind(artifact.to_string());
    if let Some(row) = find.fetch_optional(&mut *conn).await.map_err(write_error)? {
        let (version, known): (i64, String) = (row.get(0), row.get(1));
        let mut all = models::numbers(&known);
        all.extend(metrics.clone());
        let set = query("UPDATE versions SET metrics = ? WHERE model = ? AND version = ?");
        run(conn, set.bind(json(&all)).bind(model.as_str()).bind(version)).await?;
        return Ok(version.unsigned_abs());
    }
    // The single writer makes the next number safe; the primary key refuses a duplicate as well.
    let add = query(
        "INSERT INTO versions (model, version, artifact, metrics, source, at_ms) \
         SELECT ?1, coalesce(max(version), 0) + 1, ?2, ?3, ?4, ?5 FROM versions WHERE model = ?1 RETURNING version",
    );
    let add =
        add.bind(model.as_str()).bind(artifact.to_string()).bind(json(metrics)).bind(source.to_string()).bind(now);
    let row = add.fetch_one(&mut *conn).await.map_err(write_error)?;
    Ok(row.get::<i64, _>(0).unsigned_abs())
}

/// Stores the metric that ranks `@best`, from `source.metric` and `source.mode` of the newest registration.
async fn declare(conn: &mut Conn<'_>, model: &ModelName, source: &Value) -> Result<(), WriteError> {
    let (Some(metric), mode) = (source["metric"].as_str(), source["mode"].as_str().unwrap_or("min")) else {
        return Ok(());
    };
    if !matches!(mode, "min" | "max") {
        return Err(WriteError::Conflict(format!(
            "the direction of metric `{metric}` is `{mode}`; expected `min` or `max`"
        )));
    }
    let set = query("UPDATE models SET metric = ?, mode = ? WHERE model = ?");
    run(conn, set.bind(metric).bind(mode).bind(model.as_str())).await.map(|_| ())
}

/// Returns the version that a reference names.
async fn resolve(conn: &mut Conn<'_>, model: &ModelName, pick: Pick) -> Result<Version, QueryError> {
    let reference = ModelRef { model: model.clone(), pick: Some(pick) };
    match models::model(conn, model).await? {
        None => Err(versions::unknown(model, &models::models(conn).await?)),
        Some((model, versions)) => versions::pick(&reference, &model, &versions),
    }
}

/// Moves an alias forward: compares, checks the gates, moves, logs. Changes nothing if the alias already points there.
pub(super) async fn promote(conn: &mut Conn<'_>, order: &PromoteOrder) -> Result<Promotion, WriteError> {
    let PromoteOrder { model, alias, .. } = order;
    versions::refuse_reserved(alias)?;
    let candidate = match &order.to {
        Which::Artifact(artifact) => {
            let versions = models::versions(conn, model).await.map_err(write_error)?;
            versions.into_iter().find(|version| version.artifact == *artifact).ok_or_else(|| {
                WriteError::NotFound(format!("model `{model}` has no version with the artifact {artifact}"))
            })?
        }
        Which::Pick(pick) => resolve(conn, model, pick.clone()).await?,
    };
    let current = pointed(conn, model, alias).await?;
    versions::compare(model, alias, current, order.expect)?;
    let gates = versions::gates(&order.require)?;
    let others = compared_with(conn, order, &gates).await?;
    let gates = versions::evaluate(&gates, &candidate, alias, &others)?;
    if current == Some(candidate.version) {
        let log = models::history(conn, model, Some(alias)).await.map_err(write_error)?;
        // The logged move with the current results of its gates.
        let moved = log.into_iter().next_back();
        return moved
            .map(|moved| Promotion { gates, ..moved })
            .ok_or_else(|| WriteError::Internal(format!("alias `{alias}` has no history")));
    }
    let moved = Move { model, alias, action: Action::Promote, from: current, to: candidate.version };
    set_alias(conn, moved, gates, &order.reason, &order.actor).await
}

/// Returns the metrics of the versions that gates compare with, by alias.
async fn compared_with(
    conn: &mut Conn<'_>,
    order: &PromoteOrder,
    gates: &[Gate],
) -> Result<BTreeMap<Alias, BTreeMap<String, f64>>, WriteError> {
    let mut metrics = BTreeMap::new();
    for alias in gates.iter().filter_map(Gate::alias) {
        match resolve(conn, &order.model, Pick::Alias(alias.clone())).await {
            Ok(version) => drop(metrics.insert(alias.clone(), version.metrics)),
            // The first promotion to an alias has no version to compare with.
            Err(QueryError::NotFound(_)) if *alias == order.alias => {}
            Err(e) => return Err(e.into()),
        }
    }
    Ok(metrics)
}

/// Moves an alias back, to `to` or to its version before the last promotion.
pub(super) async fn rollback(conn: &mut Conn<'_>, order: &RollbackOrder) -> Result<Promotion, WriteError> {
    let RollbackOrder { model, alias, .. } = order;
    versions::refuse_reserved(alias)?;
    let Some(current) = pointed(conn, model, alias).await? else {
        return Err(WriteError::NotFound(format!(
            "model `{model}` has no alias `{alias}`; there is nothing to roll back"
        )));
    };
    versions::compare(model, alias, Some(current), order.expect)?;
    let to = match order.to {
        Some(to) => resolve(conn, model, Pick::Number(to)).await?.version,
        None => {
            let log = models::history(conn, model, Some(alias)).await.map_err(write_error)?;
            versions::previous(&log).ok_or_else(|| {
                WriteError::NotFound(format!(
                    "alias `{alias}` of `{model}` has no version before this one; name one with `--to`"
                ))
            })?
        }
    };
    if to == current {
        return Err(WriteError::Conflict(format!("alias `{alias}` of `{model}` points at version {to} already")));
    }
    let moved = Move { model, alias, action: Action::Rollback, from: Some(current), to };
    set_alias(conn, moved, Vec::new(), &order.reason, &order.actor).await
}

async fn pointed(conn: &mut Conn<'_>, model: &ModelName, alias: &Alias) -> Result<Option<u64>, WriteError> {
    let find = query("SELECT version FROM aliases WHERE model = ? AND alias = ?");
    let row = one(conn, find.bind(model.as_str()).bind(alias.as_str())).await?;
    Ok(row.map(|row| row.get::<i64, _>(0).unsigned_abs()))
}

/// A move of an alias.
struct Move<'a> {
    model: &'a ModelName,
    alias: &'a Alias,
    action: Action,
    from: Option<u64>,
    to: u64,
}

async fn set_alias(
    conn: &mut Conn<'_>,
    moved: Move<'_>,
    gates: Vec<GateResult>,
    reason: &str,
    actor: &str,
) -> Result<Promotion, WriteError> {
    let Move { model, alias, action, from, to } = moved;
    let at_ms = clock::now_ms();
    let set = query(
        "INSERT INTO aliases (model, alias, version, at_ms) VALUES (?, ?, ?, ?) \
         ON CONFLICT (model, alias) DO UPDATE SET version = excluded.version, at_ms = excluded.at_ms",
    );
    run(conn, set.bind(model.as_str()).bind(alias.as_str()).bind(int(to)).bind(at_ms)).await?;
    let name = match action {
        Action::Promote => "promote",
        Action::Rollback => "rollback",
    };
    let log = query(
        "INSERT INTO promotions (at_ms, model, alias, action, from_version, to_version, actor, reason, gates) \
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING id",
    );
    let log = log.bind(at_ms).bind(model.as_str()).bind(alias.as_str()).bind(name).bind(from.map(int)).bind(int(to));
    let row = log.bind(actor).bind(reason).bind(json(&gates)).fetch_one(&mut *conn).await.map_err(write_error)?;
    let kind = match action {
        Action::Promote => HistoryKind::Promoted,
        Action::Rollback => HistoryKind::RolledBack,
    };
    let model_name = Some(model.clone());
    let why = format!("@{alias} is version {to}: {reason}");
    let entry =
        HistoryEntry { model: model_name, actor: Some(actor.to_owned()), why: Some(why), ..HistoryEntry::new(kind) };
    history::add(conn, &[entry], clock::now_ms()).await?;
    Ok(Promotion {
        id: row.get(0),
        at_ms,
        model: model.clone(),
        alias: alias.clone(),
        action,
        from,
        to,
        actor: actor.to_owned(),
        reason: reason.to_owned(),
        gates,
    })
}
