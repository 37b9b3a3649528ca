//! The stream of events: resumed where it was left, told to begin anew where it cannot be, and limited.

use std::time::{Duration, Instant};

use access::Server;
use protocol::limits;
use registry::{HistoryEntry, HistoryKind, HistoryRow, Holder, Store, Write};
use reqwest::{Method, Response, StatusCode};

use super::shell::{TestResult, start, submission};

/// Events of a stream, as `(event, id, data)`.
struct Events {
    answer: Response,
    text: String,
}

impl Events {
    async fn open(server: &Server, query: &str, last: Option<&str>) -> TestResult<Self> {
        let mut request = server.request(Method::GET, &format!("/v1/events{query}"));
        if let Some(last) = last {
            request = request.header("last-event-id", last);
        }
        let answer = request.send().await?;
        assert_eq!(answer.status(), StatusCode::OK);
        assert_eq!(answer.headers()["content-type"], "text/event-stream");
        Ok(Self { answer, text: String::new() })
    }

    async fn next(&mut self) -> TestResult<Option<(String, String, String)>> {
        loop {
            if let Some((event, rest)) = self.text.split_once("\n\n") {
                let field = |name: &str| {
                    let line = event.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
                    line.map(|line| line.trim_start().to_owned()).unwrap_or_default()
                };
                let found = (field("event"), field("id"), field("data"));
                self.text = rest.to_owned();
                if !found.0.is_empty() {
                    return Ok(Some(found));
                }
                continue;
            }
            let part = tokio::time::timeout(Duration::from_secs(20), self.answer.chunk()).await??;
            let Some(part) = part else { return Ok(None) };
            self.text.push_str(std::str::from_utf8(&part)?);
        }
    }

    /// The next row of the history.
    async fn row(&mut self) -> TestResult<HistoryRow> {
        loop {
            let (event, id, data) = self.next().await?.ok_or("the stream has ended")?;
            if event == "history" {
                let row: HistoryRow = serde_json::from_str(&data)?;
                assert_eq!(row.id.to_string(), id);
                return Ok(row);
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_goes_on_where_it_was_left() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, server) = start(dir.path(), 100).await?;
    let run = handle.submit(submission()?).await?;
    let mut events = Events::open(&server, "?after=0", None).await?;
    assert_eq!(events.next().await?.map(|event| event.0).as_deref(), Some("ready"));
    let submitted = events.row().await?;
    assert_eq!((submitted.entry.kind, submitted.entry.run.as_ref()), (HistoryKind::Submitted, Some(&run)));
    drop(events);

    handle.control(&run, coordinator::Control::Pause).await?;
    let mut events = Events::open(&server, "", Some(&submitted.id.to_string())).await?;
    let paused = events.row().await?;
    assert_eq!(paused.entry.kind, HistoryKind::Paused, "and nothing that was seen before");
    // Without a place, a stream begins with what comes next.
    let mut fresh = Events::open(&server, &format!("?run={run}"), None).await?;
    assert_eq!(fresh.next().await?.map(|event| event.1), Some(paused.id.to_string()));
    handle.control(&run, coordinator::Control::Resume).await?;
    let began = Instant::now();
    assert_eq!(fresh.row().await?.entry.kind, HistoryKind::Resumed);
    assert_eq!(events.row().await?.entry.kind, HistoryKind::Resumed);
    println!("an event came after {:?}", began.elapsed());

    // The same rows by a call that waits.
    let after = paused.id + 1;
    let asked = server.request(Method::GET, &format!("/v1/history?run={run}&after={after}&wait=20"));
    let asked = tokio::spawn(asked.send());
    tokio::time::sleep(Duration::from_millis(300)).await;
    handle.control(&run, coordinator::Control::Cancel).await?;
    let rows: Vec<HistoryRow> = asked.await??.json().await?;
    assert_eq!(rows.last().map(|row| row.entry.kind), Some(HistoryKind::Ended));

    let mut short = Events::open(&server, "?lasts=0&after=0", None).await?;
    while short.next().await?.is_some() {}
    for query in ["?after=-1", "?after=x", "?kind=1"] {
        let status = server.request(Method::GET, &format!("/v1/events{query}")).send().await?.status();
        assert_eq!(status, StatusCode::BAD_REQUEST, "{query}");
    }
    let unknown = server.request(Method::GET, "/v1/events?run=none").send().await?.status();
    assert_eq!(unknown, StatusCode::NOT_FOUND);
    handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_far_behind_begins_anew_and_streams_are_limited() -> TestResult {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a test")).await?;
    let entry = HistoryEntry { worker: Some("w".into()), ..HistoryEntry::new(HistoryKind::Joined) };
    let behind = limits::EVENTS_BEHIND as usize + 10;
    store.write(vec![Write::History(vec![entry; behind])]).await?;
    let config = coordinator::Config { alone: false, park: false, ..coordinator::Config::embedded() };
    let handle = coordinator::Coordinator::start(store, config).await?;
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let mut events = Events::open(&server, "?after=1", None).await?;
    assert_eq!(events.next().await?.map(|event| event.0).as_deref(), Some("ready"));
    let (event, id, _) = events.next().await?.ok_or("the stream has ended")?;
    assert_eq!((event.as_str(), id.parse::<usize>()? >= behind), ("resync", true));
    drop(events);

    let mut open = Vec::new();
    let refused = loop {
        let answer = server.request(Method::GET, "/v1/events").send().await?;
        match answer.status() {
            StatusCode::OK => open.push(answer),
            refused => break refused,
        }
    };
    assert_eq!(refused, StatusCode::TOO_MANY_REQUESTS);
    assert!((limits::STREAMS_OF_TOKEN - 1..=limits::STREAMS_OF_TOKEN).contains(&open.len()), "{}", open.len());
    drop(open);
    let until = Instant::now() + Duration::from_secs(20);
    while server.request(Method::GET, "/v1/events?lasts=0").send().await?.status() != StatusCode::OK {
        assert!(Instant::now() < until, "a stream that was left is still counted");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    handle.shutdown().await;
    Ok(())
}
