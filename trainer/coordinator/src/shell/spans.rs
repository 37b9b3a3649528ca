//! A span for each request, with the path as the table of calls has it.

use axum::extract::{MatchedPath, Request};
use axum::middleware::Next;
use axum::response::Response;
use telemetry::SPANS;
use tracing::field::Empty;
use tracing::{Instrument as _, Span};

/// Answers a request within its span, which ends with the head of the answer.
pub(crate) async fn request(request: Request, next: Next) -> Response {
    let span = span(&request);
    if span.is_disabled() {
        return next.run(request).await;
    }
    let response = next.run(request).instrument(span.clone()).await;
    let status = response.status();
    span.record("http.response.status_code", status.as_u16());
    if status.is_server_error() {
        span.record("otel.status_code", "ERROR");
    }
    response
}

fn span(request: &Request) -> Span {
    let method = request.method();
    let path = request.extensions().get::<MatchedPath>();
    // Without a path of the table, as for a page's file, the name must not be of the client's making.
    let path = path.map_or("/", MatchedPath::as_str);
    tracing::trace_span!(
        target: SPANS, "request", otel.name = %format_args!("{method} {path}"), otel.kind = "server",
        http.request.method = %method, http.route = path, http.response.status_code = Empty, otel.status_code = Empty
    )
}
