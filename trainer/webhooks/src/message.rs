//! The text of messages.

use chrono::{DateTime, SecondsFormat};
use registry::{HistoryKind, HistoryRow};
use serde_json::{Map, Value, json};

/// The subject of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// A run failed.
    Failed,
    /// A stage makes no progress.
    Stalled,
    /// A run finished.
    Finished,
    /// A run was cancelled.
    Cancelled,
    /// An alias was moved forward.
    Promoted,
    /// An alias was moved back.
    RolledBack,
}

impl Topic {
    pub const ALL: [Self; 6] =
        [Self::Failed, Self::Stalled, Self::Finished, Self::Cancelled, Self::Promoted, Self::RolledBack];

    /// Its name in the file of hooks.
    pub fn short(self) -> &'static str {
        match self {
            Self::Failed => "failed",
            Self::Stalled => "stalled",
            Self::Finished => "finished",
            Self::Cancelled => "cancelled",
            Self::Promoted => "promoted",
            Self::RolledBack => "rolled-back",
        }
    }

    /// The `type` of its messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Failed => "run.failed",
            Self::Stalled => "run.stalled",
            Self::Finished => "run.finished",
            Self::Cancelled => "run.cancelled",
            Self::Promoted => "model.promoted",
            Self::RolledBack => "model.rolled-back",
        }
    }

    /// Returns true if hooks without `on=` get it. The person who cancels a run knows it.
    pub(crate) fn is_usual(self) -> bool {
        self != Self::Cancelled
    }

    /// The topic of an event; `None` if it has none.
    fn of(row: &HistoryRow) -> Option<Self> {
        match (row.entry.kind, row.entry.why.as_deref()) {
            (HistoryKind::Ended, Some("failed")) => Some(Self::Failed),
            (HistoryKind::Ended, Some("finished")) => Some(Self::Finished),
            (HistoryKind::Ended, Some("cancelled")) => Some(Self::Cancelled),
            (HistoryKind::Stalled, _) => Some(Self::Stalled),
            (HistoryKind::Promoted, _) => Some(Self::Promoted),
            (HistoryKind::RolledBack, _) => Some(Self::RolledBack),
            _ => None,
        }
    }
}

/// A message, the same at each try to deliver it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    pub topic: Topic,
    /// Its id, by which a receiver knows a repetition.
    pub id: String,
    /// The JSON that is sent.
    pub body: String,
}

impl Message {
    /// The message about an event; `None` if the event has no topic. `cause` is the event of the stage whose failure
    /// ended the run.
    pub fn of(row: &HistoryRow, cause: Option<&HistoryRow>) -> Option<Self> {
        let topic = Topic::of(row)?;
        let mut data = object(json!(row));
        if let Some(cause) = cause {
            data.insert("cause".to_owned(), json!(cause));
        }
        let time = DateTime::from_timestamp_millis(row.at_ms).unwrap_or_default();
        let body = json!({
            "type": topic.name(),
            "timestamp": time.to_rfc3339_opts(SecondsFormat::Millis, true),
            "text": sentence(topic, row, cause),
            "data": data,
        });
        Some(Self { topic, id: format!("stride-{}-{}", row.at_ms, row.id), body: body.to_string() })
    }
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

/// The message in one sentence.
fn sentence(topic: Topic, row: &HistoryRow, cause: Option<&HistoryRow>) -> String {
    let entry = &row.entry;
    let run = || entry.run.as_ref().map_or("?", |run| run.as_str());
    let stage = |row: &HistoryRow| row.entry.stage.as_ref().map_or("?", |stage| stage.as_str()).to_owned();
    let because = |why: Option<&str>| why.and_then(|why| why.lines().next()).map(|why| format!(": {why}"));
    let because = |row: &HistoryRow| because(row.entry.why.as_deref()).unwrap_or_default();
    match topic {
        Topic::Failed => match cause {
            Some(cause) => format!("Run {} failed in stage {}{}", run(), stage(cause), because(cause)),
            None => format!("Run {} failed", run()),
        },
        Topic::Stalled => format!("Run {} stands still in stage {}{}", run(), stage(row), because(row)),
        Topic::Finished => format!("Run {} finished", run()),
        Topic::Cancelled => format!("Run {} was cancelled", run()),
        Topic::Promoted | Topic::RolledBack => {
            let model = entry.model.as_ref().map_or("?", |model| model.as_str());
            let moved = if topic == Topic::Promoted { "promoted" } else { "rolled back" };
            let actor = entry.actor.as_ref().map(|actor| format!(" by {actor}")).unwrap_or_default();
            format!("Model {model} was {moved}{actor}{}", because(row))
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use registry::HistoryEntry;

    use super::*;

    fn row(id: i64, kind: HistoryKind, change: impl FnOnce(&mut HistoryEntry)) -> HistoryRow {
        let mut entry = HistoryEntry { run: Some("r-7".into()), ..HistoryEntry::new(kind) };
        change(&mut entry);
        HistoryRow { id, at_ms: 1_798_761_599_999, entry }
    }

    #[test]
    fn a_failure_names_its_stage_and_its_reason() {
        let cause = row(3, HistoryKind::Failed, |entry| {
            entry.stage = Some("vae".into());
            entry.why = Some("no frames\nsecond line".into());
        });
        let failed = row(4, HistoryKind::Ended, |entry| entry.why = Some("failed".into()));
        let message = Message::of(&failed, Some(&cause)).unwrap();
        let body: Value = serde_json::from_str(&message.body).unwrap();
        assert_eq!(body["type"], "run.failed");
        assert_eq!(body["timestamp"], "2026-12-31T23:59:59.999Z");
        assert_eq!(body["text"], "Run r-7 failed in stage vae: no frames");
        assert_eq!(body["data"]["cause"]["stage"], "vae");
        assert_eq!(message, Message::of(&failed, Some(&cause)).unwrap(), "the same at each try");
    }

    #[test]
    fn only_news_is_sent() {
        for (kind, why, topic) in [
            (HistoryKind::Ended, Some("finished"), Some(Topic::Finished)),
            (HistoryKind::Ended, Some("cancelled"), Some(Topic::Cancelled)),
            (HistoryKind::Stalled, Some("no progress for 30 minutes"), Some(Topic::Stalled)),
            (HistoryKind::Promoted, None, Some(Topic::Promoted)),
            (HistoryKind::RolledBack, None, Some(Topic::RolledBack)),
            (HistoryKind::Checkpoint, None, None),
            (HistoryKind::Failed, Some("the run's own event follows"), None),
        ] {
            let row = row(1, kind, |entry| entry.why = why.map(str::to_owned));
            assert_eq!(Message::of(&row, None).map(|message| message.topic), topic, "{kind:?}");
        }
    }
}
