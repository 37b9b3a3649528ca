//! Who is let in: every call shows a token, and the token's scopes say what it may do.
//!
//! A browser on this machine can be made to send calls to us: by a page of anywhere, or by a name that is rebound to our
//! address. Neither has a token; they are refused all the same before anything is looked at, by `Host` and `Origin`.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use access::{Caller, Scope};
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use protocol::limits;
use tokio::sync::Semaphore;

use super::audit::{Admitted, Audit};
use super::failure::Failure;
use super::listener::Peer;
use super::paced::Paced;
use super::rate::Rates;
use super::revocable::Revocable;
use super::route::Route;
use super::token_table::{Standing, TokenTable, Unknown};

/// What the door knows.
#[derive(Debug)]
pub(crate) struct Gate {
    pub(crate) tokens: Arc<TokenTable>,
    /// Calls to be logged.
    pub(crate) audit: Arc<Audit>,
    /// Names by which this server may be asked; addresses always may.
    hosts: Vec<String>,
    /// Kibibytes of calls that may be in memory.
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
        Self { tokens, audit: Arc::default(), hosts: names, bodies, rates: Rates::new(calls) }
    }

    /// The caller whose token the headers bear, and its right to be answered.
    fn caller(&self, headers: &HeaderMap) -> Result<(Arc<Caller>, Standing), Unknown> {
        let token = bearer(headers).ok_or(Unknown::Nobody)?;
        let caller = self.tokens.find(token)?;
        Ok((Arc::clone(&caller), Standing::new(Arc::clone(&self.tokens), token, caller)))
    }

    /// Refuses more calls a second than a token may make that is no worker's. Workers are bounded by what they wait for.
    fn is_too_fast(&self, caller: &Caller) -> Option<Failure> {
        if caller.scopes.allow(Scope::Worker) {
            return None;
        }
        self.rates.take(&caller.name, Instant::now()).err()?;
        let message = format!("the token of `{}` makes more calls a second than it may", caller.name);
        Some(Failure::busy(message).hint("call less often; a server takes more with `--max-calls-per-second`"))
    }

    /// Why a call is none that a client of ours would send.
    fn refuses(&self, headers: &HeaderMap) -> Option<Failure> {
        let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str().unwrap_or("?"));
        let host = text(header::HOST).unwrap_or_default();
        if !self.is_ours(host) {
            let message = format!("this server is not called `{host}`");
            let failure = Failure::new(StatusCode::MISDIRECTED_REQUEST, "host", message);
            return Some(failure.hint("ask it by its address, or start it with `--host NAME` for each name it has"));
        }
        let origin = text(header::ORIGIN)?;
        let authority = origin.split_once("://").filter(|(scheme, _)| matches!(*scheme, "http" | "https"));
        if authority.is_some_and(|(_, authority)| authority.eq_ignore_ascii_case(host)) {
            return None;
        }
        let message = format!("a page of `{origin}` may not call this server");
        Some(Failure::new(StatusCode::FORBIDDEN, "origin", message))
    }

    /// An address cannot be rebound, so any will do; a name must be one of ours.
    fn is_ours(&self, authority: &str) -> bool {
        let host = match authority.strip_prefix('[') {
            Some(v6) => v6.split_once(']').map_or("", |(host, _)| host),
            None => authority.split_once(':').map_or(authority, |(host, _)| host),
        };
        host.parse::<IpAddr>().is_ok() || self.hosts.iter().any(|name| name.eq_ignore_ascii_case(host))
    }
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, token) = headers.get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then_some(token)
}

/// Refuses what a browser was made to send.
pub(crate) async fn check_host(State(gate): State<Arc<Gate>>, request: Request, next: Next) -> Response {
    match gate.refuses(request.headers()) {
        Some(failure) => closing(failure),
        None => next.run(request).await,
    }
}

/// Lets a request pass to `route` if it bears a token with one of the route's scopes. Nothing of its body is read before.
pub(crate) async fn admit(State((gate, route)): State<(Arc<Gate>, Route)>, request: Request, next: Next) -> Response {
    let admitted = gate.caller(request.headers());
    let caller = admitted.as_ref().ok().map(|(caller, _)| Arc::clone(caller));
    let mut response = match admitted {
        Ok((caller, standing)) => admitted_call(&gate, route, caller, standing, request, next).await,
        Err(unknown) => closing(unauthorized(&unknown)),
    };
    response.extensions_mut().insert(Admitted { caller, route });
    response
}

async fn admitted_call(
    gate: &Arc<Gate>,
    route: Route,
    caller: Arc<Caller>,
    standing: Standing,
    mut request: Request,
    next: Next,
) -> Response {
    if let Some(peer) = request.extensions().get::<Arc<Peer>>()
        && let Err(failure) = peer.is_known(&caller)
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
        Unknown::Nobody => {
            Failure::new(StatusCode::UNAUTHORIZED, "unauthorized", "this server wants a token".to_owned())
                .hint("give it with --token-file, --token, STRIDE_TOKEN_FILE or STRIDE_TOKEN")
        }
        Unknown::Expired(caller) => {
            let at = caller.expires.as_ref().map(ToString::to_string).unwrap_or_default();
            let message = format!("the token of `{}` has expired: its line says `expires={at}`", caller.name);
            Failure::new(StatusCode::UNAUTHORIZED, "unauthorized", message).hint("ask for another token")
        }
    }
}

/// The caller's token does not have the scope that is needed.
pub(crate) fn forbidden(caller: &Caller, needed: &[Scope]) -> Failure {
    let needed: Vec<&str> = needed.iter().map(|scope| scope.name()).collect();
    let message =
        format!("the token of `{}` may {}; this call needs {}", caller.name, caller.scopes, needed.join(" or "));
    Failure::new(StatusCode::FORBIDDEN, "forbidden", message)
        .hint("use another token, or add the scope to the server's token file")
}

fn late(time: Duration) -> Failure {
    let message = format!("the call was not done within {} s", time.as_secs());
    Failure::new(StatusCode::SERVICE_UNAVAILABLE, "busy", message)
        .hint("try again; if it stays so, look at the server's disk")
}

/// An answer after which the connection ends: what the caller may still be sending is not read.
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
