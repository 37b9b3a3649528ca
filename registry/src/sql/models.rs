//! Reads of models, versions and moves, over any connection.

use std::collections::BTreeMap;

use protocol::stage::Mode;
use protocol::{Alias, Digest, ModelName};

use super::statement::{Conn, Row, query};
use crate::versions::{self, Action, Model, Promotion, Version};

/// Parses stored metrics; null becomes NaN.
pub(super) fn numbers(text: &str) -> BTreeMap<String, f64> {
    let stored: BTreeMap<String, Option<f64>> = serde_json::from_str(text).unwrap_or_default();
    stored.into_iter().map(|(key, value)| (key, value.unwrap_or(f64::NAN))).collect()
}

pub(super) fn digest(row: &Row, column: &str) -> Result<Digest, sqlx::Error> {
    let text: String = row.try_get(column)?;
    text.parse().map_err(|e| sqlx::Error::ColumnDecode { index: column.to_owned(), source: Box::new(e) })
}

fn number(row: &Row, column: &str) -> Result<u64, sqlx::Error> {
    Ok(row.try_get::<i64, _>(column)?.unsigned_abs())
}

/// Reads a version; takes its names out of `aliases`.
fn version(row: &Row, aliases: &mut BTreeMap<u64, Vec<String>>) -> Result<Version, sqlx::Error> {
    let version = number(row, "version")?;
    Ok(Version {
        model: ModelName::new(row.try_get::<String, _>("model")?),
        version,
        artifact: digest(row, "artifact")?,
        metrics: numbers(row.try_get("metrics")?),
        source: serde_json::from_str(row.try_get("source")?).unwrap_or_default(),
        created_ms: row.try_get("at_ms")?,
        aliases: aliases.remove(&version).unwrap_or_default(),
    })
}

/// Returns all versions of a model, oldest first.
pub(super) async fn versions(conn: &mut Conn<'_>, model: &ModelName) -> Result<Vec<Version>, sqlx::Error> {
    let named = query("SELECT version, alias FROM aliases WHERE model = ? ORDER BY alias");
    let mut aliases: BTreeMap<u64, Vec<String>> = BTreeMap::new();
    for row in named.bind(model.as_str()).fetch_all(&mut *conn).await? {
        aliases.entry(number(&row, "version")?).or_default().push(row.try_get("alias")?);
    }
    let rows = query("SELECT * FROM versions WHERE model = ? ORDER BY version").bind(model.as_str());
    rows.fetch_all(&mut *conn).await?.iter().map(|row| version(row, &mut aliases)).collect()
}

/// Returns true if there is such a model.
pub(super) async fn exists(conn: &mut Conn<'_>, model: &ModelName) -> Result<bool, sqlx::Error> {
    Ok(declared(conn, model).await?.is_some())
}

/// Returns the model's version with this artifact.
pub(super) async fn version_of(
    conn: &mut Conn<'_>,
    model: &ModelName,
    artifact: Digest,
) -> Result<Option<Version>, sqlx::Error> {
    let find = query("SELECT * FROM versions WHERE model = ? AND artifact = ?");
    let find = find.bind(model.as_str()).bind(artifact.to_string());
    let Some(row) = find.fetch_optional(&mut *conn).await? else { return Ok(None) };
    let of = number(&row, "version")?;
    let named = query("SELECT alias FROM aliases WHERE model = ? AND version = ? ORDER BY alias");
    let named = named.bind(model.as_str()).bind(row.try_get::<i64, _>("version")?).fetch_all(&mut *conn).await?;
    let names = named.iter().map(|row| row.try_get("alias")).collect::<Result<_, _>>()?;
    version(&row, &mut BTreeMap::from([(of, names)])).map(Some)
}

async fn declared(
    conn: &mut Conn<'_>,
    model: &ModelName,
) -> Result<Option<(Option<String>, Option<Mode>)>, sqlx::Error> {
    let row = query("SELECT metric, mode FROM models WHERE model = ?")
        .bind(model.as_str())
        .fetch_optional(&mut *conn)
        .await?;
    let Some(row) = row else { return Ok(None) };
    let mode = row.try_get::<Option<String>, _>("mode")?.map(|mode| if mode == "max" { Mode::Max } else { Mode::Min });
    Ok(Some((row.try_get("metric")?, mode)))
}

/// Returns one model and its versions, oldest first.
pub(super) async fn model(conn: &mut Conn<'_>, name: &ModelName) -> Result<Option<(Model, Vec<Version>)>, sqlx::Error> {
    let Some((metric, mode)) = declared(conn, name).await? else { return Ok(None) };
    let versions = versions(conn, name).await?;
    Ok(Some((versions::summary(name.clone(), metric, mode, &versions), versions)))
}

/// Returns all models by name.
pub(super) async fn models(conn: &mut Conn<'_>) -> Result<Vec<Model>, sqlx::Error> {
    let rows = query("SELECT model FROM models ORDER BY model").fetch_all(&mut *conn).await?;
    let mut models = Vec::with_capacity(rows.len());
    for row in rows {
        let found = model(conn, &ModelName::new(row.try_get::<String, _>(0)?)).await?;
        models.extend(found.map(|(model, _)| model));
    }
    Ok(models)
}

/// Returns the moves of a model's aliases, or of one alias, oldest first.
pub(super) async fn history(
    conn: &mut Conn<'_>,
    model: &ModelName,
    alias: Option<&Alias>,
) -> Result<Vec<Promotion>, sqlx::Error> {
    let find = query("SELECT * FROM promotions WHERE model = ?1 AND (?2 IS NULL OR alias = ?2) ORDER BY id");
    let rows = find.bind(model.as_str()).bind(alias.map(Alias::as_str)).fetch_all(&mut *conn).await?;
    let mut history = Vec::new();
    for row in &rows {
        history.push(Promotion {
            id: row.try_get("id")?,
            at_ms: row.try_get("at_ms")?,
            model: model.clone(),
            alias: Alias::new(row.try_get::<String, _>("alias")?),
            action: if row.try_get::<String, _>("action")? == "rollback" { Action::Rollback } else { Action::Promote },
            from: row.try_get::<Option<i64>, _>("from_version")?.map(i64::unsigned_abs),
            to: number(row, "to_version")?,
            actor: row.try_get("actor")?,
            reason: row.try_get("reason")?,
            gates: serde_json::from_str(row.try_get("gates")?).unwrap_or_default(),
        });
    }
    Ok(history)
}
