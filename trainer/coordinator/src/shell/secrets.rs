//! Secrets of grants and receipts of uploads, which the server recognises without storing them.
//!
//! Each is `HMAC-SHA256(server key, subject)`, so it stays valid after a restart. Both include the name of the worker's
//! caller and are invalid with another token. Comparisons take constant time.

use std::fmt;
use std::sync::Arc;

use access::Caller;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode};
use hmac::{Hmac, Mac};
use protocol::message::Grant;
use protocol::proof::{GRANT_HEADER, PROCESS_HEADER, Process, SECRET_HEADER, SHORTEST_SECRET};
use protocol::{Digest, WorkerId};
use registry::ServerKey;
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::Sha256;

use super::failure::Failure;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::worker::Identity;

/// Creates and checks secrets and receipts.
pub(crate) struct Secrets {
    key: ServerKey,
}

impl fmt::Debug for Secrets {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secrets(..)")
    }
}

impl Secrets {
    pub(crate) fn new(key: ServerKey) -> Self {
        Self { key }
    }

    fn mac(&self, what: &impl Serialize) -> Hmac<Sha256> {
        let mut mac = Hmac::<Sha256>::new_from_slice(&self.key).expect("every length of key is taken");
        mac.update(&serde_json::to_vec(what).expect("names and numbers serialise"));
        mac
    }

    /// The secret that every write under `grant` must show.
    pub(crate) fn of_grant(&self, caller: &str, grant: &Grant) -> String {
        text(self.mac(&("grant", caller, grant)))
    }

    /// The proof that the process of `grant` uploaded a blob for its task.
    pub(crate) fn receipt(&self, caller: &str, grant: &Grant, digest: Digest) -> String {
        text(self.mac(&upload(caller, grant, digest)))
    }

    /// Returns true if `shown` is the receipt of this upload.
    pub(crate) fn is_receipt(&self, caller: &str, grant: &Grant, digest: Digest, shown: &str) -> bool {
        is(self.mac(&upload(caller, grant, digest)), shown)
    }

    /// MAC of a session: its token (`None` for this store's user), expiry and nonce.
    pub(crate) fn of_session(&self, token: Option<Digest>, until_ms: u64, nonce: &str) -> String {
        text(self.mac(&("session", token, until_ms, nonce)))
    }

    /// Returns true if `shown` is that proof.
    pub(crate) fn is_session(&self, token: Option<Digest>, until_ms: u64, nonce: &str, shown: &str) -> bool {
        is(self.mac(&("session", token, until_ms, nonce)), shown)
    }

    /// Proof that a page of `origin` may enter a stream once, until a time, under a name of its own.
    pub(crate) fn of_ticket(&self, origin: &str, until_ms: u64, nonce: &str) -> String {
        text(self.mac(&("ticket", origin, until_ms, nonce)))
    }

    /// Returns true if `shown` is that proof.
    pub(crate) fn is_ticket(&self, origin: &str, until_ms: u64, nonce: &str, shown: &str) -> bool {
        is(self.mac(&("ticket", origin, until_ms, nonce)), shown)
    }
}

fn upload<'a>(caller: &'a str, grant: &'a Grant, digest: Digest) -> impl Serialize + use<'a> {
    // The fence is left out: a regrouped gang continues to use uploads of its lead.
    ("upload", caller, &grant.task, &grant.worker, grant.incarnation, digest)
}

fn text(mac: Hmac<Sha256>) -> String {
    Digest::from_bytes(mac.finalize().into_bytes().into()).hex()
}

fn is(mac: Hmac<Sha256>, shown: &str) -> bool {
    let shown: Result<Digest, _> = format!("sha256:{shown}").parse();
    shown.is_ok_and(|shown| mac.verify_slice(shown.as_bytes()).is_ok())
}

/// The identity of a call: its token's caller, and its secret.
#[derive(Debug)]
pub(crate) struct Proof {
    pub(crate) caller: Arc<Caller>,
    secret: Secret,
}

struct Secret(String);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(..)")
    }
}

impl<S: Sync> FromRequestParts<S> for Proof {
    type Rejection = Failure;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Failure> {
        let Some(caller) = parts.extensions.get::<Arc<Caller>>().cloned() else {
            let message = "a route without a gate".to_owned();
            return Err(Failure::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message));
        };
        let secret = parts.headers.get(SECRET_HEADER).and_then(|value| value.to_str().ok()).unwrap_or_default();
        Ok(Self { caller, secret: Secret(secret.to_owned()) })
    }
}

impl Proof {
    /// Checks that the call shows the secret of `grant`. It checks nothing else and so reveals nothing about the task.
    pub(crate) fn of_grant(&self, secrets: &Secrets, grant: &Grant) -> Result<(), Failure> {
        if is(secrets.mac(&("grant", &self.caller.name, grant)), &self.secret.0) {
            return Ok(());
        }
        Err(unproven("the call does not show the secret of its grant"))
    }

    /// Checks that the call comes from the given process, and that this process is the newest of its name.
    pub(crate) fn of_process(&self, state: &State, process: &Process) -> Result<(), Failure> {
        let strange = || unproven("the call does not show the secret of its worker");
        let known = state.workers.get(&process.worker);
        let known =
            known.ok_or_else(|| Rejected::NotFound(format!("worker `{}` is not known; join first", process.worker)))?;
        let identity = known.identity.as_ref().filter(|own| own.caller == self.caller.name).ok_or_else(strange)?;
        // Checked before the secret, so that a replaced process gets this error and ends.
        state.process(&process.worker, process.incarnation)?;
        // Comparing digests reveals nothing about the secret by its duration.
        if identity.secret == Digest::of(self.secret.0.as_bytes()) { Ok(()) } else { Err(strange()) }
    }

    /// The identity of a joining process.
    pub(crate) fn of_join(&self, worker: &WorkerId) -> Result<Identity, Failure> {
        if let Some(names) = self.caller.worker_names().filter(|names| !names.allow(worker.as_str())) {
            let message = format!("the token of `{}` may name its workers `{names}`, not `{worker}`", self.caller.name);
            return Err(Failure::new(StatusCode::FORBIDDEN, "forbidden", message)
                .hint("choose another name with `--name`, or change `workers=` in the server's token file"));
        }
        if self.secret.0.len() < SHORTEST_SECRET {
            let message =
                format!("header `{SECRET_HEADER}`: expected a secret of {SHORTEST_SECRET} characters or more");
            return Err(Failure::invalid(message));
        }
        Ok(Identity { caller: self.caller.name.clone(), secret: Digest::of(self.secret.0.as_bytes()) })
    }
}

/// The refusal of a call without the required proof.
pub(crate) fn unproven(message: &str) -> Failure {
    Failure::new(StatusCode::FORBIDDEN, "unproven", message.to_owned())
        .hint("use the token that the worker joined with, and a worker of the same build")
}

/// The grant of an upload.
pub(crate) fn grant(headers: &HeaderMap) -> Result<Grant, Failure> {
    json(headers, GRANT_HEADER)
}

/// The process that reads a blob.
pub(crate) fn process(headers: &HeaderMap) -> Result<Process, Failure> {
    json(headers, PROCESS_HEADER)
}

fn json<T: DeserializeOwned>(headers: &HeaderMap, name: &str) -> Result<T, Failure> {
    let value = headers.get(name).ok_or_else(|| Failure::invalid(format!("header `{name}` is missing")))?;
    serde_json::from_slice(value.as_bytes()).map_err(|e| Failure::invalid(format!("cannot parse header `{name}`: {e}")))
}
