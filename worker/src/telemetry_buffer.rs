//! Metrics and log lines on their way to the coordinator.
//!
//! The stage puts them here and goes on; a thread sends them in batches, again and again until they are acknowledged. A row
//! is named by (task, attempt, key, step) and a line by (worker, number), so a batch that arrives twice is stored once.
//!
//! In a gang every member keeps the rows and only rank 0 sends them. Rank 0 tells the others with every exchange up to which
//! step all is stored; they forget that. So when rank 0 dies, the next one has what had not arrived: no hole, and no
//! double, since both computed the same numbers. Who takes over a peer's state takes over the rows that the peer keeps: those of the
//! steps that it did not apply itself, which it would lack if it is rank 0 or becomes it.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use protocol::message::{LogBatch, MetricBatch, MetricRow};

use crate::active_assignment::ActiveAssignment;
use crate::client::{CallError, Client};
use crate::event_count::lock;
use crate::retry::{self, GaveUp};

/// Rows kept while the coordinator is away. About a day at ten values a second; beyond it the oldest are dropped.
const MAX_ROWS: usize = 1 << 20;
/// Lines kept, and bytes in them.
const MAX_LINES: usize = 1 << 17;
/// A longer line is cut.
const MAX_LINE: usize = 64 << 10;
/// Rows in one batch.
const BATCH_ROWS: usize = 2000;
/// Lines in one batch.
const BATCH_LINES: usize = 5000;
/// Bytes of lines in one batch.
const BATCH_BYTES: usize = 512 << 10;
/// How often what has gathered is sent.
const PERIOD: Duration = Duration::from_millis(500);

/// Lines of a process are numbered through, whatever attempt they belong to, in a range of the process's own: one attempt
/// may see several processes of one worker, and one process several stints at one attempt.
static LINES: AtomicU64 = AtomicU64::new(0);

#[derive(Debug, Default)]
struct State {
    rows: VecDeque<MetricRow>,
    /// First unsent line's number, and the lines.
    lines: VecDeque<(u64, String)>,
    newest_step: u64,
    dropped: u64,
    failed: Option<CallError>,
}

impl State {
    /// Takes over those of a peer's rows, oldest first, that are of steps after `applied`; all, if none was applied here.
    fn take_over(&mut self, rows: Vec<MetricRow>, applied: Option<u64>) {
        let missed = rows.into_iter().filter(|row| applied.is_none_or(|applied| row.step > applied));
        for row in missed {
            self.newest_step = self.newest_step.max(row.step);
            self.rows.push_back(row);
        }
    }
}

/// What is on its way for one assignment.
#[derive(Debug)]
pub(crate) struct TelemetryBuffer {
    state: Mutex<State>,
    held: Arc<ActiveAssignment>,
    client: Client,
    closing: AtomicBool,
    hurry: AtomicBool,
}

impl TelemetryBuffer {
    /// Starts the thread that sends.
    pub(crate) fn open(held: Arc<ActiveAssignment>, client: Client) -> (Arc<Self>, Sender) {
        let telemetry = Arc::new(Self {
            state: Mutex::default(),
            held,
            client,
            closing: AtomicBool::new(false),
            hurry: AtomicBool::new(false),
        });
        let sender = telemetry.clone();
        let thread = thread::Builder::new().name("telemetry".to_owned()).spawn(move || sender.run());
        let thread = thread.expect("a thread can be started");
        (telemetry.clone(), Sender { telemetry, thread: Some(thread) })
    }

    /// Takes values of a step. What is not a number cannot be kept as one and is left out.
    pub(crate) fn record(&self, step: u64, metrics: &[(&str, f64)]) {
        let mut state = lock(&self.state);
        for &(key, value) in metrics {
            if value.is_finite() {
                state.rows.push_back(MetricRow { step, key: key.to_owned(), value });
            } else {
                tracing::warn!("`{key}` of step {step} is {value} and is not recorded");
            }
        }
        state.newest_step = state.newest_step.max(step);
        while state.rows.len() > MAX_ROWS {
            state.rows.pop_front();
            state.dropped += 1;
            if state.dropped.is_power_of_two() {
                tracing::warn!(
                    "{} recorded values were dropped: the coordinator has been away for too long",
                    state.dropped
                );
            }
        }
    }

    /// All rows that are kept here, for a peer that takes over this member's state; see [`Self::take_over`].
    pub(crate) fn kept(&self) -> Vec<u8> {
        let rows: Vec<MetricRow> = lock(&self.state).rows.iter().cloned().collect();
        serde_json::to_vec(&rows).expect("rows serialise")
    }

    /// Takes over what a peer keeps of the steps after `applied`, which are in the state that came with it.
    ///
    /// # Errors
    /// If `kept` is not what [`Self::kept`] gives; nothing is changed then.
    pub(crate) fn take_over(&self, kept: &[u8], applied: Option<u64>) -> Result<(), serde_json::Error> {
        let rows = serde_json::from_slice(kept)?;
        lock(&self.state).take_over(rows, applied);
        Ok(())
    }

    /// Takes a log line.
    pub(crate) fn log(&self, line: &str) {
        let mut end = line.len().min(MAX_LINE);
        while !line.is_char_boundary(end) {
            end -= 1;
        }
        let text = if end == line.len() {
            line.to_owned()
        } else {
            format!("{} ... ({} bytes cut)", &line[..end], line.len() - end)
        };
        let base = self.held.grant().incarnation.0 << 32;
        let number = base + LINES.fetch_add(1, Ordering::SeqCst);
        let mut state = lock(&self.state);
        state.lines.push_back((number, text));
        while state.lines.len() > MAX_LINES {
            state.lines.pop_front();
        }
    }

    /// The last step of which everything recorded is stored, as far as is certain.
    pub(crate) fn durable(&self) -> u64 {
        let state = lock(&self.state);
        state.rows.iter().map(|row| row.step).min().unwrap_or(state.newest_step).saturating_sub(1)
    }

    /// Everything up to `step` is stored by rank 0.
    pub(crate) fn forget(&self, step: u64) {
        if !self.held.leads() {
            lock(&self.state).rows.retain(|row| row.step > step);
        }
    }

    /// Waits until all that was put here before is stored.
    pub(crate) fn flush(&self) -> Result<(), GaveUp> {
        loop {
            let ticket = self.held.event_count().ticket();
            {
                let state = lock(&self.state);
                if let Some(error) = &state.failed {
                    return Err(GaveUp::Answer(error.clone()));
                }
                // Others keep rows for the case that rank 0 dies; they are not waited for.
                if state.lines.is_empty() && (state.rows.is_empty() || !self.held.leads()) {
                    return Ok(());
                }
            }
            if let Some(reason) = self.held.ended() {
                return Err(GaveUp::Ended(reason));
            }
            self.hurry.store(true, Ordering::SeqCst);
            self.held.event_count().notify();
            self.held.event_count().wait(ticket + 1, PERIOD);
        }
    }

    fn run(&self) {
        while !self.closing.load(Ordering::SeqCst) && self.held.ended().is_none() {
            match self.send() {
                Ok(true) => continue,
                Ok(false) => {}
                Err(GaveUp::Ended(_)) => return,
                Err(GaveUp::Answer(error)) => {
                    tracing::error!("metrics or logs were refused: {error}");
                    lock(&self.state).failed = Some(error);
                    self.held.event_count().notify();
                    return;
                }
            }
            self.idle();
        }
    }

    /// Sleeps for a period; a flush or the end cuts it short.
    fn idle(&self) {
        let until = std::time::Instant::now() + PERIOD;
        loop {
            let ticket = self.held.event_count().ticket();
            let left = until.saturating_duration_since(std::time::Instant::now());
            let over = self.closing.load(Ordering::SeqCst) || self.held.ended().is_some();
            if left.is_zero() || over || self.hurry.swap(false, Ordering::SeqCst) {
                return;
            }
            self.held.event_count().wait(ticket, left);
        }
    }

    /// Sends one batch of each; whether there may be more.
    fn send(&self) -> Result<bool, GaveUp> {
        let (rows, lines) = {
            let state = lock(&self.state);
            let rows: Vec<_> = match self.held.leads() {
                true => state.rows.iter().take(BATCH_ROWS).cloned().collect(),
                false => Vec::new(),
            };
            let mut bytes = 0;
            let lines: Vec<_> = state
                .lines
                .iter()
                .enumerate()
                .take_while(|&(i, (number, line))| {
                    bytes += line.len();
                    // Numbers of a batch are without gaps; another attempt's line in between ends it.
                    (i == 0 || bytes <= BATCH_BYTES && i < BATCH_LINES) && *number == state.lines[0].0 + i as u64
                })
                .map(|(_, line)| line.clone())
                .collect();
            (rows, lines)
        };
        if !rows.is_empty() {
            let sent = retry::until_ended(&self.held, "sending metrics", |credential| {
                let batch = MetricBatch { grant: credential.grant.clone(), rows: rows.clone() };
                self.client.wait(self.client.tell("/v1/metrics", credential, &batch))
            });
            stored_or_left_out(sent)?;
            let mut state = lock(&self.state);
            for row in &rows {
                // A drop for lack of room may have been faster.
                if state.rows.front() == Some(row) {
                    state.rows.pop_front();
                }
            }
        }
        if let Some((first, _)) = lines.first() {
            let sent = retry::until_ended(&self.held, "sending logs", |credential| {
                let lines = lines.iter().map(|(_, line)| line.clone()).collect();
                let batch = LogBatch { grant: credential.grant.clone(), first: *first, lines };
                self.client.wait(self.client.tell("/v1/logs", credential, &batch))
            });
            stored_or_left_out(sent)?;
            let last = first + lines.len() as u64;
            let mut state = lock(&self.state);
            while state.lines.front().is_some_and(|(number, _)| *number < last) {
                state.lines.pop_front();
            }
        }
        let more = !rows.is_empty() || !lines.is_empty();
        if more {
            self.held.event_count().notify();
        }
        Ok(more)
    }
}

/// Drops a batch beyond the run's limit; the work continues without it.
fn stored_or_left_out(sent: Result<(), GaveUp>) -> Result<(), GaveUp> {
    match sent {
        Err(GaveUp::Answer(CallError::UsedUp(why))) => {
            tracing::warn!("left out: {why}");
            Ok(())
        }
        sent => sent,
    }
}

/// Ends the thread when dropped. What is not sent by then is not sent; flush before.
#[derive(Debug)]
pub(crate) struct Sender {
    telemetry: Arc<TelemetryBuffer>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Sender {
    fn drop(&mut self) {
        self.telemetry.closing.store(true, Ordering::SeqCst);
        self.telemetry.held.event_count().notify();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread that sends metrics has panicked");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(state: &State) -> Vec<u64> {
        state.rows.iter().map(|row| row.step).collect()
    }

    #[test]
    fn who_takes_over_a_state_takes_over_the_rows_that_it_lacks() {
        let rows = |steps: std::ops::Range<u64>| -> Vec<MetricRow> {
            steps.map(|step| MetricRow { step, key: "loss".to_owned(), value: 1.0 }).collect()
        };
        // Rank 0 applied 5, has stored up to 3, and missed the sixth step, which a peer applied.
        let mut lead = State { rows: rows(4..6).into(), newest_step: 5, ..State::default() };
        lead.take_over(rows(2..7), Some(5));
        assert_eq!((steps(&lead), lead.newest_step), (vec![4, 5, 6], 6));
        // A joiner has nothing yet.
        let mut joiner = State::default();
        joiner.take_over(rows(4..7), None);
        assert_eq!((steps(&joiner), joiner.newest_step), (vec![4, 5, 6], 6));
    }
}
