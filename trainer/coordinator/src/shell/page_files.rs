//! The files of the page (crate `page`) and of the book (crate `book`). They need no token: they reveal only that a server is
//! running, and its version.

use std::sync::Arc;

use axum::Router;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;

use super::actor_handle::ActorHandle;
use super::extract::Path;
use super::failure::Failure;
use super::tickets::StreamOffer;

/// A file under the name of its build never changes.
const FOR_EVER: &str = "public, max-age=31536000, immutable";
/// The document names the build, so a browser asks for it each time.
const ASK_AGAIN: &str = "no-cache";
/// Content policy of API answers: browsers must not execute stored content.
const DATA_POLICY: &str = "default-src 'none'; frame-ancestors 'none'; sandbox";

pub(super) fn router(stream: Option<&StreamOffer>) -> Router<Arc<ActorHandle>> {
    let policy: Arc<str> = page::content_policy(stream.map(StreamOffer::origin)).into();
    let document = get(move |headers: HeaderMap| {
        let policy = Arc::clone(&policy);
        async move { answer(page::index(), &headers, ASK_AGAIN, &policy) }
    });
    let router = page::VIEWS.iter().fold(Router::new(), |router, view| router.route(view, document.clone()));
    router
        .route("/page/{folder}/{*name}", get(file))
        .route("/book", get(|| async { Redirect::permanent("/book/") }))
        .route("/book/", get(|headers| async { chapter(Path(book::FIRST.to_owned()), headers).await }))
        .route("/book/{*name}", get(chapter))
}

async fn chapter(Path(name): Path<String>, headers: HeaderMap) -> Response {
    match book::find(&name) {
        Some(file) => answer(file, &headers, ASK_AGAIN, book::CONTENT_POLICY),
        None => {
            let message = format!("the book has no page `{name}`");
            Failure::new(StatusCode::NOT_FOUND, "not-found", message).hint("/book/ lists its chapters").into_response()
        }
    }
}

async fn file(Path((folder, name)): Path<(String, String)>, headers: HeaderMap) -> Response {
    match page::find(&folder, &name) {
        Some(file) => answer(file, &headers, FOR_EVER, page::CONTENT_POLICY),
        None => {
            let message = "this build of the server has no such file of the page".to_owned();
            Failure::new(StatusCode::NOT_FOUND, "not-found", message).hint("load the page again").into_response()
        }
    }
}

fn answer(file: &'static page::File, headers: &HeaderMap, cache: &'static str, policy: &str) -> Response {
    let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let known = text(header::IF_NONE_MATCH).split(',').any(|tag| tag.trim().trim_start_matches("W/") == file.tag);
    let common = [
        (header::ETAG, file.tag.as_str()),
        (header::CACHE_CONTROL, cache),
        (header::VARY, "accept-encoding"),
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ];
    if known {
        return (StatusCode::NOT_MODIFIED, common).into_response();
    }
    let kind = [(header::CONTENT_TYPE, file.kind)];
    let takes_gzip =
        text(header::ACCEPT_ENCODING).split(',').any(|word| word.split(';').next().map(str::trim) == Some("gzip"));
    if takes_gzip && !file.gzip.is_empty() {
        return (common, kind, [(header::CONTENT_ENCODING, "gzip")], file.gzip.as_slice()).into_response();
    }
    (common, kind, file.bytes.as_slice()).into_response()
}

/// Has no browser guess what an answer is, and show or keep what is no file of the page.
pub(super) async fn keep_from_pages(mut response: Response) -> Response {
    let headers = response.headers_mut();
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    if !headers.contains_key(header::CONTENT_SECURITY_POLICY) {
        headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(DATA_POLICY));
        headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    }
    response
}
