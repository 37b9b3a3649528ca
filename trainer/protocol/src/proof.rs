//! Proof of the owner of a worker's call, and of the uploader of a manifest's blobs.
//!
//! Names and grants can be guessed. So a call shows a secret in the header [`SECRET_HEADER`]:
//!
//! | call | shows |
//! |---|---|
//! | join, poll, `gone`, reading a blob | the secret that the process drew when it started |
//! | metrics, logs, checkpoint, outcome, upload | the secret that came with the grant ([`Assignment::secret`](crate::message::Assignment::secret)) |
//!
//! Both are bound to the token that joined. A call that shows another secret, or none, is answered with 403 and code `unproven`,
//! whether or not its task exists. For each blob that a worker uploads it gets a receipt, bound to token, task and process; a
//! manifest may name blobs with receipts and blobs of the task's inputs. The server stores neither secrets nor receipts: it
//! computes them again from a key of its own.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Digest, Incarnation, WorkerId};

/// Header with the secret that a worker's call shows.
pub const SECRET_HEADER: &str = "x-stride-secret";
/// Header with an upload's grant, as JSON.
pub const GRANT_HEADER: &str = "x-stride-grant";
/// Header with the receipt of an earlier upload of the same blob.
pub const RECEIPT_HEADER: &str = "x-stride-receipt";
/// Header with the [`Process`] that reads a blob, as JSON.
pub const PROCESS_HEADER: &str = "x-stride-process";

/// Least number of characters of a process's secret.
pub const SHORTEST_SECRET: usize = 32;

/// A worker process, by name and incarnation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Process {
    pub worker: WorkerId,
    pub incarnation: Incarnation,
}

/// Body of `POST /v1/checkpoints` and `POST /v1/outcomes`: a message that may name a manifest, and receipts of its blobs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Vouched<T> {
    #[serde(flatten)]
    pub what: T,
    /// Receipts ([`BlobStored::receipt`]) by blob. Blobs of inputs need none.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub receipts: BTreeMap<Digest, String>,
}

/// Answer to `PUT /v1/blobs/{digest}` and `GET /v1/blobs/{digest}/staged`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct BlobStored {
    /// Name of the blob.
    pub digest: Digest,
    /// True if all of it has arrived and is stored.
    pub stored: bool,
    /// Bytes that have arrived, if it is not.
    pub staged: u64,
    /// Proves that this process uploaded the blob for this task. `None` until it is stored, and for a blob of the task's inputs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub receipt: Option<String>,
}
