//! Failed calls and blobs as errors of a stage's context.

use checkpoint::BlobError;
use stages::context::ContextError;

use crate::client::CallError;
use crate::retry::GaveUp;

pub(crate) fn given_up(gave_up: GaveUp) -> ContextError {
    match gave_up {
        GaveUp::Ended(reason) | GaveUp::Answer(CallError::Stale(reason)) => ContextError::GrantEnded(reason),
        GaveUp::Answer(CallError::Storage(message)) => ContextError::Storage(message),
        GaveUp::Answer(CallError::NoLongerLeads(message)) => ContextError::NoLongerLeads(message),
        GaveUp::Answer(CallError::Refused(message) | CallError::Unauthorized(message)) => {
            ContextError::Refused(message)
        }
        GaveUp::Answer(error) => ContextError::Unavailable(error.to_string()),
    }
}

pub(crate) fn blob_error(error: BlobError) -> ContextError {
    match error {
        BlobError::Refused(reason) => ContextError::GrantEnded(reason),
        BlobError::Unfit(message) => ContextError::Refused(message),
        BlobError::Storage(message) => ContextError::Storage(message),
        BlobError::Unreachable(message) | BlobError::Unavailable(message) => ContextError::Unavailable(message),
        error @ (BlobError::NotFound(_) | BlobError::Corrupt { .. } | BlobError::Damaged(_)) => {
            ContextError::Damaged(error.to_string())
        }
    }
}
