//! Owners of runs and models as rows.

use std::collections::BTreeMap;

use protocol::{Group, ModelName, Owner, RunId};

use super::statement::{Conn, json, one, query, run as execute};
use crate::WriteError;

/// Records the group that owns a run.
pub(super) async fn own_run(conn: &mut Conn<'_>, run: &RunId, owner: &Group) -> Result<(), WriteError> {
    let add = query("INSERT INTO run_owners (run, owner) VALUES (?, ?) ON CONFLICT DO NOTHING");
    execute(conn, add.bind(run.as_str()).bind(owner.as_str())).await.map(|_| ())
}

/// Deletes the owner of a run.
pub(super) async fn disown_run(conn: &mut Conn<'_>, run: &RunId) -> Result<(), WriteError> {
    execute(conn, query("DELETE FROM run_owners WHERE run = ?").bind(run.as_str())).await.map(|_| ())
}

/// Records the owner of a new model. An existing model must be under the owner's control.
pub(super) async fn claim(conn: &mut Conn<'_>, model: &ModelName, owner: &Owner) -> Result<(), WriteError> {
    let find =
        "SELECT (SELECT owner FROM model_owners WHERE model = ?1), EXISTS (SELECT 1 FROM models WHERE model = ?1)";
    let row = one(conn, query(find).bind(model.as_str())).await?;
    let (group, exists): (Option<String>, bool) = row.map_or((None, false), |row| (row.get(0), row.get(1)));
    let is_its_own = match &group {
        Some(group) => owner.controls(&Group::new(group)),
        None => owner.admin || !exists,
    };
    if !is_its_own {
        return Err(WriteError::Conflict(foreign(model)));
    }
    if !exists && !owner.group().as_str().is_empty() {
        let add = query("INSERT INTO model_owners (model, owner) VALUES (?, ?) ON CONFLICT DO NOTHING");
        execute(conn, add.bind(model.as_str()).bind(owner.group().as_str())).await?;
    }
    Ok(())
}

fn foreign(model: &ModelName) -> String {
    format!("model `{model}` belongs to another owner; register under another name, or use a token of its project")
}

/// Returns the groups that own all models, or one model.
pub(super) async fn of_models(
    conn: &mut Conn<'_>,
    model: Option<&ModelName>,
) -> Result<BTreeMap<ModelName, Group>, sqlx::Error> {
    let find = "SELECT model, owner FROM model_owners WHERE ?1 IS NULL OR model = ?1";
    let rows = query(find).bind(model.map(ModelName::as_str)).fetch_all(&mut *conn).await?;
    rows.iter()
        .map(|row| Ok((ModelName::new(row.try_get::<String, _>(0)?), Group::new(row.try_get::<String, _>(1)?))))
        .collect()
}

/// Returns the groups that own runs; runs without an owner are missing.
pub(super) async fn of_runs(conn: &mut Conn<'_>, runs: &[RunId]) -> Result<BTreeMap<RunId, Group>, sqlx::Error> {
    let find = "SELECT run, owner FROM run_owners WHERE run IN {texts ?}";
    let rows = query(find).bind(json(&runs)).fetch_all(&mut *conn).await?;
    rows.iter()
        .map(|row| Ok((RunId::new(row.try_get::<String, _>(0)?), Group::new(row.try_get::<String, _>(1)?))))
        .collect()
}
