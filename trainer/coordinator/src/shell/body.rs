//! Reading of request bodies within limits of size, time and memory. Large ones are parsed on a blocking thread.

use std::sync::Arc;

use axum::body::HttpBody;
use axum::extract::{FromRequest, Request};
use axum::http::{StatusCode, header};
use serde::de::DeserializeOwned;
use tokio::sync::OwnedSemaphorePermit;

use super::auth::Gate;
use super::blocking::blocking;
use super::failure::Failure;
use super::route::Route;

/// Bodies above this size wait for memory and are parsed outside the threads that answer heartbeats.
const LARGE: usize = 64 << 10;

/// A JSON message like `axum::Json`, limited by its route and by the memory for all bodies together. A large one
/// returns its share of that memory when it has been answered.
#[derive(Debug)]
pub(crate) struct Message<T>(
    pub(crate) T,
    #[allow(dead_code, reason = "held for as long as the message is, not read")] pub(crate) Option<OwnedSemaphorePermit>,
);

impl<S: Sync, T: DeserializeOwned + Send + 'static> FromRequest<S> for Message<T> {
    type Rejection = Failure;

    async fn from_request(request: Request, _: &S) -> Result<Self, Failure> {
        let extensions = request.extensions();
        let (Some(gate), Some(route)) = (extensions.get::<Arc<Gate>>().cloned(), extensions.get::<Route>().copied())
        else {
            return Err(Failure::new(
                StatusCode::INTERNAL_SERVER_ERROR,
                "internal",
                "a route without a gate".to_owned(),
            ));
        };
        let is_json = |text: &str| text.split(';').next().is_some_and(|kind| kind.trim() == "application/json");
        let kind = request.headers().get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
        if !kind.is_some_and(is_json) {
            let message = "expected `content-type: application/json`".to_owned();
            return Err(Failure::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "invalid", message));
        }
        // Reserves the route's limit if the length is unknown. Small bodies, such as heartbeats, never wait here.
        let most = HttpBody::size_hint(request.body()).upper().and_then(|most| usize::try_from(most).ok());
        let most = most.unwrap_or(route.body).min(route.body);
        let permit = if most > LARGE {
            let kibibytes = u32::try_from(most.div_ceil(1 << 10)).unwrap_or(u32::MAX);
            // The semaphore is never closed.
            gate.bodies.clone().acquire_many_owned(kibibytes).await.ok()
        } else {
            None
        };
        let bytes = axum::body::to_bytes(request.into_body(), route.body).await.map_err(|e| unread(&e, route.body))?;
        let parsed = if bytes.len() > LARGE {
            blocking(move || serde_json::from_slice(&bytes)).await
        } else {
            serde_json::from_slice(&bytes)
        };
        parsed
            .map(|message| Self(message, permit))
            .map_err(|error| Failure::invalid(format!("cannot parse the body: {error}")))
    }
}

fn unread(error: &axum::Error, limit: usize) -> Failure {
    let mut cause: Option<&dyn std::error::Error> = Some(error);
    while let Some(inner) = cause {
        if inner.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::TimedOut) {
            return Failure::new(StatusCode::REQUEST_TIMEOUT, "slow", inner.to_string());
        }
        if inner.to_string().contains("length limit exceeded") {
            return Failure::too_large(limit);
        }
        cause = inner.source();
    }
    Failure::new(StatusCode::REQUEST_TIMEOUT, "cut", format!("the body was cut off: {error}"))
}
