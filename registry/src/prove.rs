//! Proof that an artifact is whole, so that rows may name it. Only this part of a write sends requests to the blobs'
//! backend, and no other work waits for it.

use std::time::Duration;

use futures::{StreamExt as _, TryStreamExt as _, stream};
use protocol::Digest;

use crate::blob::{ManifestError, listed};
use crate::catalog::{Done, Order};
use crate::proofs::{Artifact, Proof};
use crate::{Store, Write, WriteError};

/// Number of concurrent requests for one artifact.
const AT_ONCE: usize = 16;
/// Delay before another proof after a collection has interfered.
const AGAIN: Duration = Duration::from_millis(10);

impl Store {
    /// Proves that an artifact and all listed blobs are stored. Requests only blobs that neither this process nor the
    /// catalog knows.
    pub async fn prove(&self, artifact: Digest) -> Result<Proof, WriteError> {
        let begun = self.proofs().begin();
        let (manifest, own) =
            self.ask_blobs(move |blobs| blobs.stored_manifest(artifact)).await.map_err(|e| unproven(&e))?;
        let found = Artifact::of(artifact, own, &manifest);
        let mut unknown: Vec<_> = listed(&manifest).collect();
        unknown.retain(|part| self.blobs().just_stored(part.blob.digest) != Some(part.blob.bytes));
        if !unknown.is_empty() {
            let listed: Vec<Digest> = unknown.iter().map(|part| part.blob.digest).collect();
            let present = self.present(&listed).await?;
            unknown.retain(|part| present.get(&part.blob.digest) != Some(&part.blob.bytes));
        }
        stream::iter(unknown)
            .map(|part| self.ask_blobs(move |blobs| blobs.check_listed(artifact, &part)))
            .buffer_unordered(AT_ONCE)
            .try_collect::<()>()
            .await
            .map_err(|e| unproven(&e))?;
        Ok(begun.found(artifact, found))
    }

    /// Commits `writes` in one transaction and returns when they are durable, or stores none. Proves the named
    /// artifacts first.
    pub async fn write(&self, writes: Vec<Write>) -> Result<(), WriteError> {
        let named: Vec<Digest> = writes.iter().flat_map(Write::artifacts).collect();
        if named.is_empty() {
            return self.write_proven(writes).await;
        }
        self.order_proven(&named, || Order::Write(writes.clone())).await.map(|_| ())
    }

    /// Commits writes whose artifacts all have a [`Proof`], without a request to the blobs' backend.
    pub async fn write_proven(&self, writes: Vec<Write>) -> Result<(), WriteError> {
        self.order(Order::Write(writes)).await.map(|_| ())
    }

    /// Commits an order that names artifacts. Proves them again while collections interfere.
    pub(crate) async fn order_proven(&self, named: &[Digest], order: impl Fn() -> Order) -> Result<Done, WriteError> {
        loop {
            let proofs = stream::iter(named.to_vec()).then(|artifact| self.prove(artifact));
            let proofs: Vec<Proof> = proofs.try_collect().await?;
            let done = self.order(order()).await;
            drop(proofs);
            if !matches!(done, Err(WriteError::Unproven { .. })) {
                return done;
            }
            // Waits for the interfering removal to end.
            tokio::time::sleep(AGAIN).await;
        }
    }

    /// Forgets that a missing or damaged blob was stored, so that the next row that names it checks again.
    pub async fn doubt(&self, flaw: &ManifestError) -> Result<(), WriteError> {
        let Some(blob) = flaw.blob() else { return Ok(()) };
        let done = self.order(Order::Condemn(vec![blob])).await;
        self.proofs().removed(&[blob]);
        done.map(|_| ())
    }
}

fn unproven(e: &ManifestError) -> WriteError {
    use checkpoint::BlobError;
    match e {
        ManifestError::Blob(BlobError::NotFound(digest)) => WriteError::NotFound(format!(
            "blob {digest} is not in the store; upload a manifest and all listed blobs before naming it"
        )),
        ManifestError::Blob(BlobError::Storage(message)) => WriteError::Storage(message.clone()),
        ManifestError::Blob(BlobError::Unreachable(message)) => WriteError::Unreachable(message.clone()),
        ManifestError::Blob(e) => WriteError::Internal(e.to_string()),
        ManifestError::Incomplete { .. } => {
            WriteError::NotFound(format!("{e}; upload every blob before the manifest is named"))
        }
        ManifestError::NotAManifest { .. } | ManifestError::Format { .. } => WriteError::Conflict(e.to_string()),
    }
}
