//! Messages to addresses that the operator lists: a run failed, finished or makes no progress, a model was promoted.
//!
//! A message is an HTTP `POST` after [Standard Webhooks](https://www.standardwebhooks.com): the headers `webhook-id`,
//! `webhook-timestamp` and `webhook-signature` sign the body with the hook's secret. A receiver that has seen an id
//! before ignores the message. The field `text` says everything in a sentence, which chat servers show.

mod file;
mod message;
mod post;

pub use file::{Hook, Hooks};
pub use message::{Message, Topic};
pub use post::{Client, Undelivered};
