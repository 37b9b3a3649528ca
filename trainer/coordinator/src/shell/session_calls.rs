//! The calls by which a browser signs in and out ([`sessions`](super::sessions)), and enters streams
//! ([`tickets`](super::tickets)).

use std::sync::Arc;

use access::{Caller, Scope};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::{Extension, Json};
use schemars::JsonSchema;
use serde::Serialize;

use super::actor_handle::ActorHandle;
use super::audit::Object;
use super::auth::{self, Gate};
use super::clock::wall_clock;
use super::failure::Failure;
use super::sessions::{self, Current, Holder, LASTS_S};
use super::tickets::Ticket;
use super::token_table::Standing;

/// Makes a ticket for the page that asks.
pub(crate) async fn ticket(Extension(gate): Extension<Arc<Gate>>, headers: HeaderMap) -> Result<Json<Ticket>, Failure> {
    let Some(offer) = &gate.stream else {
        let message = "this server's page has no stream".to_owned();
        return Err(Failure::new(StatusCode::NOT_FOUND, "not-found", message)
            .hint("start it with `--stream`; programs show a token to `trainer generate --listen` themselves"));
    };
    let origin = headers.get(header::ORIGIN).and_then(|origin| origin.to_str().ok());
    let origin = origin.ok_or_else(|| Failure::invalid("a ticket is for a page, which sends `Origin`".to_owned()))?;
    Ok(Json(offer.ticket(origin)))
}

/// The caller and its scopes, which determine the buttons of the page.
#[derive(Debug, Serialize, JsonSchema)]
pub(crate) struct Who {
    name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    project: Option<String>,
    scopes: Vec<&'static str>,
    /// Until when the session lasts, in milliseconds since 1970; `None` for a token.
    #[serde(skip_serializing_if = "Option::is_none")]
    until_ms: Option<u64>,
    /// The server's clock, in milliseconds since 1970.
    now_ms: u64,
    /// The name of the store's folder.
    store: String,
    version: &'static str,
    /// True if the page may stream motions.
    streams: bool,
}

fn who(caller: &Caller, until_ms: Option<u64>, gate: &Gate, actor_handle: &ActorHandle) -> Json<Who> {
    let scopes = Scope::ALL.into_iter().filter(|scope| caller.scopes.allow(*scope)).map(Scope::name).collect();
    let dir = std::path::absolute(actor_handle.store.dir()).unwrap_or_default();
    // A store is mostly called `.stride`; the folder that it lies in says more.
    let named = dir.iter().rev().find(|part| !part.to_string_lossy().starts_with('.'));
    Json(Who {
        name: caller.name.clone(),
        project: caller.project.clone(),
        scopes,
        until_ms,
        now_ms: wall_clock().0,
        store: named.map(|part| part.to_string_lossy().into_owned()).unwrap_or_default(),
        version: env!("CARGO_PKG_VERSION"),
        streams: gate.stream.is_some(),
    })
}

/// Returns the caller.
pub(crate) async fn look(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Extension(gate): Extension<Arc<Gate>>,
    session: Option<Extension<Current>>,
) -> Json<Who> {
    who(&caller, session.map(|Extension(session)| session.until_ms), &gate, &actor_handle)
}

type Answer<T> = Result<([(HeaderName, String); 1], Extension<Object>, T), Failure>;

/// Buys a session for a token, or for the key of a printed link.
pub(crate) async fn begin(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Extension(gate): Extension<Arc<Gate>>,
    Extension(standing): Extension<Standing>,
    request: Request,
) -> Answer<Json<Who>> {
    let sessions = gate.sessions.as_ref().ok_or_else(no_sessions)?;
    let token = standing.token();
    let holder = if gate.tokens.users_own() == Some(token) { Holder::Own } else { Holder::Token(token) };
    let (session, value) = sessions.begin(holder);
    let encrypted = auth::is_encrypted(&request);
    let name = sessions::cookie_name(request.headers(), encrypted);
    let cookie = sessions::set_cookie(&name, &value, LASTS_S, encrypted);
    let object = Extension(Object::Changed("sign in".to_owned()));
    Ok(([(header::SET_COOKIE, cookie)], object, who(&caller, Some(session.until_ms), &gate, &actor_handle)))
}

/// Ends the caller's session.
pub(crate) async fn end(
    Extension(gate): Extension<Arc<Gate>>,
    session: Option<Extension<Current>>,
    request: Request,
) -> Answer<Json<()>> {
    let sessions = gate.sessions.as_ref().ok_or_else(no_sessions)?;
    if let Some(Extension(session)) = session {
        sessions.end(&session);
    }
    let encrypted = auth::is_encrypted(&request);
    let cookie = sessions::set_cookie(&sessions::cookie_name(request.headers(), encrypted), "", 0, encrypted);
    Ok(([(header::SET_COOKIE, cookie)], Extension(Object::Changed("sign out".to_owned())), Json(())))
}

fn no_sessions() -> Failure {
    Failure::new(axum::http::StatusCode::NOT_FOUND, "not-found", "this address has no page".to_owned())
}
