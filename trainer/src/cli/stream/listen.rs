//! Streams over WebSockets: `GET /v1/stream` with a token of scope `read`, then one message per sentence in, one
//! message per frame out.
//!
//! Nothing is computed before the token is checked and a place is free. A connection takes its place with its first
//! sentence. Silent connections hold no place and are few: the oldest of them is closed for a new one.
//!
//! The cost of a client is bounded in these ways:
//! - the number of places and the size of a message;
//! - waiting sentences: more are not read, so that TCP slows the sender down;
//! - generated frames: the next segment is generated when the last one has been sent;
//! - the time to send a frame, and the time until the first sentence.
//!
//! A message that is no sentence is answered with `{"error": ...}`, and the previous sentence continues. The last
//! message is `{"end": REPORT}`.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use access::{Scope, Tokens};
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use coordinator::RouteServer;
use futures::stream::{SplitSink, SplitStream};
use futures::{SinkExt, StreamExt};
use protocol::message::{self, ApiError};
use serde_json::json;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc::error::TryRecvError;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use super::course::Pace;
use super::engine::Engine;
use super::line::{self, Line, MOST_BYTES};
use super::opening::{Beginning, Opening, StreamArgs};
use super::real;
use super::report::Real;
use crate::report::print;
use crate::report::problem::{Problem, Result, exit};

/// Limit of a connection's queued sentences.
const WAITING: usize = 16;
/// Time limit to send a message: a client that reads nothing for this long is dropped.
const SLOW: Duration = Duration::from_secs(10);
/// Time limit for the first sentence.
const SILENCE: Duration = Duration::from_secs(60);
/// Limit of connections without a sentence.
const SILENT: usize = 32;
/// Limit of bytes that wait for the network.
const WRITE_BYTES: usize = 256 << 10;

/// State shared by all connections.
#[derive(Debug)]
struct StreamServer {
    engine: Engine,
    beginning: Beginning,
    real: Option<Real>,
    bound: Option<u64>,
    rate: f64,
    places: Arc<Semaphore>,
    streams: usize,
    silent: Silent,
}

/// Connections without a sentence, oldest first.
#[derive(Debug, Default)]
struct Silent(Mutex<VecDeque<Arc<Notify>>>);

impl Silent {
    /// Adds a connection and notifies the oldest one to leave if there are too many.
    fn enter(&self) -> Arc<Notify> {
        let leave = Arc::new(Notify::new());
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= SILENT
            && let Some(oldest) = all.pop_front()
        {
            oldest.notify_one();
        }
        all.push_back(Arc::clone(&leave));
        leave
    }

    /// Removes a connection that has sent a sentence or has ended.
    fn leave(&self, which: &Arc<Notify>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).retain(|one| !Arc::ptr_eq(one, which));
    }
}

/// Reason for the end of a connection.
enum End {
    /// The client has left or reads nothing.
    Gone,
    /// The stream has reached its limit of frames.
    Over,
    /// A message for the client.
    Close(u16, Cow<'static, str>),
}

type Sink = SplitSink<WebSocket, Message>;
type Lines = mpsc::Receiver<std::result::Result<Line, String>>;

/// A task that is aborted with its connection.
struct Ends(JoinHandle<()>);

impl Drop for Ends {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Serves streams until an interrupt.
pub(super) async fn listen(
    args: StreamArgs,
    opening: Opening,
    insecure: bool,
    bound: impl Fn(f64) -> Result<Option<u64>>,
) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot listen for signals: {error}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let (Some(address), Some(file)) = (args.listen, &args.listen_token_file) else {
        return Err(Problem::usage("`--listen` needs an address and `--listen-token-file`"));
    };
    let config = args.endpoint.config(address, Tokens::read(file)?, insecure)?;
    // Report errors before the model is loaded.
    let listener = RouteServer::bind(&config).await?;
    let streams = usize::from(args.streams);
    let (engine, beginning) = Engine::start(opening, (args.overlap, args.blend), streams).await?;
    let skeleton = beginning.skeleton();
    let real = args.real.as_deref().map(|path| real::read(path, skeleton)).transpose()?;
    let rate = args.pace.flatten().unwrap_or(skeleton.fps);
    let scheme = if listener.is_encrypted() { "wss" } else { "ws" };
    print::note(&format!(
        "{} streams at {scheme}://{}/v1/stream, {rate} frames per second, {streams} streams at once",
        beginning.label,
        listener.address()
    ));
    let (bound, places) = (bound(skeleton.fps)?, Arc::new(Semaphore::new(streams)));
    let server = Arc::new(StreamServer {
        engine: engine.clone(),
        beginning,
        real,
        bound,
        rate,
        places,
        streams,
        silent: Silent::default(),
    });
    let handler = get(move |upgrade: std::result::Result<WebSocketUpgrade, WebSocketUpgradeRejection>| {
        std::future::ready(match upgrade {
            Ok(upgrade) => Arc::clone(&server).admit(upgrade),
            Err(refused) => refuse(refused.status(), "invalid", refused.body_text(), None),
        })
    });
    let (_stop, stopped) = watch::channel(false);
    tokio::select! {
        () = listener.serve("/v1/stream", &[Scope::Read], handler, stopped) => Ok(0),
        _ = interrupt.recv() => Ok(0),
        _ = terminate.recv() => Ok(0),
        () = engine.gone() => Err(Problem::new(exit::FAULT, anyhow::anyhow!("the model's thread has ended; this is a bug in Stride"))),
    }
}

/// Reads the sentences of a connection, one or more lines per message, until the connection ends.
async fn read(
    mut source: SplitStream<WebSocket>,
    lines: mpsc::Sender<std::result::Result<Line, String>>,
    form: line::Form,
) {
    let mut number = 0;
    while let Some(Ok(message)) = source.next().await {
        let text = match message {
            Message::Text(text) => text,
            Message::Ping(_) | Message::Pong(_) => continue,
            Message::Close(_) => return,
            Message::Binary(_) => {
                number += 1;
                if lines.send(Err(format!("line {number}: is binary; expected text"))).await.is_err() {
                    return;
                }
                continue;
            }
        };
        for text in text.lines().filter(|text| !text.trim().is_empty()) {
            number += 1;
            if lines.send(line::parse(number, text, &form)).await.is_err() {
                return;
            }
        }
    }
}

async fn send(sink: &mut Sink, text: String) -> std::result::Result<(), End> {
    match timeout(SLOW, sink.send(Message::Text(text.into()))).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(_)) => Err(End::Gone),
        Err(_) => {
            tracing::debug!("dropping a client that does not read");
            Err(End::Gone)
        }
    }
}

async fn tell(sink: &mut Sink, what: String) -> std::result::Result<(), End> {
    send(sink, json!({"error": what}).to_string()).await
}

async fn close(sink: &mut Sink, end: End) {
    let End::Close(code, reason) = end else { return };
    let close = CloseFrame { code, reason: reason.as_ref().into() };
    // A client that has left does not receive it.
    let _ = timeout(SLOW, sink.send(Message::Close(Some(close)))).await;
}

/// Refuses a call as the coordinator does.
fn refuse(status: StatusCode, code: &str, message: String, hint: Option<String>) -> Response {
    let problem = message::Problem::new(status.as_u16(), ApiError { code: code.to_owned(), message, hint });
    let kind = [(header::CONTENT_TYPE, message::Problem::CONTENT_TYPE)];
    (status, kind, json!(problem).to_string()).into_response()
}

impl StreamServer {
    /// Accepts a connection if there is a place.
    fn admit(self: Arc<Self>, upgrade: WebSocketUpgrade) -> Response {
        if self.places.available_permits() == 0 {
            let message = format!("this server runs at most {} streams at once, and all are in use", self.streams);
            let hint =
                Some("try again when a stream has ended, or start the server with a larger `--streams`".to_owned());
            return refuse(StatusCode::SERVICE_UNAVAILABLE, "busy", message, hint);
        }
        // A browser expects one of the subprotocols that it asked for.
        let upgrade = upgrade.protocols([coordinator::shell::STREAM_PROTOCOL]);
        let upgrade = upgrade.max_message_size(MOST_BYTES).max_frame_size(MOST_BYTES);
        upgrade.max_write_buffer_size(WRITE_BYTES).on_upgrade(move |socket| async move {
            self.converse(socket).await;
        })
    }

    async fn converse(&self, socket: WebSocket) {
        let (mut sink, source) = socket.split();
        let (sender, mut lines) = mpsc::channel(WAITING);
        let _reading = Ends(tokio::spawn(read(source, sender, self.beginning.form.clone())));
        let mut course = self.beginning.course(self.bound, self.real.clone());
        let leave = self.silent.enter();
        let first = self.first(&mut sink, &mut lines, &leave).await;
        self.silent.leave(&leave);
        let (first, _place) = match first {
            Ok(begun) => begun,
            Err(end) => return close(&mut sink, end).await,
        };
        let end = match self.give(&mut sink, &mut lines, &mut course, first).await {
            Ok(()) | Err(End::Over) => {
                let report = json!({"end": course.meter.json()}).to_string();
                let _ = send(&mut sink, report).await;
                (close_code::NORMAL, Cow::Borrowed("the stream has ended"))
            }
            Err(End::Gone) => return,
            Err(End::Close(code, why)) => (code, why),
        };
        close(&mut sink, End::Close(end.0, end.1)).await;
    }

    /// Waits for the first sentence and takes a place for it.
    async fn first(
        &self,
        sink: &mut Sink,
        lines: &mut Lines,
        leave: &Notify,
    ) -> std::result::Result<(Line, OwnedSemaphorePermit), End> {
        let silence = sleep(SILENCE);
        tokio::pin!(silence);
        let line = loop {
            let next = tokio::select! {
                next = lines.recv() => next,
                () = leave.notified() => return Err(End::Close(close_code::AGAIN, "other clients are waiting".into())),
                () = &mut silence => return Err(End::Close(close_code::POLICY, "no sentence arrived within a minute".into())),
            };
            match next {
                Some(Ok(line)) => break line,
                Some(Err(what)) => tell(sink, what).await?,
                None => return Err(End::Gone),
            }
        };
        let Ok(place) = Arc::clone(&self.places).try_acquire_owned() else {
            return Err(End::Close(close_code::AGAIN, "all streams are in use".into()));
        };
        Ok((line, place))
    }

    /// Sends frames until the client leaves.
    async fn give(
        &self,
        sink: &mut Sink,
        lines: &mut Lines,
        course: &mut super::course::Course,
        first: Line,
    ) -> std::result::Result<(), End> {
        let mut stream = self.beginning.stream.clone();
        let mut pace = Pace::new(self.rate);
        let mut next = Some(first);
        let mut text = String::new();
        loop {
            while !course.is_pinned() {
                let line = match next.take() {
                    Some(line) => Ok(line),
                    None => match self.line(lines, course.has_begun()).await? {
                        None => break,
                        Some(line) => line,
                    },
                };
                match line.and_then(|line| course.take(line, stream.root())) {
                    Ok(()) => break,
                    Err(what) => tell(sink, what).await?,
                }
            }
            let over = End::Close(close_code::ERROR, "the server is stopping".into());
            let (back, drawn) = self.engine.draw(stream, course.ask()).await.ok_or(over)?;
            stream = back;
            let (segment, took) = match drawn {
                Ok(drawn) => drawn,
                Err(what) => {
                    tell(sink, what).await?;
                    return Err(End::Close(close_code::ERROR, "the model cannot continue".into()));
                }
            };
            course.drawn(&segment, took);
            for k in 0..segment.frames {
                if course.is_over() {
                    return Err(End::Over);
                }
                sleep(pace.wait(Instant::now())).await;
                text.clear();
                course.write(&mut text, &segment, k);
                send(sink, text.clone()).await?;
                course.given(&segment, k);
                while next.is_none() && !course.is_pinned() {
                    match lines.try_recv() {
                        Ok(Ok(line)) => next = Some(line),
                        Ok(Err(what)) => tell(sink, what).await?,
                        Err(TryRecvError::Empty) => break,
                        Err(TryRecvError::Disconnected) => return Err(End::Gone),
                    }
                }
                if next.is_some() && !course.is_pinned() {
                    stream.cut(k + 1);
                    break;
                }
            }
        }
    }

    /// Returns a line that has arrived, or waits for the first one; `None` if the sentence continues.
    async fn line(
        &self,
        lines: &mut Lines,
        begun: bool,
    ) -> std::result::Result<Option<std::result::Result<Line, String>>, End> {
        if begun {
            return match lines.try_recv() {
                Ok(line) => Ok(Some(line)),
                Err(TryRecvError::Empty) => Ok(None),
                Err(TryRecvError::Disconnected) => Err(End::Gone),
            };
        }
        match timeout(SILENCE, lines.recv()).await {
            Ok(Some(line)) => Ok(Some(line)),
            Ok(None) => Err(End::Gone),
            Err(_) => Err(End::Close(close_code::POLICY, "no sentence arrived within a minute".into())),
        }
    }
}
