//! Transfers between a worker and the place of the blobs itself, by requests that the coordinator has signed.
//!
//! A worker may have no way to the place: another network, another certificate, a proxy. So a failure is never final. The
//! transfer continues through the coordinator, and signed requests pause.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use access::{explain, tls};
use bytes::Bytes;
use futures::stream;
use protocol::proof::SignedRequest;
use reqwest::{Body, Client, Response, StatusCode};
use tokio::sync::mpsc;

use crate::event_count::lock;

/// Pause of signed requests after the first failure. It doubles with each further one, up to [`LONGEST`].
const PAUSE: Duration = Duration::from_secs(5);
const LONGEST: Duration = Duration::from_secs(300);
/// Time limit of a connection attempt.
const CONNECT: Duration = Duration::from_secs(5);
/// Longest time without progress.
const SILENCE: Duration = Duration::from_secs(60);
/// Longest time until a complete blob is hashed and answered.
const ANSWER: Duration = Duration::from_secs(120);

/// The client of signed requests.
#[derive(Debug, Default)]
pub(crate) struct Direct {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    http: Option<Client>,
    paused_until: Option<Instant>,
    /// Failures since the last success.
    failures: u32,
}

impl Direct {
    /// Returns true unless signed requests pause.
    pub(crate) fn is_used(&self) -> bool {
        lock(&self.state).paused_until.is_none_or(|until| until <= Instant::now())
    }

    fn http(&self) -> Result<Client, String> {
        let mut state = lock(&self.state);
        if let Some(http) = &state.http {
            return Ok(http.clone());
        }
        tls::install_provider();
        let http = Client::builder()
            .connect_timeout(CONNECT)
            // The signature is for this address alone.
            .redirect(reqwest::redirect::Policy::none())
            .build()
            .map_err(|error| explain(&error))?;
        Ok(state.http.insert(http).clone())
    }

    /// Pauses signed requests and returns the reason without the signature.
    fn pause(&self, why: String) -> String {
        let mut state = lock(&self.state);
        let pause = PAUSE.saturating_mul(1 << state.failures.min(6)).min(LONGEST);
        state.failures += 1;
        state.paused_until = Some(Instant::now() + pause);
        let message = format!("the place of the blobs cannot be used directly: {why}");
        tracing::warn!("{message}; blobs pass through the server for {} s", pause.as_secs());
        message
    }

    fn succeeded(&self) {
        let mut state = lock(&self.state);
        if std::mem::take(&mut state.failures) > 0 {
            state.paused_until = None;
        }
    }

    /// The next bytes of an answer; `None` after the last.
    pub(crate) async fn next(&self, response: &mut Response) -> Result<Option<Bytes>, String> {
        let next = tokio::time::timeout(SILENCE, response.chunk()).await;
        next.map_err(|_| self.pause(silent()))?.map_err(|error| self.failed(error))
    }

    /// Pauses signed requests after an error and describes it.
    fn failed(&self, error: reqwest::Error) -> String {
        self.pause(explain(&error.without_url()))
    }

    /// Reads an object from byte `offset` on.
    pub(crate) async fn get(&self, url: &str, offset: u64) -> Result<Response, String> {
        let mut request = self.http()?.get(url);
        if offset > 0 {
            request = request.header("range", format!("bytes={offset}-"));
        }
        let sent = tokio::time::timeout(SILENCE, request.send()).await;
        let response = sent.map_err(|_| self.pause(silent()))?.map_err(|error| self.failed(error))?;
        let expected = if offset > 0 { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK };
        if response.status() != expected {
            return Err(self.pause(format!("it answered {} to a read", response.status())));
        }
        self.succeeded();
        Ok(response)
    }

    /// Sends a blob of `bytes` bytes, whose parts `next` returns until it is empty. An object that exists already was sent
    /// before, and its answer was lost.
    pub(crate) async fn put(
        &self,
        signed: &SignedRequest,
        bytes: u64,
        mut next: impl FnMut() -> Result<Option<Bytes>, String>,
    ) -> Result<(), String> {
        let mut request = self.http()?.put(&signed.url).header("content-length", bytes);
        for (name, value) in &signed.headers {
            request = request.header(name, value);
        }
        let (parts, queue) = mpsc::channel::<Result<Bytes, String>>(1);
        let body = stream::unfold(queue, |mut queue| async { queue.recv().await.map(|part| (part, queue)) });
        let feed = async {
            while let Some(part) = next()? {
                match tokio::time::timeout(SILENCE, parts.send(Ok(part))).await {
                    Ok(Ok(())) => {}
                    // The request has ended; its answer says why.
                    Ok(Err(_)) => break,
                    Err(_) => return Err(self.pause(silent())),
                }
            }
            drop(parts);
            Ok(())
        };
        let answered = async {
            let response = request.body(Body::wrap_stream(body)).send().await.map_err(|error| self.failed(error))?;
            let status = response.status();
            let is_there = matches!(status, StatusCode::PRECONDITION_FAILED | StatusCode::CONFLICT);
            if !status.is_success() && !is_there {
                return Err(self.pause(format!("it answered {status} to a write")));
            }
            self.succeeded();
            Ok(())
        };
        tokio::pin!(answered);
        tokio::select! {
            biased;
            // A refusal may come before all bytes are sent.
            answer = &mut answered => return answer,
            fed = feed => fed?,
        }
        tokio::time::timeout(ANSWER, answered).await.map_err(|_| self.pause(silent()))?
    }
}

fn silent() -> String {
    format!("nothing happened for {} s", SILENCE.as_secs())
}
