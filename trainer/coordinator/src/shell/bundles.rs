//! `POST /v1/bundles`: imports a bundle of another store as a version of this one.
//!
//! The body is written to a file first, because a bundle is read twice and an incomplete one must store nothing.

use std::fs::File;
use std::io::Write as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use access::Caller;
use axum::Extension;
use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::StatusCode;
use futures::StreamExt as _;
use protocol::limits;
use schemars::JsonSchema;
use serde::Deserialize;

use super::actor_handle::ActorHandle;
use super::blocking::blocking;
use super::extract::Query;
use super::failure::Failure;

/// Longest pause of a body before the upload counts as cut off.
const BODY_IDLE: Duration = Duration::from_secs(30);
/// Number that keeps the files of concurrent imports apart.
static NUMBER: AtomicU64 = AtomicU64::new(0);

/// Query parameters: `?model=`.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct BundleQuery {
    /// Name of the imported model.
    model: Option<String>,
}

/// A temporary file, removed on drop.
struct TemporaryFile(PathBuf);

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        // A file left behind is removed when the store is opened again.
        let _ = std::fs::remove_file(&self.0);
    }
}

pub(crate) async fn import(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Query(query): Query<BundleQuery>,
    body: Body,
) -> Result<Json<registry::cli::Answer>, Failure> {
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let dir = actor_handle.store.dir().join("staging");
    let received = TemporaryFile(dir.join(format!("bundle-{number}")));
    let path = received.0.clone();
    let stored = |e: std::io::Error| Failure::new(StatusCode::INSUFFICIENT_STORAGE, "storage", e.to_string());
    let file = blocking(move || std::fs::create_dir_all(&dir).and_then(|()| File::create(&path))).await;
    receive(file.map_err(stored)?, body).await?;
    // The caller adds its own file name to messages.
    let model = query.model.as_deref();
    Ok(Json(registry::cli::import(&actor_handle.store, &received.0, "bundle", model, caller.owner()).await))
}

async fn receive(mut file: File, body: Body) -> Result<(), Failure> {
    let cut = |why: String| Failure::new(StatusCode::REQUEST_TIMEOUT, "cut", format!("the bundle was cut off: {why}"));
    let mut body = body.into_data_stream();
    let mut length = 0u64;
    loop {
        let part = match tokio::time::timeout(BODY_IDLE, body.next()).await {
            Ok(Some(Ok(part))) => part,
            Ok(Some(Err(error))) => return Err(cut(error.to_string())),
            Ok(None) => return Ok(()),
            Err(_) => return Err(cut(format!("no data arrived for {} s", BODY_IDLE.as_secs()))),
        };
        length += part.len() as u64;
        if length > limits::BUNDLE_BYTES as u64 {
            return Err(Failure::too_large(limits::BUNDLE_BYTES));
        }
        let written = blocking(move || file.write_all(&part).map(|()| file)).await;
        file = written.map_err(|e| Failure::new(StatusCode::INSUFFICIENT_STORAGE, "storage", e.to_string()))?;
    }
}
