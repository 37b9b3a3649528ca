//! What a stage may ask of the world, over HTTP and TCP.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use checkpoint::{BlobError, Blobs};
use protocol::message::{CommitCheckpoint, Progress, StageTask};
use protocol::{ArtifactKind, Digest, Manifest};
use stages::context::{AttemptContext, ContextError, Exchange, GangContext, Rendezvous};

use crate::active_assignment::ActiveAssignment;
use crate::blobs::HttpBlobs;
use crate::cache::Cache;
use crate::client::{CallError, Client};
use crate::failpoints;
use crate::gang::exchange::{self, Contribution, Met};
use crate::gang::mesh::{Halt, Mesh, Phase};
use crate::gang::tree;
use crate::retry::{self, GaveUp};
use crate::telemetry_buffer::{Sender, TelemetryBuffer};

/// One attempt's view of the coordinator and, in a gang, of its peers.
#[derive(Debug)]
pub(crate) struct HttpContext {
    task: StageTask,
    device: Device,
    held: Arc<ActiveAssignment>,
    client: Client,
    blobs: Arc<HttpBlobs>,
    telemetry: Arc<TelemetryBuffer>,
    mesh: Option<Arc<Mesh>>,
    gang: bool,
    _sender: Sender,
}

impl HttpContext {
    pub(crate) fn new(held: Arc<ActiveAssignment>, client: Client, cache: Arc<Cache>, device: Device) -> Self {
        let assignment = held.assignment();
        let gang = matches!(assignment.role, protocol::message::Role::Member { .. });
        let blobs = Arc::new(HttpBlobs { held: held.clone(), client: client.clone(), cache, gang });
        let (telemetry, sender) = TelemetryBuffer::open(held.clone(), client.clone());
        Self { task: assignment.stage, device, held, client, blobs, telemetry, mesh: None, gang, _sender: sender }
    }

    /// Waits until everything recorded and logged is stored.
    pub(crate) fn flush(&self) -> Result<(), ContextError> {
        self.telemetry.flush().map_err(given_up)
    }

    /// Lets the peers go, saying goodbye: to the next generation, or for good.
    fn part(&mut self) {
        if let Some(mesh) = self.mesh.take() {
            let next = match &self.held.assignment().role {
                protocol::message::Role::Member { generation, .. } if *generation > mesh.config.generation => {
                    Some(*generation)
                }
                _ => None,
            };
            mesh.close(next);
        }
    }

    /// After a peer is gone: waits for the coordinator's next generation.
    fn await_regroup(&mut self, mesh: &Mesh) -> Result<(), ContextError> {
        let begun = Instant::now();
        let mut warned = begun;
        loop {
            let ticket = self.held.event_count().ticket();
            match self.held.halt(mesh.config.generation) {
                Some(Halt::Ended(reason)) => {
                    self.part();
                    return Err(ContextError::GrantEnded(reason));
                }
                Some(_) => {
                    self.part();
                    return Ok(());
                }
                None => {}
            }
            if warned.elapsed() > Duration::from_secs(20) {
                let lost = mesh.missing();
                tracing::warn!(
                    task = %mesh.config.task,
                    "waiting for a generation after {} for {:.0} s; missing: {}",
                    mesh.config.generation,
                    begun.elapsed().as_secs_f64(),
                    if lost.is_empty() { "nobody".to_owned() } else { lost.join("; ") },
                );
                warned = Instant::now();
            }
            self.held.event_count().wait(ticket, Duration::from_secs(1));
        }
    }

    /// A member that asks for blobs between two steps is about to save.
    fn saves(&self) {
        if self.held.busy().phase() == Phase::Working {
            self.held.busy().set(Phase::Saving);
        }
    }

    fn check(&self) -> Result<(), ContextError> {
        self.held.ended().map_or(Ok(()), |reason| Err(ContextError::GrantEnded(reason)))
    }
}

impl Drop for HttpContext {
    fn drop(&mut self) {
        self.part();
    }
}

impl AttemptContext for HttpContext {
    fn task(&self) -> &StageTask {
        &self.task
    }

    fn device(&self) -> Device {
        self.device.clone()
    }

    fn blobs(&self) -> Arc<dyn Blobs> {
        self.saves();
        self.blobs.clone()
    }

    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        let bytes = self.blobs.get(digest).map_err(blob_error)?;
        let manifest: Manifest = serde_json::from_slice(&bytes)
            .map_err(|e| ContextError::Corrupt(format!("{digest} is not a manifest: {e}")))?;
        if manifest.format != Manifest::FORMAT {
            let (found, known) = (manifest.format, Manifest::FORMAT);
            return Err(ContextError::Corrupt(format!(
                "manifest {digest} has format {found}, this build reads {known}"
            )));
        }
        Ok(manifest)
    }

    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError> {
        self.blobs.put(manifest.to_bytes()).map_err(blob_error)
    }

    fn progress(&mut self, done: u64, total: u64, unit: &str, metrics: &[(&str, f64)]) {
        let metrics = metrics.iter().filter(|(_, v)| v.is_finite()).map(|(k, v)| ((*k).to_owned(), *v)).collect();
        self.held.set_progress(Progress { done, total, unit: unit.to_owned(), metrics });
    }

    fn record(&mut self, step: u64, metrics: &[(&str, f64)]) {
        self.telemetry.record(step, metrics);
    }

    fn log(&mut self, line: &str) {
        tracing::info!(target: "stage", task = %self.held.grant().task, "{line}");
        self.telemetry.log(line);
    }

    /// In a gang a wish to stop is not said here: all members must hear it after the same step, from an exchange.
    fn interrupted(&self) -> bool {
        self.held.ended().is_some() || (!self.gang && self.held.drain())
    }
}

impl GangContext for HttpContext {
    fn latest_checkpoint(&self) -> Result<Option<Manifest>, ContextError> {
        let Some(digest) = self.held.checkpoint() else { return Ok(None) };
        let manifest = self.manifest(digest)?;
        if manifest.kind != ArtifactKind::Checkpoint {
            return Err(ContextError::Corrupt(format!("{digest} is a {:?}, expected a checkpoint", manifest.kind)));
        }
        Ok(Some(manifest))
    }

    fn rendezvous(&mut self, applied: Option<u64>, state: &[&[u8]]) -> Result<Rendezvous, ContextError> {
        self.held.busy().set(Phase::Working);
        loop {
            self.check()?;
            if let Some(newer) = self.held.take_mesh() {
                self.part();
                self.mesh = Some(newer);
            }
            let Some(mesh) = self.mesh.clone() else {
                return Err(ContextError::Unavailable("a rendezvous of a stage that is not a gang's".to_owned()));
            };
            let held = self.held.clone();
            let generation = mesh.config.generation;
            // The rows that are not known to be stored travel behind the state, and their length behind them.
            let kept = self.telemetry.kept();
            let length = (kept.len() as u64).to_le_bytes();
            let offered: Vec<&[u8]> = state.iter().copied().chain([&kept[..], &length[..]]).collect();
            match exchange::rendezvous(&mesh, applied, &offered, &|| held.halt(generation)) {
                Ok(mut met) => {
                    if let Met::Adopt { pieces, .. } = &mut met {
                        let rows = split_rows(pieces).ok_or_else(|| malformed("is cut short"))?;
                        self.telemetry.take_over(&rows, applied).map_err(|e| malformed(&e.to_string()))?;
                    }
                    let adopted = match &met {
                        Met::Adopt { pieces, took } => {
                            Some((pieces.iter().map(Vec::len).sum::<usize>(), took.as_secs_f64()))
                        }
                        Met::Keep => None,
                    };
                    tracing::info!(
                        task = %mesh.config.task,
                        %generation,
                        rank = mesh.config.rank,
                        members = mesh.size(),
                        adopts = adopted.is_some(),
                        bytes = adopted.map(|(bytes, _)| bytes),
                        seconds = adopted.map(|(_, seconds)| seconds),
                        "met the gang"
                    );
                    return Ok(match met {
                        Met::Keep => Rendezvous::Keep,
                        Met::Adopt { pieces, .. } => Rendezvous::Adopt(pieces),
                    });
                }
                Err(Halt::Ended(reason)) => {
                    self.part();
                    return Err(ContextError::GrantEnded(reason));
                }
                Err(Halt::Disagree(message)) => return Err(ContextError::Unavailable(message)),
                Err(Halt::Regroup | Halt::Peer) => self.await_regroup(&mesh)?,
            }
        }
    }

    fn share(&self, slices: usize) -> Range<usize> {
        self.mesh.as_ref().map_or(0..0, |mesh| tree::share(slices, mesh.config.rank, mesh.size()))
    }

    fn exchange(&mut self, step: u64, slices: usize, parts: &[(usize, Vec<f32>)]) -> Result<Exchange, ContextError> {
        self.check()?;
        self.held.busy().set(Phase::Working);
        let Some(mesh) = self.mesh.clone() else { return Ok(Exchange::Regroup) };
        let generation = mesh.config.generation;
        if self.held.halt(generation).is_some() {
            self.part();
            return Ok(Exchange::Regroup);
        }
        let share = self.share(slices);
        let mut own = Vec::with_capacity(share.len());
        for slice in share.clone() {
            let part = parts.iter().find(|(at, _)| *at == slice).map(|(_, part)| part.as_slice());
            let part = part.filter(|part| own.first().is_none_or(|(_, first): &(_, &[f32])| first.len() == part.len()));
            let Some(part) = part else {
                return Err(ContextError::Unavailable(format!(
                    "step {step}: slice {slice} of this member's {share:?} is missing or of another length; a fault of the stage"
                )));
            };
            own.push((slice..slice + 1, part));
        }
        let contribution =
            Contribution { step, slices, parts: own, drain: self.held.drain(), durable: self.telemetry.durable() };
        let held = self.held.clone();
        match exchange::exchange(&mesh, &contribution, &|| held.halt(generation)) {
            Ok(total) => {
                self.telemetry.forget(total.durable);
                Ok(Exchange::Sum { sum: total.sum, drain: total.drain })
            }
            Err(Halt::Ended(reason)) => {
                self.part();
                Err(ContextError::GrantEnded(reason))
            }
            Err(Halt::Disagree(message)) => Err(ContextError::Unavailable(message)),
            Err(Halt::Regroup | Halt::Peer) => {
                self.await_regroup(&mesh)?;
                Ok(Exchange::Regroup)
            }
        }
    }

    fn leads(&self) -> bool {
        self.mesh.as_ref().map_or_else(|| self.held.leads(), |mesh| mesh.config.rank == 0)
    }

    fn hold(&mut self) -> Result<(), ContextError> {
        let Some(mesh) = self.mesh.clone() else {
            return Err(ContextError::Unavailable("a stage that is not a gang's holds no state for others".to_owned()));
        };
        // What this member logged is stored before rank 0 ends the attempt for all.
        self.flush()?;
        let held = self.held.clone();
        let generation = mesh.config.generation;
        let barrier = format!("barrier `closing` of generation {generation}");
        match mesh.watch(0, &barrier, &|| held.halt(generation)) {
            Halt::Ended(reason) => {
                self.part();
                Err(ContextError::GrantEnded(reason))
            }
            Halt::Disagree(message) => Err(ContextError::Unavailable(message)),
            Halt::Regroup | Halt::Peer => self.await_regroup(&mesh),
        }
    }

    fn can_save(&self) -> bool {
        !self.held.is_away()
    }

    fn commit_checkpoint(
        &mut self,
        step: u64,
        manifest: &Manifest,
        metrics: &BTreeMap<String, f64>,
    ) -> Result<(), ContextError> {
        self.flush()?;
        // Uploaded by the stage before; storing it again costs one call and makes the commit stand on its own.
        let digest = self.put_manifest(manifest)?;
        let metrics: BTreeMap<String, f64> =
            metrics.iter().filter(|(_, v)| v.is_finite()).map(|(k, v)| (k.clone(), *v)).collect();
        failpoints::hit("checkpoint::before_commit");
        retry::until_ended(&self.held, &format!("committing the checkpoint of step {step}"), |grant| {
            let commit = CommitCheckpoint { grant: grant.clone(), step, manifest: digest, metrics: metrics.clone() };
            self.client.wait(self.client.tell("/v1/checkpoints", &commit))
        })
        .map_err(given_up)?;
        failpoints::hit("checkpoint::after_commit");
        self.held.committed(digest);
        Ok(())
    }
}

/// Takes the kept rows off the end of a state that came from a peer; frames never span two of the pieces that were offered.
fn split_rows(pieces: &mut Vec<Vec<u8>>) -> Option<Vec<u8>> {
    let length = u64::from_le_bytes(pieces.pop()?.try_into().ok()?);
    let (mut chunks, mut there) = (Vec::new(), 0);
    while there < length {
        let chunk = pieces.pop()?;
        there += chunk.len() as u64;
        chunks.push(chunk);
    }
    chunks.reverse();
    (there == length).then(|| chunks.concat())
}

fn malformed(why: &str) -> ContextError {
    ContextError::Unavailable(format!("a peer's list of recorded values {why}; is it the same build?"))
}

fn given_up(gave_up: GaveUp) -> ContextError {
    match gave_up {
        GaveUp::Ended(reason) | GaveUp::Answer(CallError::Stale(reason)) => ContextError::GrantEnded(reason),
        GaveUp::Answer(CallError::Storage(message)) => ContextError::Storage(message),
        GaveUp::Answer(error) => ContextError::Unavailable(error.to_string()),
    }
}

fn blob_error(error: BlobError) -> ContextError {
    match error {
        BlobError::Refused(reason) => ContextError::GrantEnded(reason),
        BlobError::Storage(message) => ContextError::Storage(message),
        BlobError::Unavailable(message) => ContextError::Unavailable(message),
        error @ (BlobError::NotFound(_) | BlobError::Corrupt { .. } | BlobError::Damaged(_)) => {
            ContextError::Corrupt(error.to_string())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_off_the_end_of_a_state_however_they_were_cut() {
        let length = 5u64.to_le_bytes().to_vec();
        let mut pieces = vec![vec![1, 2], vec![3], vec![10, 11, 12], vec![13, 14], length.clone()];
        assert_eq!(split_rows(&mut pieces), Some(vec![10, 11, 12, 13, 14]));
        assert_eq!(pieces, [vec![1, 2], vec![3]], "the state");
        for mut broken in [vec![], vec![vec![1, 2]], vec![vec![1; 3], length.clone()], vec![vec![1; 6], length]] {
            assert_eq!(split_rows(&mut broken), None, "{broken:?}");
        }
    }
}
