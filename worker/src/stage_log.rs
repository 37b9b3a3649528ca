//! The lines that every stage writes to its log: settings, inputs, pace and end.
//!
//! Kinds add lines of their own through [`AttemptContext::log`](stages::context::AttemptContext::log).

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use protocol::message::{Assignment, Progress, Role, TaskOutcome};
use protocol::units::{counted, grouped, size};
use protocol::{Digest, Manifest};

/// Time between two lines on the progress of a stage.
const BETWEEN_LINES: Duration = Duration::from_secs(60);

/// False for all shards of a stage but the first: their settings and inputs are the same.
pub(crate) fn tells_settings(role: &Role) -> bool {
    !matches!(role, Role::Shard { index: 1.., .. } | Role::Merge { .. })
}

/// The first line of an attempt: the stage's kind, this worker's part in it, and once a stage the settings with all defaults.
pub(crate) fn opening(assignment: &Assignment) -> String {
    let Assignment { grant, stage, role, .. } = assignment;
    let part = match role {
        Role::Alone => String::new(),
        Role::Shard { index, of } => format!(", shard {} of {of}", index + 1),
        Role::Merge { shards } => format!(", merge of {} shards", shards.len()),
        Role::Resolve => ", digests of its files".to_owned(),
        Role::Member { members, generation, .. } => {
            format!(", generation {generation} of {}", counted(members.len() as u64, "member"))
        }
    };
    let mut line = format!("attempt {}: {}{part}", grant.attempt, stage.settings.kind());
    if tells_settings(role) {
        let settings = serde_json::to_string(&stage.settings).unwrap_or_default();
        line = format!("{line}, seed {}, {settings}", stage.seed);
    }
    line
}

/// A line about an input. It gives only counts of its meta, because texts in it may come from files.
pub(crate) fn input(field: &str, digest: Digest, manifest: Option<&Manifest>) -> String {
    let Some(manifest) = manifest else { return format!("reads `{field}` {}", digest.short()) };
    let counts = manifest.meta.as_object().into_iter().flatten();
    let counts = counts.filter_map(|(name, value)| Some(format!(", {name} {}", grouped(value.as_u64()?))));
    let counts: String = counts.collect();
    let bytes = grouped(manifest.files.values().map(|file| file.bytes).sum());
    format!("reads `{field}` {}: {}{counts}, {bytes} bytes", digest.short(), manifest.kind.noun())
}

/// A line on a committed checkpoint.
pub(crate) fn checkpoint(step: u64, manifest: &Manifest, metrics: &BTreeMap<String, f64>) -> String {
    let bytes = grouped(manifest.files.values().map(|file| file.bytes).sum());
    format!("checkpoint after step {}, {bytes} bytes{}", grouped(step), values(metrics))
}

/// A line on a gang whose members have met again.
pub(crate) fn regrouped(generation: impl std::fmt::Display, members: usize, step: Option<u64>) -> String {
    let from = step.map(|step| format!(" after step {}", grouped(step))).unwrap_or_default();
    format!("regrouped{from}: generation {generation} of {}", counted(members as u64, "member"))
}

/// Time that a member of a gang has spent on its steps.
#[derive(Debug, Clone, Default)]
pub(crate) struct Spent {
    /// From the end of an exchange to the next one, in a gang of several members.
    computing: Duration,
    /// In exchanges with other members, waiting included.
    exchanging: Duration,
    /// Steps and time of the round under way.
    round: (u64, Duration),
    /// Mean seconds of a step in each of the newest rounds.
    rounds: VecDeque<f64>,
}

impl Spent {
    const NEWEST: usize = 1001;

    /// Length of a round: steps of milliseconds differ by what the rest of the machine does.
    const ROUND: Duration = Duration::from_millis(250);

    /// Adds an exchange after `computed` on `steps` steps. `exchanged` is zero for a member that is alone.
    pub(crate) fn add(&mut self, steps: u64, computed: Duration, exchanged: Duration) {
        if !exchanged.is_zero() {
            self.computing += computed;
            self.exchanging += exchanged;
        }
        let (done, took) = (self.round.0 + steps, self.round.1 + computed + exchanged);
        self.round = (done, took);
        if took < Self::ROUND {
            return;
        }
        self.round = Default::default();
        if self.rounds.len() == Self::NEWEST {
            self.rounds.pop_front();
        }
        self.rounds.push_back(took.as_secs_f64() / done.max(1) as f64);
    }

    /// The time of a step as the median of rounds, and the exchanges' share for a member that was not always alone.
    fn line(&self) -> String {
        let mut rounds: Vec<f64> = self.rounds.iter().copied().collect();
        if rounds.is_empty() && self.round.0 > 0 {
            rounds.push(self.round.1.as_secs_f64() / self.round.0 as f64);
        }
        rounds.sort_by(f64::total_cmp);
        let median = rounds.get(rounds.len() / 2).map(|step| format!(", {step:.4} s a step")).unwrap_or_default();
        let all = (self.computing + self.exchanging).as_secs_f64();
        let share = (!self.exchanging.is_zero()).then(|| 100.0 * self.exchanging.as_secs_f64() / all);
        median + &share.map(|share| format!(" ({share:.0} % in exchanges)")).unwrap_or_default()
    }
}

/// The last line of an attempt. `peak` is the highest memory of the process, in bytes.
pub(crate) fn end(outcome: &TaskOutcome, took: Duration, spent: &Spent, peak: Option<u64>) -> String {
    let seconds = took.as_secs_f64();
    match outcome {
        TaskOutcome::Finished { output, metrics } => {
            let values = values(metrics);
            let memory = peak.map(|bytes| format!(" with at most {} of memory", size(bytes))).unwrap_or_default();
            let steps = spent.line();
            format!("finished in {seconds:.1} s{steps}{memory}: {}{values}", output.short())
        }
        TaskOutcome::Resolved { digests } => {
            format!("digested {} in {seconds:.1} s", counted(digests.len() as u64, "input"))
        }
        TaskOutcome::Yielded { at } => format!("stopped after {seconds:.1} s, at {}", grouped(*at)),
        TaskOutcome::Failed { message, .. } => format!("failed after {seconds:.1} s: {message}"),
    }
}

/// Chooses the moments for lines on the progress of a stage: one a minute.
#[derive(Debug)]
pub(crate) struct Pace {
    since: Instant,
    done: u64,
}

impl Pace {
    pub(crate) fn new(now: Instant) -> Self {
        Self { since: now, done: 0 }
    }

    /// Counts work of an earlier attempt or of a peer, which says nothing on the pace of this one.
    pub(crate) fn begins_at(&mut self, done: u64, now: Instant) {
        *self = Self { since: now, done };
    }

    /// The line on `progress`, if it is due.
    pub(crate) fn line(&mut self, progress: &Progress, now: Instant) -> Option<String> {
        let took = now.saturating_duration_since(self.since);
        if took < BETWEEN_LINES {
            return None;
        }
        let Progress { done, total, unit, metrics } = progress;
        let rate = done.saturating_sub(self.done) as f64 / took.as_secs_f64();
        *self = Self { since: now, done: *done };
        let values = values(metrics);
        Some(format!("{} of {} {unit}, {rate:.3} a second{values}", grouped(*done), grouped(*total)))
    }
}

fn values(metrics: &BTreeMap<String, f64>) -> String {
    metrics.iter().map(|(key, value)| format!(", {key} {value:.6}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_tells_its_pace_once_a_minute() {
        let begun = Instant::now();
        let mut pace = Pace::new(begun);
        let mut lines = Vec::new();
        for second in 0..150 {
            let metrics = BTreeMap::from([("loss".to_owned(), 0.25)]);
            let progress = Progress { done: 20 * second, total: 6000, unit: "steps".to_owned(), metrics };
            lines.extend(pace.line(&progress, begun + Duration::from_secs(second)));
        }
        assert_eq!(
            lines,
            [
                "1,200 of 6,000 steps, 20.000 a second, loss 0.250000",
                "2,400 of 6,000 steps, 20.000 a second, loss 0.250000"
            ]
        );
        pace.begins_at(5000, begun + Duration::from_secs(200));
        let progress = Progress { done: 5060, total: 6000, unit: "steps".to_owned(), metrics: BTreeMap::new() };
        let line = pace.line(&progress, begun + Duration::from_secs(260));
        assert_eq!(line.as_deref(), Some("5,060 of 6,000 steps, 1.000 a second"), "work of others is not its pace");
    }

    #[test]
    fn the_end_tells_the_time_of_a_step_and_the_share_of_exchanges() {
        let output = Digest::of(b"x");
        let outcome = TaskOutcome::Finished { output, metrics: BTreeMap::new() };
        let took = Duration::from_secs(9);
        let mut spent = Spent::default();
        assert_eq!(end(&outcome, took, &spent, None), format!("finished in 9.0 s: {}", output.short()));
        for milliseconds in [250, 4000, 270] {
            spent.add(1, Duration::from_millis(milliseconds), Duration::ZERO);
        }
        let alone = end(&outcome, took, &spent, None);
        assert_eq!(alone, format!("finished in 9.0 s, 0.2700 s a step: {}", output.short()));
        spent.add(10, Duration::from_millis(2250), Duration::from_millis(750));
        let line = end(&outcome, took, &spent, Some(1 << 20));
        let expected = "finished in 9.0 s, 0.3000 s a step (25 % in exchanges) with at most 1.0 MiB of memory";
        assert_eq!(line, format!("{expected}: {}", output.short()));
        (0..3000).for_each(|_| spent.add(1, Spent::ROUND, Duration::ZERO));
        assert_eq!(spent.rounds.len(), Spent::NEWEST);
    }

    #[test]
    fn short_steps_are_measured_in_rounds() {
        let line = |spent: &Spent| spent.line();
        let mut spent = Spent::default();
        spent.add(1, Duration::from_millis(40), Duration::ZERO);
        assert_eq!(line(&spent), ", 0.0400 s a step", "no round has ended");
        // Every fifth step takes ten times as long: a median of single steps would leave these out.
        let mut spent = Spent::default();
        for step in 0..100 {
            spent.add(1, Duration::from_millis(if step % 5 == 0 { 210 } else { 10 }), Duration::ZERO);
        }
        assert_eq!(line(&spent), ", 0.0500 s a step");
    }

    #[test]
    fn an_input_tells_counts_and_no_texts() {
        let digest = Digest::of(b"a manifest");
        let meta = serde_json::json!({"clips": 1204, "secret": "a text of a file", "format": {"deep": 3}});
        let manifest = Manifest::new(protocol::ArtifactKind::Dataset, meta);
        let line = input("dataset", digest, Some(&manifest));
        assert_eq!(line, format!("reads `dataset` {}: a dataset, clips 1,204, 0 bytes", digest.short()));
        assert_eq!(input("dataset", digest, None), format!("reads `dataset` {}", digest.short()));
    }
}
