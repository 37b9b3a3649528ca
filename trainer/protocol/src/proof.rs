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
use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Digest, Incarnation, WorkerId};

/// Header with the secret that a worker's call shows.
pub const SECRET_HEADER: &str = "x-stride-secret";
/// Header with an upload's grant, as JSON.
pub const GRANT_HEADER: &str = "x-stride-grant";
/// Header with the receipt of an earlier upload of the same blob.
pub const RECEIPT_HEADER: &str = "x-stride-receipt";
/// Header of a caller that follows a redirect to the place of the blobs. Its value is ignored.
pub const DIRECT_HEADER: &str = "x-stride-direct";
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

/// A request to the place of the blobs, signed by the server. It needs no credentials until its signature expires.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct SignedRequest {
    /// Address with the signature.
    pub url: String,
    /// Headers that are part of the signature and must be sent as they are.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub headers: BTreeMap<String, String>,
}

/// Without the signature.
impl fmt::Debug for SignedRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let place = self.url.split('?').next().unwrap_or_default();
        f.debug_struct("SignedRequest").field("place", &place).finish_non_exhaustive()
    }
}

/// Answer to `PUT /v1/blobs/{digest}`, `GET /v1/blobs/{digest}/staged` and `POST /v1/blobs/{digest}/sent`.
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
    /// A request that stores the whole blob. Only if the caller asks by [`DIRECT_HEADER`] and no byte has arrived.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub direct: Option<SignedRequest>,
}
