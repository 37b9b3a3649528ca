//! History: added, asked for by run and worker, seen by those who may, and removed by age alone.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::open;
use registry::{HistoryEntry, HistoryKind, HistoryQuery, HistoryRow, Write};
use serde_json::json;

fn happened(kind: HistoryKind, run: Option<&str>, worker: Option<&str>) -> HistoryEntry {
    let (run, stage) = (run.map(Into::into), run.map(|_| "s".into()));
    HistoryEntry { run, stage, worker: worker.map(Into::into), actor: Some("t".into()), ..HistoryEntry::new(kind) }
}

fn submitted(run: &str, owner: &str) -> Vec<Write> {
    let write = Write::Run {
        run: run.into(),
        pipeline: json!({"name": "p", "stages": []}),
        source: String::new(),
        state: "running".into(),
        idempotency_key: None,
    };
    vec![write, Write::RunOwner { run: run.into(), owner: protocol::Owner::local(owner).group() }]
}

#[tokio::test]
async fn rows_are_found_by_run_and_worker_and_go_by_age() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write([submitted("r", "me"), submitted("other", "them")].concat()).await.unwrap();
    let entries = vec![
        happened(HistoryKind::Joined, None, Some("w")),
        happened(HistoryKind::Granted, Some("r"), Some("w")),
        happened(HistoryKind::Granted, Some("other"), Some("w")),
        HistoryEntry { why: Some("why <not>".into()), ..happened(HistoryKind::Failed, Some("r"), None) },
    ];
    store.write(vec![Write::History(entries.clone())]).await.unwrap();
    let ask = |asked: HistoryQuery| {
        let store = store.clone();
        async move { store.timeline(&asked).await.unwrap() }
    };
    let all = HistoryQuery { limit: 10, ..HistoryQuery::default() };
    let rows = ask(all.clone()).await;
    assert_eq!(rows.iter().map(|row| row.entry.clone()).collect::<Vec<_>>(), entries);
    assert!(rows.is_sorted_by_key(|row| row.id) && rows[0].at_ms > 0);
    let json = serde_json::to_value(&rows[3]).unwrap();
    assert_eq!((&json["kind"], &json["why"], json.get("worker")), (&json!("failed"), &json!("why <not>"), None));
    assert_eq!(serde_json::from_value::<HistoryRow>(json).unwrap(), rows[3]);

    let of_run = ask(HistoryQuery { run: Some("r".into()), ..all.clone() }).await;
    assert_eq!(of_run, [rows[1].clone(), rows[3].clone()]);
    let of_worker = ask(HistoryQuery { worker: Some("w".into()), after: rows[0].id, limit: 1, ..all.clone() }).await;
    assert_eq!(of_worker, rows[1..2]);
    assert_eq!(ask(HistoryQuery { since_ms: Some(rows[3].at_ms + 1), ..all.clone() }).await, []);

    // Another group sees workers and its own runs, and not whose tokens the workers came with.
    let seen = store.seen_by(&protocol::Owner::local("them").group()).timeline(&all).await.unwrap();
    assert_eq!(seen.iter().map(|row| row.id).collect::<Vec<_>>(), [rows[0].id, rows[2].id]);
    assert_eq!((seen[0].entry.actor.as_deref(), seen[1].entry.actor.as_deref()), (None, Some("t")));

    let times = store.stage_times(&"r".into()).await.unwrap()[&"s".into()];
    assert_eq!((times.started_ms, times.ended_ms), (Some(rows[1].at_ms), Some(rows[3].at_ms)));
    store.write(vec![Write::History(vec![happened(HistoryKind::Granted, Some("r"), Some("w"))])]).await.unwrap();

    assert_eq!(store.delivered("lab").await.unwrap(), None);
    store.record_delivery("lab", rows[1].id).await.unwrap();
    store.record_delivery("lab", rows[2].id).await.unwrap();
    assert_eq!(
        (store.delivered("lab").await.unwrap(), store.delivered("own").await.unwrap()),
        (Some(rows[2].id), None)
    );
    assert_eq!(store.prune_history(rows[3].at_ms + 3_600_000).await.unwrap(), 5);
    let times = store.stage_times(&"r".into()).await.unwrap()[&"s".into()];
    assert_eq!((times.started_ms, times.ended_ms), (Some(rows[1].at_ms), None), "times stay, and it goes on");
    let whole = store.run_times(&["r".into()]).await.unwrap()[&"r".into()];
    assert!(whole.created_ms.is_some() && whole.started_ms == times.started_ms && whole.ended_ms.is_none());
}
