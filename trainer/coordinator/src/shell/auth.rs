//! Authentication and authorisation: every call shows a token, whose scopes determine what it may do.
//!
//! A browser on this machine can be made to send calls to this server, by a page of another site or by a name rebound
//! to our address. Neither has a token. They are refused even before the token check, by `Host` and `Origin`.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use access::{Caller, Scope};
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use protocol::{Digest, limits};
use tokio::sync::Semaphore;

use super::audit::{Admitted, Audit};
use super::failure::Failure;
use super::listener::Peer;
use super::paced::Paced;
use super::rate::Rates;
use super::revocable::Revocable;
use super::route::Route;
use super::sessions::{self, Current, Holder, Sessions};
use super::tickets::{StreamOffer, Tickets};
use super::token_table::{Standing, TokenTable, Unknown};

/// The header of every call of the page; its value does not matter.
pub(crate) const PAGE_HEADER: &str = "x-stride-page";
/// The call that buys a session, the only one for which a printed link's key is good.
pub(crate) const BEGIN: (&str, &str) = ("POST", "/v1/session");

/// The state shared by all authentication checks.
#[derive(Debug)]
pub(crate) struct Gate {
    pub(crate) tokens: Arc<TokenTable>,
    pub(crate) audit: Arc<Audit>,
    /// Sessions of browsers; `None` where there is no page.
    pub(crate) sessions: Option<Arc<Sessions>>,
    /// The stream for which the page gets tickets.
    pub(crate) stream: Option<StreamOffer>,
    /// Tickets that others made; `None` where no browser enters with one.
    tickets: Option<Tickets>,
    /// Accepted host names; IP addresses are always accepted.
    hosts: Vec<String>,
    /// Kibibytes of request bodies that may be in memory.
    pub(crate) bodies: Arc<Semaphore>,
    rates: Rates,
}

impl Gate {
    pub(crate) fn new(tokens: Arc<TokenTable>, hosts: &[String], calls: u32) -> Self {
        let mut names = vec!["localhost".to_owned()];
        if let Ok(own) = nix::unistd::gethostname()
            && let Ok(own) = own.into_string()
        {
            names.extend(own.split_once('.').map(|(first, _)| first.to_owned()));
            names.push(own);
        }
        names.extend(hosts.iter().cloned());
        let bodies = Arc::new(Semaphore::new(limits::CALLS_BYTES >> 10));
        Self {
            tokens,
            audit: Arc::default(),
            sessions: None,
            stream: None,
            tickets: None,
            hosts: names,
            bodies,
            rates: Rates::new(calls),
        }
    }

    /// The same, for browsers with tickets of other servers too.
    pub(crate) fn with_tickets(self) -> Self {
        Self { tickets: Some(Tickets::default()), ..self }
    }

    /// The same, for browsers too, whose page may offer a stream.
    pub(crate) fn with_sessions(self, sessions: Arc<Sessions>, stream: Option<StreamOffer>) -> Self {
        Self { sessions: Some(sessions), stream, ..self }
    }

    /// The caller of a request to `route`, by its token or its session.
    fn caller(&self, request: &Request, route: &Route) -> Result<Shown, Failure> {
        let headers = request.headers();
        let (token, session) = match headers.get(header::AUTHORIZATION) {
            Some(shown) => (self.shown(shown, route), None),
            None => match self.session(request)? {
                Some(session) => (self.token_of(session.holder), Some(session)),
                None => {
                    (self.tickets.as_ref().and_then(|tickets| tickets.redeem(headers, &self.tokens.current())), None)
                }
            },
        };
        let token = token.ok_or_else(|| unauthorized(&Unknown::Missing))?;
        let caller = self.tokens.find(token).map_err(|unknown| unauthorized(&unknown))?;
        let standing = Standing::new(Arc::clone(&self.tokens), token, Arc::clone(&caller));
        Ok(Shown { caller, standing, session })
    }

    /// The digest of the token that a header shows; that of this process's user for a key of a printed link.
    fn shown(&self, header: &HeaderValue, route: &Route) -> Option<Digest> {
        let (scheme, word) = header.to_str().ok()?.split_once(' ')?;
        if scheme.eq_ignore_ascii_case("bearer") {
            return Some(access::digest_of(word));
        }
        let is_key = scheme.eq_ignore_ascii_case("key") && (route.method, route.path) == BEGIN;
        let good = is_key && self.sessions.as_ref().is_some_and(|sessions| sessions.redeem(word));
        if good { self.tokens.users_own() } else { None }
    }

    /// The session whose cookie a request has. Calls that change something are only taken from our own page.
    fn session(&self, request: &Request) -> Result<Option<Current>, Failure> {
        let headers = request.headers();
        let name = sessions::cookie_name(headers, is_encrypted(request));
        let (Some(sessions), Some(value)) = (&self.sessions, sessions::cookie(headers, &name)) else { return Ok(None) };
        let Some(session) = sessions.find(value) else { return Ok(None) };
        let from = headers.get("sec-fetch-site").map(HeaderValue::as_bytes);
        let from_elsewhere = from.is_some_and(|from| from != b"same-origin" && from != b"none");
        let changes = !matches!(*request.method(), Method::GET | Method::HEAD);
        // That an `Origin` is ours was looked at before anything else.
        let from_page = headers.contains_key(header::ORIGIN) && headers.contains_key(PAGE_HEADER);
        if from_elsewhere || (changes && !from_page) {
            let message = format!("a session only makes calls of its own page: with `Origin` and `{PAGE_HEADER}`");
            return Err(Failure::new(StatusCode::FORBIDDEN, "origin", message).hint("programs show a token instead"));
        }
        Ok(Some(Arc::new(session)))
    }

    fn token_of(&self, holder: Holder) -> Option<Digest> {
        match holder {
            Holder::Own => self.tokens.users_own(),
            Holder::Token(digest) => Some(digest),
        }
    }

    /// Limits the calls per second of tokens without the scope `worker`. Workers are limited by their own waits.
    fn is_too_fast(&self, caller: &Caller) -> Option<Failure> {
        if caller.scopes.allow(Scope::Worker) {
            return None;
        }
        self.rates.take(&caller.name, Instant::now()).err()?;
        let message = format!("the token of `{}` exceeds its calls per second", caller.name);
        Some(Failure::busy(message).hint("call less often, or start the server with a larger `--max-calls-per-second`"))
    }

    /// The reason for refusing a call that none of our clients would send.
    fn refuses(&self, headers: &HeaderMap) -> Option<Failure> {
        let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str().unwrap_or("?"));
        let host = text(header::HOST).unwrap_or_default();
        if !self.is_ours(host) {
            let message = format!("`{host}` is not a name of this server");
            let failure = Failure::new(StatusCode::MISDIRECTED_REQUEST, "host", message);
            return Some(failure.hint("use its address, or start it with `--host NAME` for each of its names"));
        }
        let origin = text(header::ORIGIN)?;
        let authority = origin.split_once("://").filter(|(scheme, _)| matches!(*scheme, "http" | "https"));
        if authority.is_some_and(|(_, authority)| authority.eq_ignore_ascii_case(host)) {
            return None;
        }
        if self.tickets.as_ref().is_some_and(|tickets| tickets.vouches(headers, &self.tokens.current())) {
            return None;
        }
        let message = format!("a page of `{origin}` may not call this server");
        Some(Failure::new(StatusCode::FORBIDDEN, "origin", message))
    }

    /// Returns true for any IP address, which cannot be rebound, and for the server's own names.
    fn is_ours(&self, authority: &str) -> bool {
        let host = match authority.strip_prefix('[') {
            Some(v6) => v6.split_once(']').map_or("", |(host, _)| host),
            None => authority.split_once(':').map_or(authority, |(host, _)| host),
        };
        host.parse::<IpAddr>().is_ok() || self.hosts.iter().any(|name| name.eq_ignore_ascii_case(host))
    }
}

/// The identity that a call shows.
struct Shown {
    caller: Arc<Caller>,
    /// Its right to be answered.
    standing: Standing,
    session: Option<Current>,
}

/// Returns true if a request came over TLS.
pub(crate) fn is_encrypted(request: &Request) -> bool {
    request.extensions().get::<Arc<Peer>>().is_some_and(|peer| peer.is_encrypted())
}

/// Refuses requests that a browser was made to send.
pub(crate) async fn check_host(State(gate): State<Arc<Gate>>, request: Request, next: Next) -> Response {
    match gate.refuses(request.headers()) {
        Some(failure) => closing(failure),
        None => next.run(request).await,
    }
}

/// Admits a request to `route` if its token has one of the route's scopes. Nothing of the body is read before.
pub(crate) async fn admit(State((gate, route)): State<(Arc<Gate>, Route)>, request: Request, next: Next) -> Response {
    let shown = gate.caller(&request, &route);
    let caller = shown.as_ref().ok().map(|shown| Arc::clone(&shown.caller));
    let mut response = match shown {
        Ok(shown) => admitted_call(&gate, route, shown, request, next).await,
        Err(failure) => closing(failure),
    };
    response.extensions_mut().insert(Admitted { caller, route });
    response
}

async fn admitted_call(gate: &Arc<Gate>, route: Route, shown: Shown, mut request: Request, next: Next) -> Response {
    let Shown { caller, standing, session } = shown;
    if let Some(peer) = request.extensions().get::<Arc<Peer>>()
        && let Err(failure) = peer.authenticate(&caller)
    {
        return closing(failure);
    }
    if let Some(failure) = gate.is_too_fast(&caller) {
        return failure.into_response();
    }
    if !route.scopes.iter().any(|scope| caller.scopes.allow(*scope)) {
        return closing(forbidden(&caller, route.scopes));
    }
    let length = request.headers().get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    if length.is_some_and(|length: usize| length > route.body) {
        return closing(Failure::too_large(route.body));
    }
    let extensions = request.extensions_mut();
    extensions.insert(caller);
    extensions.insert(Arc::clone(gate));
    extensions.insert(route);
    extensions.insert(standing.clone());
    if let Some(session) = session {
        extensions.insert(session);
    }
    let request = request.map(|body| Body::new(Paced::new(body)));
    let answered = tokio::select! {
        biased;
        () = standing.clone().lost() => return closing(unauthorized(&Unknown::Nobody)),
        answered = tokio::time::timeout(route.time, next.run(request)) => answered,
    };
    match answered {
        Ok(response) => response.map(|body| Body::new(Revocable::new(body, standing))),
        Err(_) => closing(late(route.time)),
    }
}

fn unauthorized(unknown: &Unknown) -> Failure {
    match unknown {
        Unknown::Missing => {
            Failure::new(StatusCode::UNAUTHORIZED, "unauthorized", "this server requires a token".to_owned())
                .hint("give it with --token-file, --token, STRIDE_TOKEN_FILE or STRIDE_TOKEN")
        }
        Unknown::Nobody => {
            Failure::new(StatusCode::UNAUTHORIZED, "unauthorized", "this server does not know the token".to_owned())
                .hint("it is of another server, or was revoked; the server reads its token file again at SIGHUP")
        }
        Unknown::Expired(caller) => {
            let at = caller.expires.as_ref().map(ToString::to_string).unwrap_or_default();
            let message = format!("the token of `{}` has expired: its line says `expires={at}`", caller.name);
            Failure::new(StatusCode::UNAUTHORIZED, "unauthorized", message).hint("ask for another token")
        }
    }
}

/// The refusal of a token without the required scope.
pub(crate) fn forbidden(caller: &Caller, needed: &[Scope]) -> Failure {
    let needed: Vec<&str> = needed.iter().map(|scope| scope.name()).collect();
    let message = format!(
        "the token of `{}` has the scope {}; this call needs {}",
        caller.name,
        caller.scopes,
        needed.join(" or ")
    );
    Failure::new(StatusCode::FORBIDDEN, "forbidden", message)
        .hint("use another token, or add the scope to the server's token file")
}

fn late(time: Duration) -> Failure {
    let message = format!("the call did not finish within {} s", time.as_secs());
    Failure::new(StatusCode::SERVICE_UNAVAILABLE, "busy", message)
        .hint("try again; if this persists, check the server's disk")
}

/// An answer that closes the connection, so that the rest of the request is not read.
fn closing(failure: Failure) -> Response {
    let mut response = failure.into_response();
    response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_must_be_ours_and_addresses_may_be_any() {
        let tokens = Arc::new(TokenTable::new(access::Tokens::default(), Vec::new()));
        let gate = Gate::new(tokens, &["stride.lab".to_owned()], 1);
        for ours in ["127.0.0.1:7700", "localhost", "LOCALHOST:1", "[::1]:7700", "10.0.0.7", "stride.lab:7700"] {
            assert!(gate.is_ours(ours), "{ours}");
        }
        for other in
            ["", "evil.example:7700", "localhost.evil.example", "stride.lab.evil.example", "[", "127.0.0.1.nip.io"]
        {
            assert!(!gate.is_ours(other), "{other}");
        }
    }
}
