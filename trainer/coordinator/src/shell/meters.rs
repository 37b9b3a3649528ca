//! The server's own counters, which [`scrape`](super::scrape) shows.

use std::time::Duration;

use axum::http::StatusCode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use protocol::limits::SMALL_BLOB_BYTES;

pub(super) type Labels = Vec<(&'static str, String)>;

/// Numbers that the server counts while it runs.
#[derive(Debug)]
pub(crate) struct Meters {
    pub(super) answers: Family<Labels, Counter>,
    pub(super) commits: Histogram,
    pub(super) values: Counter,
    pub(super) lines: Counter,
    pub(super) messages: Family<Labels, Counter>,
    pub(super) blob_bytes: Family<Labels, Counter>,
}

impl Default for Meters {
    fn default() -> Self {
        let commits = Histogram::new(exponential_buckets(0.001, 2.0, 14));
        Self {
            answers: Family::default(),
            commits,
            values: Counter::default(),
            lines: Counter::default(),
            messages: Family::default(),
            blob_bytes: Family::default(),
        }
    }
}

impl Meters {
    /// Counts an answer by its class; 429 is a class of its own, for it says that the server is busy.
    pub(crate) fn answered(&self, status: StatusCode) {
        let class = match status.as_u16() {
            429 => "429".to_owned(),
            code => format!("{}xx", code / 100),
        };
        self.answers.get_or_create(&vec![("status", class)]).inc();
    }

    /// Notes how long a transaction of decisions took to be on disk.
    pub(crate) fn committed(&self, took: Duration) {
        self.commits.observe(took.as_secs_f64());
    }

    /// Counts a try to deliver a message to a webhook, by its result.
    pub(crate) fn sent(&self, result: &str) {
        self.messages.get_or_create(&vec![("result", result.to_owned())]).inc();
    }

    /// Counts `bytes` bytes of a blob of `whole` bytes that this server receives (`in`) or sends (`out`).
    pub(crate) fn carried(&self, direction: &str, whole: u64, bytes: u64) {
        let size = if whole > SMALL_BLOB_BYTES { "large" } else { "small" };
        let labels = vec![("direction", direction.to_owned()), ("size", size.to_owned())];
        self.blob_bytes.get_or_create(&labels).inc_by(bytes);
    }

    pub(crate) fn recorded(&self, values: usize, lines: usize) {
        self.values.inc_by(values as u64);
        self.lines.inc_by(lines as u64);
    }
}
