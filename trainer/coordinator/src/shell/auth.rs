//! Bearer tokens.

use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use protocol::Digest;

use super::api::Failure;

/// Lets a request pass if it bears the token whose digest is `expected`. Digests are compared, so that the time it takes
/// says nothing about the token.
pub(crate) async fn require_token(State(expected): State<Option<Digest>>, request: Request, next: Next) -> Response {
    let Some(expected) = expected else { return next.run(request).await };
    let header = request.headers().get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
    let borne = header.and_then(|value| value.strip_prefix("Bearer ")).map(|token| Digest::of(token.trim().as_bytes()));
    if borne == Some(expected) {
        return next.run(request).await;
    }
    Failure::new(StatusCode::UNAUTHORIZED, "unauthorized", "this coordinator wants a token".to_owned())
        .hint("send `Authorization: Bearer TOKEN`; the command line takes it from `--token` or STRIDE_TOKEN")
        .into_response()
}
