//! A response body that is aborted when the caller's token is revoked.

use std::pin::Pin;
use std::task::{Context, Poll};

use axum::body::{Body, Bytes, HttpBody};
use http_body::{Frame, SizeHint};

use super::token_table::Standing;

/// A body that is sent while the caller's token is valid.
#[derive(Debug)]
pub(crate) struct Revocable {
    body: Body,
    standing: Standing,
}

impl Revocable {
    pub(crate) fn new(body: Body, standing: Standing) -> Self {
        Self { body, standing }
    }
}

impl HttpBody for Revocable {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if !self.standing.still_holds() {
            return Poll::Ready(Some(Err(axum::Error::new(std::io::Error::other("the token was revoked")))));
        }
        Pin::new(&mut self.body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
