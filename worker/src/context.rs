//! Implementation of a stage's context over HTTP and TCP.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use checkpoint::{Blob, Blobs, Joined};
use protocol::message::{Progress, StageTask, TaskOutcome};
use protocol::{ArtifactKind, Digest, Manifest};
use stages::context::{Adopted, AttemptContext, Checkpoint, ContextError, Exchange, GangContext, Rendezvous};
use stages::external::DataAccess;
use stages::tree::{Node, tree_sum};

use crate::active_assignment::ActiveAssignment;
use crate::blobs::HttpBlobs;
use crate::cache::Cache;
use crate::client::Client;
use crate::errors::{blob_error, given_up};
use crate::failpoints;
use crate::gang::exchange::{self, Contribution, Total};
use crate::gang::member::Phase;
use crate::gang::mesh::{Halt, Mesh};
use crate::gang::rendezvous::{self, Line, Met};
use crate::gang::tree;
use crate::process;
use crate::receipts::Receipts;
use crate::saver::{Save, Saver};
use crate::stage_log::{self, Pace, Spent};
use crate::telemetry_buffer::{Sender, TelemetryBuffer};

/// Access of one attempt to the coordinator and, in a gang, to its peers.
#[derive(Debug)]
pub(crate) struct HttpContext {
    task: StageTask,
    device: Device,
    data: Arc<DataAccess>,
    held: Arc<ActiveAssignment>,
    client: Client,
    blobs: Arc<HttpBlobs>,
    telemetry: Arc<TelemetryBuffer>,
    mesh: Option<Arc<Mesh>>,
    behind: Option<Behind>,
    /// End of the last exchange or rendezvous.
    computes_since: Instant,
    gang: bool,
    /// True once this attempt has met a gang.
    has_met: bool,
    begun: Instant,
    pace: Pace,
    spent: Spent,
    // Dropped before the sender, because a save waits for recorded values.
    saver: Saver,
    _sender: Sender,
}

/// Transfer of a peer's state to a member that came to the rendezvous with `applied` steps.
#[derive(Debug)]
struct Behind {
    mesh: Arc<Mesh>,
    line: Line,
    applied: Option<u64>,
    begun: Instant,
}

impl HttpContext {
    pub(crate) fn new(
        held: Arc<ActiveAssignment>,
        client: Client,
        cache: Arc<Cache>,
        data: Arc<DataAccess>,
        device: Device,
    ) -> Self {
        let assignment = held.assignment();
        let gang = matches!(assignment.role, protocol::message::Role::Member { .. });
        let blobs = Arc::new(HttpBlobs {
            held: held.clone(),
            client: client.clone(),
            cache,
            receipts: Receipts::default(),
            gang,
        });
        let (telemetry, sender) = TelemetryBuffer::open(held.clone(), client.clone());
        let task = assignment.stage;
        let mesh = None;
        let behind = None;
        let now = Instant::now();
        let computes_since = now;
        let has_met = false;
        let begun = now;
        let pace = Pace::new(now);
        let _sender = sender;
        Self {
            task,
            device,
            data,
            held,
            client,
            blobs,
            telemetry,
            mesh,
            behind,
            computes_since,
            gang,
            has_met,
            begun,
            pace,
            spent: Spent::default(),
            saver: Saver::default(),
            _sender,
        }
    }

    /// The generation of the connections in use.
    #[cfg(any(test, feature = "testing"))]
    pub(crate) fn generation(&self) -> Option<protocol::Generation> {
        self.mesh.as_ref().map(|mesh| mesh.config.generation)
    }

    /// Waits until the save under way has ended, and all recorded metrics and log lines are stored.
    pub(crate) fn flush(&mut self) -> Result<(), ContextError> {
        self.saver.wait();
        self.telemetry.flush(self.telemetry.mark()).map_err(given_up)
    }

    /// Logs the attempt's settings and inputs.
    pub(crate) fn log_opening(&mut self) {
        if !self.held.leads() {
            return;
        }
        let assignment = self.held.assignment();
        self.log(&stage_log::opening(&assignment));
        if !stage_log::tells_settings(&assignment.role) {
            return;
        }
        for (field, digest) in &assignment.stage.inputs {
            // An input that cannot be read is the stage's to report.
            self.log(&stage_log::input(field, *digest, self.manifest(*digest).ok().as_ref()));
        }
    }

    /// Logs the end of the attempt.
    pub(crate) fn log_end(&mut self, outcome: &TaskOutcome) {
        let line = stage_log::end(outcome, self.begun.elapsed(), &self.spent, self.held.peak_memory());
        self.log(&line);
    }

    /// Receipts that prove the uploads of a manifest by this attempt.
    pub(crate) fn receipts(&self, manifest: Digest) -> BTreeMap<Digest, String> {
        self.blobs.receipts.for_manifest(manifest)
    }

    /// Says goodbye to the peers. Connections to members of the next generation, if there is one, continue there.
    fn part(&mut self) {
        if let Some(mesh) = self.mesh.take() {
            let newest = self.held.newest_mesh();
            match newest.filter(|newest| newest.config.generation > mesh.config.generation) {
                Some(next) => mesh.hand_over(&next),
                None => mesh.close(None),
            }
        }
    }

    /// Waits for the coordinator's next generation after the loss of a peer.
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
                    if lost.is_empty() { "no member".to_owned() } else { lost.join("; ") },
                );
                warned = Instant::now();
            }
            self.held.event_count().wait(ticket, Duration::from_secs(1));
        }
    }

    /// Handles a barrier that was not reached. Returns `Ok` if it is tried again with other members.
    fn halted(&mut self, mesh: &Mesh, halt: Halt) -> Result<(), ContextError> {
        match halt {
            Halt::Ended(reason) => {
                self.part();
                Err(ContextError::GrantEnded(reason))
            }
            Halt::Fault(message) => Err(ContextError::Fault(message)),
            Halt::Regroup | Halt::Peer | Halt::Disagree(_) => self.await_regroup(mesh),
        }
    }

    /// Logs that the members agree on a state. `adopted` holds the bytes and the seconds of a transfer to this member.
    fn met(&mut self, mesh: &Mesh, step: Option<u64>, adopted: Option<(usize, f64)>) {
        self.computes_since = Instant::now();
        self.pace.begins_at(step.unwrap_or_default(), self.computes_since);
        if self.has_met && mesh.config.rank == 0 {
            self.log(&stage_log::regrouped(mesh.config.generation, mesh.size(), step));
        }
        self.has_met = true;
        tracing::info!(
            task = %mesh.config.task,
            generation = %mesh.config.generation,
            rank = mesh.config.rank,
            members = mesh.size(),
            adopts = adopted.is_some(),
            bytes = adopted.map(|(bytes, _)| bytes),
            seconds = adopted.map(|(_, seconds)| seconds),
            peak_mib = process::memory().map(|memory| memory.peak >> 20),
            "met the gang"
        );
    }

    fn to_save<'a>(&self, checkpoint: Checkpoint, files: Vec<(String, Box<dyn Blob + 'a>)>) -> Save<'a> {
        Save {
            checkpoint,
            files,
            met: self.mesh.as_ref().map(|mesh| mesh.config.generation),
            recorded: self.telemetry.mark(),
            held: self.held.clone(),
            client: self.client.clone(),
            blobs: self.blobs.clone(),
            telemetry: self.telemetry.clone(),
        }
    }

    /// Marks this member as saving if it asks for blobs between two steps.
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

    fn data(&self) -> Arc<DataAccess> {
        self.data.clone()
    }

    fn blobs(&self) -> Arc<dyn Blobs> {
        self.saves();
        self.blobs.clone()
    }

    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        let bytes = self.blobs.get(digest).map_err(blob_error)?;
        let manifest: Manifest = serde_json::from_slice(&bytes)
            .map_err(|e| ContextError::Corrupt(format!("cannot parse the manifest {digest}: {e}")))?;
        if !manifest.is_readable() {
            let found = manifest.format;
            let known = Manifest::FORMAT;
            return Err(ContextError::Corrupt(format!(
                "manifest {digest} has format {found}; this build reads {known}"
            )));
        }
        Ok(manifest)
    }

    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError> {
        self.blobs.put_manifest(manifest).map_err(blob_error)
    }

    fn progress(&mut self, done: u64, total: u64, unit: &str, metrics: &[(&str, f64)]) {
        let metrics = metrics.iter().filter(|(_, v)| v.is_finite()).map(|(k, v)| ((*k).to_owned(), *v)).collect();
        let progress = Progress { done, total, unit: unit.to_owned(), metrics };
        if let Some(line) = self.pace.line(&progress, Instant::now()).filter(|_| self.held.leads()) {
            self.log(&line);
        }
        self.held.set_progress(progress);
    }

    fn record(&mut self, step: u64, metrics: &[(&str, f64)]) {
        self.telemetry.record(step, metrics);
    }

    fn log(&mut self, line: &str) {
        tracing::info!(target: "stage", task = %self.held.grant().task, "{line}");
        self.telemetry.log(line);
    }

    /// In a gang, drain requests are not reported here: all members must learn of them after the same step, from an
    /// exchange.
    fn interrupted(&self) -> bool {
        self.held.ended().is_some() || (!self.gang && self.held.drain(1))
    }
}

impl GangContext for HttpContext {
    fn latest_checkpoint(&self) -> Result<Option<Manifest>, ContextError> {
        let Some(digest) = self.held.checkpoint() else { return Ok(None) };
        let manifest = self.manifest(digest)?;
        if manifest.kind != ArtifactKind::Checkpoint {
            return Err(ContextError::Corrupt(format!("{digest} is a {:?}; expected a checkpoint", manifest.kind)));
        }
        Ok(Some(manifest))
    }

    fn rendezvous(&mut self, applied: Option<u64>, state: &[&[u8]]) -> Result<Rendezvous, ContextError> {
        self.held.busy().set(Phase::Working);
        self.held.set_holds(applied);
        loop {
            self.check()?;
            if let Some(newer) = self.held.take_mesh() {
                self.part();
                self.mesh = Some(newer);
            }
            let Some(mesh) = self.mesh.clone() else {
                return Err(ContextError::Unavailable("only the stage of a gang has a rendezvous".to_owned()));
            };
            let held = self.held.clone();
            let generation = mesh.config.generation;
            // Rows that may not be stored yet follow the state, and their length follows them.
            let kept = self.telemetry.kept();
            let length = (kept.len() as u64).to_le_bytes();
            let offered: Vec<&[u8]> = state.iter().copied().chain([&kept[..], &length[..]]).collect();
            match rendezvous::rendezvous(&mesh, applied, &offered, &|| held.halt(generation)) {
                Ok(Met::Behind(line)) => {
                    self.behind = Some(Behind { mesh, line, applied, begun: Instant::now() });
                    return Ok(Rendezvous::Behind);
                }
                Ok(Met::Keep) => {
                    self.met(&mesh, applied, None);
                    return Ok(Rendezvous::Keep);
                }
                Err(halt) => self.halted(&mesh, halt)?,
            }
        }
    }

    fn adopt(&mut self, state: &mut [&mut [u8]]) -> Result<Adopted, ContextError> {
        let Some(Behind { mesh, line, applied, begun }) = self.behind.take() else { return Ok(Adopted::Cut) };
        let held = self.held.clone();
        let generation = mesh.config.generation;
        let directly = applied.is_none();
        match rendezvous::adopt(&mesh, line, state, directly, &|| held.halt(generation)) {
            Ok(rest) => {
                let rows = rows(&rest).ok_or_else(|| "is truncated".to_owned());
                let taken = rows.and_then(|rows| self.telemetry.take_over(rows, applied).map_err(|e| e.to_string()));
                // The peer's bytes may already overwrite this member's own state, so this try has failed.
                taken.map_err(|why| ContextError::Fault(format!("a peer's list of recorded values {why}")))?;
                let step = line.step;
                self.held.set_holds(Some(step));
                let bytes = state.iter().map(|piece| piece.len()).sum::<usize>() + rest.len();
                self.met(&mesh, Some(step), Some((bytes, begun.elapsed().as_secs_f64())));
                Ok(Adopted::Whole)
            }
            Err(halt) => {
                self.halted(&mesh, halt)?;
                Ok(Adopted::Cut)
            }
        }
    }

    fn share(&self, slices: usize) -> Range<usize> {
        self.mesh.as_ref().map_or(0..0, |mesh| tree::share(slices, mesh.config.rank, mesh.size()))
    }

    fn exchange(
        &mut self,
        steps: Range<u64>,
        slices: usize,
        parts: &mut [(Node, Vec<f32>)],
    ) -> Result<Exchange, ContextError> {
        let step = steps.start;
        self.check()?;
        // An upload may take half of the bandwidth of this member's line.
        let saves = self.held.busy().phase() == Phase::Saving || self.saver.is_running();
        self.held.busy().set(Phase::Working);
        failpoints::pace();
        let computed = self.computes_since.elapsed();
        let Some(mesh) = self.mesh.clone() else { return Ok(Exchange::Regroup) };
        let generation = mesh.config.generation;
        if self.held.halt(generation).is_some() {
            self.part();
            return Ok(Exchange::Regroup);
        }
        let share = self.share(slices);
        let own: Vec<(Node, &[f32])> = parts.iter().map(|(node, part)| (node.clone(), part.as_slice())).collect();
        let is_whole = own.iter().flat_map(|(node, _)| node.clone()).eq(share.clone());
        if !is_whole || own.iter().any(|(_, part)| part.len() != own[0].1.len()) {
            let nodes: Vec<&Node> = own.iter().map(|(node, _)| node).collect();
            return Err(ContextError::Fault(format!(
                "step {step}: the slices {nodes:?} are not this member's {share:?}, or have other lengths; this is a bug \
                 in the stage"
            )));
        }
        let drain = self.held.drain(mesh.size());
        let durable = self.telemetry.durable();
        let held = self.held.clone();
        let begun = Instant::now();
        let exchanged = if mesh.size() == 1 {
            // The sum may be gigabytes; it is not copied.
            let own = parts.iter_mut().map(|(node, part)| (node.clone(), std::mem::take(part)));
            Ok(Total { sum: tree_sum(slices, own), drain, durable })
        } else {
            let contribution = Contribution { step, slices, parts: own, drain, saves, computed, durable };
            exchange::exchange(&mesh, &contribution, &|| held.halt(generation))
        };
        self.computes_since = Instant::now();
        let took = self.computes_since - begun;
        let (computed, exchanging) = if mesh.size() > 1 { (computed, took) } else { (computed + took, Duration::ZERO) };
        self.spent.add(steps.end - steps.start, computed, exchanging);
        match exchanged {
            Ok(total) => {
                self.held.set_holds(Some(steps.end));
                self.telemetry.forget(total.durable);
                Ok(Exchange::Sum { sum: total.sum, drain: total.drain })
            }
            Err(halt) => {
                self.halted(&mesh, halt)?;
                Ok(Exchange::Regroup)
            }
        }
    }

    fn leads(&self) -> bool {
        self.mesh.as_ref().map_or_else(|| self.held.leads(), |mesh| mesh.config.rank == 0)
    }

    fn hold(&mut self) -> Result<(), ContextError> {
        let Some(mesh) = self.mesh.clone() else {
            return Err(ContextError::Unavailable("only the stage of a gang holds state for other members".to_owned()));
        };
        // Store this member's log before rank 0 ends the attempt for all.
        self.flush()?;
        let held = self.held.clone();
        let generation = mesh.config.generation;
        let barrier = format!("barrier `closing` of generation {generation}");
        let halt = mesh.watch(0, &barrier, &|| held.halt(generation));
        self.halted(&mesh, halt)
    }

    fn can_save(&self) -> bool {
        !self.held.is_away() && !self.held.is_put_off()
    }

    fn save(&mut self, checkpoint: Checkpoint, files: &[(&str, &[&[u8]])]) -> Result<(), ContextError> {
        // The peers wait while the state is copied, and for the save before.
        self.saves();
        self.saver.wait();
        let copy = |(name, pieces): &(&str, &[&[u8]])| Ok(((*name).to_owned(), self.blobs.cache.copy(pieces)?));
        let copies: std::io::Result<Vec<_>> = files.iter().map(copy).collect();
        match copies {
            Ok(copies) => self.saver.begin(self.to_save(checkpoint, copies)),
            Err(error) => {
                // A full disk here must not cost a checkpoint.
                tracing::warn!("no copy of a checkpoint can be made here, so training waits for it: {error}");
                let own = files.iter().map(|(name, pieces)| {
                    let joined: Box<dyn Blob + '_> = Box::new(Joined::new(pieces.to_vec()));
                    ((*name).to_owned(), joined)
                });
                self.saver.make(&self.to_save(checkpoint, own.collect()));
                Ok(())
            }
        }
    }

    fn saved(&mut self, wait: bool) -> Option<Result<u64, ContextError>> {
        if wait {
            self.saves();
            self.saver.wait();
        }
        self.saver.take()
    }
}

/// Extracts the kept rows from the bytes that follow a peer's state; their length is at the end.
fn rows(behind: &[u8]) -> Option<&[u8]> {
    let (rows, length) = behind.split_at_checked(behind.len().checked_sub(8)?)?;
    (u64::from_le_bytes(length.try_into().ok()?) == rows.len() as u64).then_some(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_that_came_behind_a_state_are_whole_or_refused() {
        let behind = |rows: &[u8], length: u64| [rows, &length.to_le_bytes()].concat();
        assert_eq!(rows(&behind(&[10, 11], 2)), Some(&[10, 11][..]));
        assert_eq!(rows(&behind(&[], 0)), Some(&[][..]));
        for broken in [vec![], vec![1, 2], behind(&[1; 3], 5), behind(&[1; 6], 5)] {
            assert_eq!(rows(&broken), None, "{broken:?}");
        }
    }
}
