//! What changes the catalog: registering, promoting, rolling back. Each runs inside the writer's transaction.

use std::collections::BTreeMap;

use protocol::{Alias, ArtifactKind, Digest, ModelName};
use serde_json::Value;
use sqlx::{Row, SqliteConnection};

use super::{Action, BEST, Expect, Gate, GateResult, LATEST, ModelRef, Pick, Promotion, Version, read};
use crate::db::apply::{int, json, one, run};
use crate::db::write_error;
use crate::{WriteError, clock};

/// Which version is to be promoted.
#[derive(Debug, Clone)]
pub(crate) enum Which {
    Artifact(Digest),
    Pick(Pick),
}

/// A promotion to be made.
#[derive(Debug, Clone)]
pub(crate) struct PromoteOrder {
    pub(crate) model: ModelName,
    pub(crate) alias: Alias,
    pub(crate) to: Which,
    pub(crate) expect: Option<Expect>,
    pub(crate) require: Vec<String>,
    pub(crate) reason: String,
    pub(crate) actor: String,
}

/// Registers an artifact, or adds metrics to the version that it is already; returns the version's number.
pub(crate) async fn register(
    conn: &mut SqliteConnection,
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
    let add = sqlx::query("INSERT INTO models (model, at_ms) VALUES (?, ?) ON CONFLICT DO NOTHING");
    run(conn, add.bind(model.as_str()).bind(now)).await?;
    declare(conn, model, source).await?;

    if let Some(version) = read::version_of(conn, model, artifact).await.map_err(write_error)? {
        let mut all = version.metrics;
        all.extend(metrics.clone());
        let set = sqlx::query("UPDATE versions SET metrics = ? WHERE model = ? AND version = ?");
        run(conn, set.bind(json(&all)).bind(model.as_str()).bind(int(version.version))).await?;
        return Ok(version.version);
    }
    // The one writer makes the next number safe; the primary key would refuse a second one all the same.
    let add = sqlx::query(
        "INSERT INTO versions (model, version, artifact, metrics, source, at_ms) \
         SELECT ?1, coalesce(max(version), 0) + 1, ?2, ?3, ?4, ?5 FROM versions WHERE model = ?1 RETURNING version",
    );
    let add =
        add.bind(model.as_str()).bind(artifact.to_string()).bind(json(metrics)).bind(source.to_string()).bind(now);
    let row = add.fetch_one(&mut *conn).await.map_err(write_error)?;
    Ok(row.get::<i64, _>(0).unsigned_abs())
}

/// Which metric decides `@best` comes with the registration: `source.metric` and `source.mode`. The newest word counts.
async fn declare(conn: &mut SqliteConnection, model: &ModelName, source: &Value) -> Result<(), WriteError> {
    let (Some(metric), mode) = (source["metric"].as_str(), source["mode"].as_str().unwrap_or("min")) else {
        return Ok(());
    };
    if !matches!(mode, "min" | "max") {
        return Err(WriteError::Conflict(format!(
            "the direction of metric `{metric}` is `{mode}`; expected `min` or `max`"
        )));
    }
    let set = sqlx::query("UPDATE models SET metric = ?, mode = ? WHERE model = ?");
    run(conn, set.bind(metric).bind(mode).bind(model.as_str())).await.map(|_| ())
}

/// Moves an alias forward: compares, judges, moves, logs. Nothing changes if the alias points there already.
pub(crate) async fn promote(conn: &mut SqliteConnection, order: &PromoteOrder) -> Result<Promotion, WriteError> {
    let PromoteOrder { model, alias, .. } = order;
    refuse_reserved(alias)?;
    let candidate = match &order.to {
        Which::Artifact(artifact) => {
            read::version_of(conn, model, *artifact).await.map_err(write_error)?.ok_or_else(|| {
                WriteError::NotFound(format!("model `{model}` has no version with the artifact {artifact}"))
            })?
        }
        Which::Pick(pick) => {
            let reference = ModelRef { model: model.clone(), pick: Some(pick.clone()) };
            read::resolve_ref(conn, &reference).await.map_err(WriteError::from)?
        }
    };
    let current = pointed(conn, model, alias).await?;
    compare(model, alias, current, order.expect)?;
    let gates = judge(conn, order, &candidate).await?;
    if current == Some(candidate.version) {
        let log = read::history(conn, model, Some(alias)).await.map_err(write_error)?;
        // As it was moved, with what its gates say now.
        let moved = log.into_iter().next_back();
        return moved
            .map(|moved| Promotion { gates, ..moved })
            .ok_or_else(|| WriteError::Internal(format!("alias `{alias}` has no history")));
    }
    set_alias(conn, model, alias, Action::Promote, current, candidate.version, gates, &order.reason, &order.actor).await
}

async fn judge(
    conn: &mut SqliteConnection,
    order: &PromoteOrder,
    candidate: &Version,
) -> Result<Vec<GateResult>, WriteError> {
    let mut results = Vec::new();
    for text in &order.require {
        let gate: Gate = text.parse().map_err(|e: super::ParseGateError| WriteError::Conflict(e.to_string()))?;
        let other = match gate.alias() {
            None => None,
            Some(alias) => {
                let reference = ModelRef { model: order.model.clone(), pick: Some(Pick::Alias(alias.clone())) };
                match read::resolve_ref(conn, &reference).await {
                    Ok(version) => Some(version.metrics),
                    // The first promotion to an alias has nothing to be worse than.
                    Err(crate::QueryError::NotFound(_)) if *alias == order.alias => None,
                    Err(e) => return Err(e.into()),
                }
            }
        };
        results.push(gate.judge(&candidate.metrics, other.as_ref()));
    }
    let failed: Vec<_> = results.iter().filter(|r| !r.holds).map(|r| format!("`{}`: {}", r.gate, r.message)).collect();
    if failed.is_empty() {
        return Ok(results);
    }
    Err(WriteError::Gate(format!(
        "{}:{} may not become `{}`: {}",
        order.model,
        candidate.version,
        order.alias,
        failed.join("; ")
    )))
}

/// Moves an alias back: to `to`, or to where it pointed before its last move forward.
pub(crate) async fn rollback(
    conn: &mut SqliteConnection,
    model: &ModelName,
    alias: &Alias,
    to: Option<u64>,
    expect: Option<Expect>,
    reason: &str,
    actor: &str,
) -> Result<Promotion, WriteError> {
    refuse_reserved(alias)?;
    let Some(current) = pointed(conn, model, alias).await? else {
        return Err(WriteError::NotFound(format!(
            "model `{model}` has no alias `{alias}`; there is nothing to roll back"
        )));
    };
    compare(model, alias, Some(current), expect)?;
    let to = match to {
        Some(to) => {
            let reference = ModelRef { model: model.clone(), pick: Some(Pick::Number(to)) };
            read::resolve_ref(conn, &reference).await.map_err(WriteError::from)?.version
        }
        None => previous(conn, model, alias).await?,
    };
    if to == current {
        return Err(WriteError::Conflict(format!("alias `{alias}` of `{model}` points at version {to} already")));
    }
    set_alias(conn, model, alias, Action::Rollback, Some(current), to, Vec::new(), reason, actor).await
}

/// Reads the log as a stack: a promotion pushes, a rollback drops down to where it went. So two rollbacks in a row go back
/// two promotions instead of swinging between two versions.
async fn previous(conn: &mut SqliteConnection, model: &ModelName, alias: &Alias) -> Result<u64, WriteError> {
    let mut stack: Vec<u64> = Vec::new();
    for entry in read::history(conn, model, Some(alias)).await.map_err(write_error)? {
        if entry.action == Action::Rollback {
            match stack.iter().rposition(|version| *version == entry.to) {
                Some(at) => stack.truncate(at + 1),
                // `--to` went somewhere the alias had never been.
                None => {
                    stack.pop();
                    stack.push(entry.to);
                }
            }
        } else {
            stack.push(entry.to);
        }
    }
    stack.pop();
    stack.pop().ok_or_else(|| {
        WriteError::NotFound(format!(
            "alias `{alias}` of `{model}` has no version before this one; name one with `--to`"
        ))
    })
}

fn refuse_reserved(alias: &Alias) -> Result<(), WriteError> {
    if matches!(alias.as_str(), BEST | LATEST) {
        return Err(WriteError::Conflict(format!(
            "`{alias}` is computed from the versions and cannot be moved; choose another alias"
        )));
    }
    Ok(())
}

async fn pointed(conn: &mut SqliteConnection, model: &ModelName, alias: &Alias) -> Result<Option<u64>, WriteError> {
    let find = sqlx::query("SELECT version FROM aliases WHERE model = ? AND alias = ?");
    let row = one(conn, find.bind(model.as_str()).bind(alias.as_str())).await?;
    Ok(row.map(|row| row.get::<i64, _>(0).unsigned_abs()))
}

fn compare(model: &ModelName, alias: &Alias, current: Option<u64>, expect: Option<Expect>) -> Result<(), WriteError> {
    let found = current.map_or(Expect::None, Expect::Version);
    match expect {
        Some(expected) if expected != found => Err(WriteError::Conflict(format!(
            "alias `{alias}` of `{model}` points at {found}, not at {expected} as expected: somebody moved it; look at \
             `registry history {model}` and decide again"
        ))),
        _ => Ok(()),
    }
}

#[expect(clippy::too_many_arguments, reason = "the columns of one row")]
async fn set_alias(
    conn: &mut SqliteConnection,
    model: &ModelName,
    alias: &Alias,
    action: Action,
    from: Option<u64>,
    to: u64,
    gates: Vec<GateResult>,
    reason: &str,
    actor: &str,
) -> Result<Promotion, WriteError> {
    let at_ms = clock::now_ms();
    let set = sqlx::query(
        "INSERT INTO aliases (model, alias, version, at_ms) VALUES (?, ?, ?, ?) \
         ON CONFLICT (model, alias) DO UPDATE SET version = excluded.version, at_ms = excluded.at_ms",
    );
    run(conn, set.bind(model.as_str()).bind(alias.as_str()).bind(int(to)).bind(at_ms)).await?;
    let name = match action {
        Action::Promote => "promote",
        Action::Rollback => "rollback",
    };
    let log = sqlx::query(
        "INSERT INTO promotions (at_ms, model, alias, action, from_version, to_version, actor, reason, gates) \
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING id",
    );
    let log = log.bind(at_ms).bind(model.as_str()).bind(alias.as_str()).bind(name).bind(from.map(int)).bind(int(to));
    let row = log.bind(actor).bind(reason).bind(json(&gates)).fetch_one(&mut *conn).await.map_err(write_error)?;
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
