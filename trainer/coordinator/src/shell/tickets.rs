//! One-time tickets by which a browser enters a stream of another process (decision 0012).
//!
//! A script of a page can send no token with a WebSocket, and may not have one. So the server of the page, which knows a token of the
//! streaming process, makes a ticket for its signed-in user: `UNTIL.NONCE.PROOF`, bound to the page's origin. The proof's key is the
//! digest of that token, which both processes have; nothing else passes between them. A script puts the ticket into
//! the list of subprotocols, the only header that it may choose.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use access::{Token, Tokens};
use axum::http::{HeaderMap, Uri, header};
use protocol::Digest;
use registry::ServerKey;
use schemars::JsonSchema;
use serde::Serialize;

use super::clock::wall_clock;
use super::secrets::Secrets;
use super::sessions::remember;

/// The subprotocol of streams.
pub const STREAM_PROTOCOL: &str = "stride-stream";
/// Prefix of the subprotocol that is a ticket.
const TICKET: &str = "stride-ticket.";
/// Lifetime of a ticket, which also bounds how far the two clocks may differ.
const LASTS_MS: u64 = 60_000;

/// A stream that a page offers to those who may submit.
#[derive(Debug, Clone)]
pub struct StreamOffer {
    origin: String,
    token: Token,
}

impl StreamOffer {
    /// A stream at `url`, such as `wss://gpu1:7800`, whose process knows `token`.
    ///
    /// # Errors
    /// The text is no address of a WebSocket, or has a path.
    pub fn new(url: &str, token: Token) -> Result<Self, String> {
        let wrong =
            || format!("`{url}` is not the address of a stream; expected `ws://HOST:PORT` or `wss://HOST:PORT`");
        let uri: Uri = url.parse().map_err(|_| wrong())?;
        let (Some(scheme @ ("ws" | "wss")), Some(authority)) = (uri.scheme_str(), uri.authority()) else {
            return Err(wrong());
        };
        let is_plain = authority.as_str().chars().all(|c| c.is_ascii_alphanumeric() || ".:-[]".contains(c));
        if !is_plain || !matches!(uri.path(), "" | "/") {
            return Err(wrong());
        }
        Ok(Self { origin: format!("{scheme}://{authority}"), token })
    }

    /// The scheme, host and port, which the content policy of the page allows.
    pub(crate) fn origin(&self) -> &str {
        &self.origin
    }

    /// Makes a ticket for a page of `origin`.
    pub(crate) fn ticket(&self, origin: &str) -> Ticket {
        let until_ms = wall_clock().0.saturating_add(LASTS_MS);
        let nonce = Token::random().secret()[..32].to_owned();
        let proof = secrets(self.token.digest()).of_ticket(origin, until_ms, &nonce);
        let ticket = format!("{TICKET}{until_ms}.{nonce}.{proof}");
        let url = format!("{}/v1/stream", self.origin);
        Ticket { url, protocols: [STREAM_PROTOCOL.to_owned(), ticket], until_ms }
    }
}

/// A ticket, with all that a browser needs to use it.
#[derive(Debug, Serialize, JsonSchema)]
pub(crate) struct Ticket {
    /// The address of the WebSocket.
    url: String,
    /// The subprotocols to ask for; the second one is the ticket.
    protocols: [String; 2],
    /// Until when it is good, in milliseconds since 1970.
    until_ms: u64,
}

fn secrets(token: Digest) -> Secrets {
    let key: ServerKey = *token.as_bytes();
    Secrets::new(key)
}

/// Recognises tickets that others made, each once.
#[derive(Debug, Default)]
pub(crate) struct Tickets {
    used: Mutex<HashMap<String, u64>>,
}

/// A ticket as it was shown, and the token whose holder made it.
struct Shown {
    token: Digest,
    nonce: String,
    until_ms: u64,
}

impl Tickets {
    /// Returns true if a page of another origin shows a ticket for that origin.
    pub(crate) fn vouches(&self, headers: &HeaderMap, tokens: &Tokens) -> bool {
        self.look(headers, tokens).is_some()
    }

    /// Returns the token of a ticket's maker, once for each ticket.
    pub(crate) fn redeem(&self, headers: &HeaderMap, tokens: &Tokens) -> Option<Digest> {
        let Shown { token, nonce, until_ms } = self.look(headers, tokens)?;
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        if used.contains_key(&nonce) {
            return None;
        }
        remember(&mut used, nonce, until_ms);
        Some(token)
    }

    fn look(&self, headers: &HeaderMap, tokens: &Tokens) -> Option<Shown> {
        let origin = headers.get(header::ORIGIN)?.to_str().ok()?;
        let asked = headers.get(header::SEC_WEBSOCKET_PROTOCOL)?.to_str().ok()?;
        let ticket = asked.split(',').find_map(|word| word.trim().strip_prefix(TICKET))?;
        let mut words = ticket.split('.');
        let (Some(until), Some(nonce), Some(proof), None) = (words.next(), words.next(), words.next(), words.next())
        else {
            return None;
        };
        let until_ms = until.parse().ok()?;
        let now_ms = wall_clock().0;
        // A clock far ahead would make tickets that are good for long.
        if now_ms >= until_ms || until_ms > now_ms.saturating_add(2 * LASTS_MS) {
            return None;
        }
        let token = tokens.digests().find(|token| secrets(*token).is_ticket(origin, until_ms, nonce, proof))?;
        Some(Shown { token, nonce: nonce.to_owned(), until_ms })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn only_the_address_of_a_stream_gets_into_the_content_policy() {
        let token = || Token::random();
        for good in ["ws://127.0.0.1:7800", "wss://gpu1.lab:7800/", "ws://[::1]:7800"] {
            assert_eq!(StreamOffer::new(good, token()).unwrap().origin(), good.trim_end_matches('/'));
        }
        for wrong in [
            "",
            "http://gpu1",
            "ws://a;script-src *",
            "ws://a b",
            "ws://me@a",
            "ws://a/v1/stream",
            "ws://a'self'",
            "gpu1:7800",
        ] {
            assert!(StreamOffer::new(wrong, token()).is_err(), "{wrong}");
        }
    }
}
