//! Buffer of metrics and log lines on their way to the coordinator.
//!
//! The stage adds to it without waiting. A thread sends batches and repeats each until it is acknowledged. A row is
//! identified by (task, attempt, key, step) and a line by (worker, number), so a batch that arrives twice is stored
//! once.
//!
//! In a gang every member keeps the rows and only rank 0 sends them. With every exchange, rank 0 announces the step up
//! to which all rows are stored, and the others forget those rows. So if rank 0 dies, the next rank 0 has the rows that
//! had not arrived. Rows are neither missing nor doubled, because all members compute the same numbers.
//!
//! A member that takes over a peer's state also takes over the peer's rows of the steps that it did not apply itself.
//! It would lack them if it is rank 0 or becomes it.

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

/// Rows kept while the coordinator is unreachable: about a day at ten values a second. The oldest rows beyond it are
/// dropped.
const MAX_ROWS: usize = 1 << 20;
/// Lines kept, and bytes in them.
const MAX_LINES: usize = 1 << 17;
/// Longest line in bytes; the rest is cut.
const MAX_LINE: usize = 64 << 10;
/// Rows in one batch.
const BATCH_ROWS: usize = 2000;
/// Lines in one batch.
const BATCH_LINES: usize = 5000;
/// Bytes of lines in one batch.
const BATCH_BYTES: usize = 512 << 10;
/// Interval between two batches.
const PERIOD: Duration = Duration::from_millis(500);

/// Numbers of lines continue through all attempts of a process and start in a range of the process's own. One attempt
/// may see several processes of one worker, and one process may work on an attempt several times.
static LINES: AtomicU64 = AtomicU64::new(0);

#[derive(Debug, Default)]
struct State {
    rows: VecDeque<MetricRow>,
    /// Unsent lines with their numbers.
    lines: VecDeque<(u64, String)>,
    newest_step: u64,
    dropped: u64,
    failed: Option<CallError>,
}

/// A place in the recorded rows and lines.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mark {
    /// The newest step with a row.
    step: u64,
    /// Number of the newest unsent line.
    line: Option<u64>,
}

impl State {
    /// Returns true if rows up to `mark` are not stored.
    fn lacks_rows(&self, mark: Mark) -> bool {
        self.rows.front().is_some_and(|row| row.step <= mark.step)
    }

    /// Returns true if lines up to `mark` are not stored.
    fn lacks_lines(&self, mark: Mark) -> bool {
        mark.line.is_some_and(|line| self.lines.front().is_some_and(|(number, _)| *number <= line))
    }

    /// Takes over a peer's rows, oldest first, of the steps after `applied`; all rows if no step was applied here.
    fn take_over(&mut self, rows: Vec<MetricRow>, applied: Option<u64>) {
        let missed = rows.into_iter().filter(|row| applied.is_none_or(|applied| row.step > applied));
        for row in missed {
            self.newest_step = self.newest_step.max(row.step);
            self.rows.push_back(row);
        }
    }
}

/// Unsent rows and lines of one assignment.
#[derive(Debug)]
pub(crate) struct TelemetryBuffer {
    state: Mutex<State>,
    held: Arc<ActiveAssignment>,
    client: Client,
    closing: AtomicBool,
    hurry: AtomicBool,
}

impl TelemetryBuffer {
    /// Creates the buffer and starts the thread that sends.
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

    /// Records values of a step. Values that are not finite are recorded as NaN.
    pub(crate) fn record(&self, step: u64, metrics: &[(&str, f64)]) {
        let mut state = lock(&self.state);
        for &(key, value) in metrics {
            if !value.is_finite() {
                tracing::warn!("`{key}` of step {step} is {value} and is recorded as NaN");
            }
            let value = if value.is_finite() { value } else { f64::NAN };
            state.rows.push_back(MetricRow { step, key: key.to_owned(), value });
        }
        state.newest_step = state.newest_step.max(step);
        while state.rows.len() > MAX_ROWS {
            state.rows.pop_front();
            state.dropped += 1;
            if state.dropped.is_power_of_two() {
                tracing::warn!(
                    "{} recorded values were dropped: the coordinator was unreachable for too long",
                    state.dropped
                );
            }
        }
    }

    /// Serialises all kept rows, for a peer that takes over this member's state; see [`Self::take_over`].
    pub(crate) fn kept(&self) -> Vec<u8> {
        let rows: Vec<MetricRow> = lock(&self.state).rows.iter().cloned().collect();
        serde_json::to_vec(&rows).expect("rows serialise")
    }

    /// Takes over a peer's rows of the steps after `applied`, which are part of the state that came with them.
    ///
    /// # Errors
    /// If `kept` is not a result of [`Self::kept`]; nothing is changed then.
    pub(crate) fn take_over(&self, kept: &[u8], applied: Option<u64>) -> Result<(), serde_json::Error> {
        let rows = serde_json::from_slice(kept)?;
        lock(&self.state).take_over(rows, applied);
        Ok(())
    }

    /// Adds a log line.
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

    /// The last step up to which all recorded rows are known to be stored.
    pub(crate) fn durable(&self) -> u64 {
        let state = lock(&self.state);
        state.rows.iter().map(|row| row.step).min().unwrap_or(state.newest_step).saturating_sub(1)
    }

    /// Forgets the rows up to `step`, which rank 0 has stored.
    pub(crate) fn forget(&self, step: u64) {
        if !self.held.leads() {
            lock(&self.state).rows.retain(|row| row.step > step);
        }
    }

    /// Everything that is recorded so far.
    pub(crate) fn mark(&self) -> Mark {
        let state = lock(&self.state);
        Mark { step: state.newest_step, line: state.lines.back().map(|(number, _)| *number) }
    }

    /// Waits until everything up to `mark` is stored.
    pub(crate) fn flush(&self, mark: Mark) -> Result<(), GaveUp> {
        loop {
            let ticket = self.held.event_count().ticket();
            {
                let state = lock(&self.state);
                if let Some(error) = &state.failed {
                    return Err(GaveUp::Answer(error.clone()));
                }
                // Other members only keep rows in case rank 0 dies, so those are not waited for.
                if !state.lacks_lines(mark) && (!state.lacks_rows(mark) || !self.held.leads()) {
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
                Err(GaveUp::Answer(_)) if self.closing.load(Ordering::SeqCst) => return,
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

    /// Sends one batch of rows and one of lines. Returns true if there may be more.
    fn send(&self) -> Result<bool, GaveUp> {
        let closing = || self.closing.load(Ordering::SeqCst);
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
                    // The numbers in a batch have no gaps; a line of another attempt in between ends it.
                    (i == 0 || bytes <= BATCH_BYTES && i < BATCH_LINES) && *number == state.lines[0].0 + i as u64
                })
                .map(|(_, line)| line.clone())
                .collect();
            (rows, lines)
        };
        if !rows.is_empty() {
            let sent = retry::until_over(&self.held, "sending metrics", closing, |credential| {
                let batch = MetricBatch { grant: credential.grant.clone(), rows: rows.clone() };
                self.client.wait(self.client.tell("/v1/metrics", credential, &batch))
            });
            stored_or_left_out(sent)?;
            let mut state = lock(&self.state);
            for row in &rows {
                // The row may already be dropped for lack of room.
                if state.rows.front().is_some_and(|first| is_same(first, row)) {
                    state.rows.pop_front();
                }
            }
        }
        if let Some((first, _)) = lines.first() {
            let sent = retry::until_over(&self.held, "sending logs", closing, |credential| {
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

/// Ends the thread when dropped. Unsent data is lost; flush before.
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

/// Compares by bits: NaN differs from itself, and its row would be sent without end.
fn is_same(one: &MetricRow, other: &MetricRow) -> bool {
    (one.step, &one.key, one.value.to_bits()) == (other.step, &other.key, other.value.to_bits())
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
        // Rank 0 applied step 5, has stored the rows up to 3, and missed step 6, which a peer applied.
        let mut lead = State { rows: rows(4..6).into(), newest_step: 5, ..State::default() };
        lead.take_over(rows(2..7), Some(5));
        assert_eq!((steps(&lead), lead.newest_step), (vec![4, 5, 6], 6));
        // A joiner has no rows yet.
        let mut joiner = State::default();
        joiner.take_over(rows(4..7), None);
        assert_eq!((steps(&joiner), joiner.newest_step), (vec![4, 5, 6], 6));
    }
}
