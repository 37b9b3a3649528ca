//! Chooses where a command runs. A given server runs it. Otherwise this process does if the command only reads or the
//! store is free; else the store's holder does.

use std::path::Path;
use std::time::{Duration, Instant};

use access::{ConnectError, Server, ServerOptions, explain};
use checkpoint::published::Layout;
use protocol::message::ApiError;
use protocol::{Digest, ModelName, Owner};
use reqwest::header::CONTENT_LENGTH;
use reqwest::{Body, Method, Response};
use tokio::io::AsyncReadExt as _;

use super::answer::error;
use super::args::Operation;
use super::export::{self, Source};
use super::{Answer, Command, Data, OutputArg, Verb, bundles, print, read, run};
use crate::catalog::CatalogPlace;
use crate::migrate::{self, MoveError};
use crate::{Holder, OpenError, ReadStore, Store};

/// Time to wait for a holder without an address, such as another `registry` command.
const PATIENCE: Duration = Duration::from_secs(5);
const BETWEEN: Duration = Duration::from_millis(50);

/// Runs a verb on the store in `dir`, or at the server of `options`, prints the answer and returns the exit code.
pub async fn execute(verb: Verb, dir: &Path, options: &ServerOptions, output: OutputArg) -> u8 {
    let (output, file) = output.split();
    let answer = match verb.operation(file) {
        Err(why) => Answer::refused(error("invalid", why, Some("`registry help` shows the syntax"))),
        Ok(operation) => answer(operation, dir, options).await,
    };
    // A closed pipe (`| head`) is not an error.
    let _ = print::show(&answer, output);
    answer.exit
}

async fn answer(operation: Operation, dir: &Path, options: &ServerOptions) -> Answer {
    match operation {
        Operation::Command(command) => ask(command, dir, options).await,
        Operation::Export { model, dir: into, layout } => {
            let to = layout.map_or(Destination::Folder(&into), |layout| Destination::Weights(&into, layout));
            with(dir, options, Need::Read, async |place| export_to(place, &model, to).await).await
        }
        Operation::Bundle { model, file } => {
            with(dir, options, Need::Read, async |place| export_to(place, &model, Destination::Bundle(&file)).await)
                .await
        }
        // A new store is created only for a file that exists.
        Operation::Import { file, .. } if !file.exists() => bundles::no_such_file(&file.display().to_string()),
        Operation::Import { file, model } => {
            with(dir, options, Need::Make, async |place| import(place, &file, model.as_deref()).await).await
        }
        Operation::Backup { dir: into } => match local(options, "a backup is made on the machine of the store") {
            Ok(()) => backup(dir, &into).await,
            Err(refused) => *refused,
        },
        Operation::Adopt { blobs } => adopt(dir, blobs.as_ref(), options).await,
        Operation::Migrate { from, to } => match local(options, "a catalog is moved on the machine of the store") {
            Ok(()) => migrate(from, to).await,
            Err(refused) => *refused,
        },
        Operation::Restore { backup, to, blobs } => match crate::backup::restore(&backup, &to, blobs.as_ref()).await {
            Ok(summary) => Answer::done(Data::Restored { summary, dir: to }),
            Err(e) => Answer::from(e),
        },
    }
}

/// Runs a command on the store in `dir`, or at the server of `options`.
pub async fn ask(command: Command, dir: &Path, options: &ServerOptions) -> Answer {
    with(dir, options, command.need(), async |place| place.ask(&command).await).await
}

/// Access that a command needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Need {
    Read,
    Collect,
    Write,
    /// A store that is created if missing.
    Make,
}

impl Command {
    fn need(&self) -> Need {
        match self {
            command if command.only_reads() => Need::Read,
            Self::Gc { .. } => Need::Collect,
            _ => Need::Write,
        }
    }
}

/// Refuses a command that needs the store's folder if a server is given.
fn local(options: &ServerOptions, why: &str) -> Result<(), Box<Answer>> {
    match options.connect() {
        Ok(None) => Ok(()),
        Ok(Some(_)) => {
            let hint = "run it there with `--store DIR`, without --server and STRIDE_SERVER";
            Err(Box::new(Answer::refused(error("invalid", why, Some(hint)))))
        }
        Err(e) => Err(Box::new(refused(&e))),
    }
}

/// Runs only on this machine: a store that needs repair has no server.
async fn adopt(dir: &Path, blobs: Option<&crate::Place>, options: &ServerOptions) -> Answer {
    if let Err(refused) = local(options, "a store is adopted on its machine") {
        return *refused;
    }
    match Store::adopt(dir, blobs, Holder::this_process("registry adopt")).await {
        Ok(store) => Answer::done(Data::Adopted { store: store.id().clone() }),
        Err(e) => Answer::from(&e),
    }
}

async fn migrate(from: CatalogPlace, to: CatalogPlace) -> Answer {
    let names = (from.to_string(), to.to_string());
    let holder = Holder::this_process("registry migrate");
    let moved = match (&from, &to) {
        (CatalogPlace::Folder(dir), CatalogPlace::Postgres(address)) => {
            migrate::to_postgres(dir, address, holder).await
        }
        (CatalogPlace::Postgres(address), CatalogPlace::Folder(dir)) => migrate::to_folder(address, dir, holder).await,
        _ => {
            let hint = Some("name the store's folder and an address `postgres://...`");
            return Answer::refused(error("invalid", "a catalog moves between a folder and PostgreSQL", hint));
        }
    };
    match moved {
        Ok(rows) => Answer::done(Data::Migrated { from: names.0, to: names.1, rows }),
        Err(MoveError::Open(e)) => Answer::from(&e),
        Err(MoveError::Query(e)) => Answer::from(e),
        Err(e @ MoveError::Refused(_)) => Answer::refused(error("conflict", e, None)),
    }
}

async fn backup(dir: &Path, into: &Path) -> Answer {
    let store = match ReadStore::open(dir).await {
        Ok(store) => store,
        Err(e) => return Answer::from(&e),
    };
    match store.backup(into).await {
        Ok(summary) => Answer::done(Data::BackedUp { summary, dir: into.to_owned() }),
        Err(e) => Answer::from(e),
    }
}

/// The place where a command runs.
enum Place {
    Here(Box<Store>),
    Reading(ReadStore),
    At(Server),
}

/// Reason why a holder did not answer.
enum CallError {
    /// The connection failed, so nothing was done.
    Unreachable(String),
    /// The command may have been done.
    Incomplete(String),
}

impl Place {
    async fn ask(&self, command: &Command) -> Result<Answer, CallError> {
        match self {
            Self::Here(store) => Ok(run(command.clone(), store, &user()).await),
            Self::Reading(store) => Ok(read(command.clone(), store).await),
            Self::At(server) => {
                let sent = server.send(server.request(Method::POST, "/v1/registry").json(command)).await;
                match check(sent).await? {
                    Ok(response) => response.json().await.map_err(|e| CallError::Incomplete(explain(&e))),
                    Err(refused) => Ok(Answer::refused(refused)),
                }
            }
        }
    }
}

/// Returns the response, or the server's error.
async fn check(sent: Result<Response, reqwest::Error>) -> Result<Result<Response, ApiError>, CallError> {
    let response = sent.map_err(|e| {
        if e.is_connect() { CallError::Unreachable(explain(&e)) } else { CallError::Incomplete(explain(&e)) }
    })?;
    let status = response.status();
    if status.is_success() {
        return Ok(Ok(response));
    }
    let body = response.bytes().await.unwrap_or_default();
    Ok(Err(serde_json::from_slice(&body).unwrap_or_else(|_| {
        error("internal", format!("it answered {status}: {}", String::from_utf8_lossy(&body)), None)
    })))
}

/// Opens the store or connects to its holder for `work`, and waits briefly if the store is about to be free. Read-only
/// work needs no free store.
async fn with(
    dir: &Path,
    options: &ServerOptions,
    need: Need,
    work: impl AsyncFn(&Place) -> Result<Answer, CallError>,
) -> Answer {
    let internal = |_| Answer::refused(error("internal", "the store did not answer", None));
    match options.connect() {
        Ok(None) => {}
        Ok(Some(server)) => return at_server(server, work).await,
        Err(e) => return refused(&e),
    }
    if need == Need::Read {
        return match ReadStore::open(dir).await {
            Ok(store) => work(&Place::Reading(store)).await.unwrap_or_else(internal),
            Err(e) => Answer::from(&e),
        };
    }
    let until = Instant::now() + PATIENCE;
    loop {
        let holder = Holder::this_process("registry");
        let opened = match need {
            Need::Collect => Store::open_to_collect(dir, holder).await,
            Need::Make => Store::open(dir, holder).await,
            Need::Read | Need::Write => Store::open_existing(dir, holder).await,
        };
        let busy = match opened {
            Ok(store) => {
                return work(&Place::Here(Box::new(store))).await.unwrap_or_else(internal);
            }
            Err(e) => e,
        };
        let OpenError::Busy { holder, .. } = &busy else { return Answer::from(&busy) };
        let problem = match &holder.address {
            Some(address) => {
                let server = match options.holder(dir, address) {
                    Ok(server) => server,
                    Err(e) => return refused(&e),
                };
                match work(&Place::At(server)).await {
                    Ok(answer) => return answer,
                    // The holder may be ending, and the store may be free soon.
                    Err(CallError::Unreachable(why)) => format!("{busy}, which does not answer: {why}"),
                    Err(CallError::Incomplete(why)) => {
                        return unreachable_(&format!("{busy}, whose answer could not be read: {why}"));
                    }
                }
            }
            None => format!("{busy}, which accepts no requests"),
        };
        if Instant::now() >= until {
            return unreachable_(&problem);
        }
        tokio::time::sleep(BETWEEN).await;
    }
}

async fn at_server(server: Server, work: impl AsyncFn(&Place) -> Result<Answer, CallError>) -> Answer {
    let url = server.url().to_owned();
    work(&Place::At(server)).await.unwrap_or_else(|failed| {
        let (CallError::Unreachable(why) | CallError::Incomplete(why)) = failed;
        Answer::refused(error("unreachable", format!("cannot reach `{url}`: {why}"), Some(access::UNREACHABLE)))
    })
}

fn refused(e: &ConnectError) -> Answer {
    match e {
        ConnectError::Holder { .. } => Answer::refused(error("unauthorized", e, None)),
        _ => Answer::refused(error("invalid", e, e.advice())),
    }
}

fn unreachable_(message: &str) -> Answer {
    Answer::refused(error(
        "unreachable",
        message,
        Some("wait for it to end, or check if it hangs; then run the same command again"),
    ))
}

/// Target of an export.
#[derive(Clone, Copy)]
enum Destination<'a> {
    Folder(&'a Path),
    /// The weights alone, in a layout of published code.
    Weights(&'a Path, Layout),
    Bundle(&'a Path),
}

async fn export_to(place: &Place, model: &str, to: Destination<'_>) -> Result<Answer, CallError> {
    let shown = place.ask(&Command::Show { reference: model.to_owned() }).await?;
    let Some(data) = shown.data else { return Ok(shown) };
    let Data::Version { version, .. } = data else {
        let hint = "use MODEL@best or MODEL:VERSION";
        return Ok(Answer::refused(error("invalid", format!("`{model}` does not name a single version"), Some(hint))));
    };
    let (written, to) = match to {
        Destination::Folder(dir) => (export::export(place, &version, dir).await.map(|files| (files, Vec::new())), dir),
        Destination::Weights(dir, layout) => (export::weights(place, &version, dir, layout).await, dir),
        Destination::Bundle(file) => {
            (bundles::export(place, &version, file).await.map(|files| (files, Vec::new())), file)
        }
    };
    Ok(match written {
        Ok((files, left_out)) => Answer::done(Data::Exported { version, dir: to.to_owned(), files, left_out }),
        Err(error) => Answer::refused(error),
    })
}

/// Imports a bundle of this machine into the store.
async fn import(place: &Place, file: &Path, model: Option<&str>) -> Result<Answer, CallError> {
    let shown = file.display().to_string();
    match place {
        Place::Here(store) => {
            let owner = Owner { admin: true, ..Owner::default() };
            Ok(bundles::import(store, file, &shown, model, owner).await)
        }
        Place::Reading(_) => Ok(Answer::refused(error("internal", "the store was opened for reading", None))),
        Place::At(server) => {
            let opened = async {
                let file = tokio::fs::File::open(file).await?;
                let bytes = file.metadata().await?.len();
                Ok::<_, std::io::Error>((file, bytes))
            };
            let (file, bytes) = match opened.await {
                Ok(opened) => opened,
                Err(e) => return Ok(Answer::refused(error("invalid", format!("`{shown}`: {e}"), None))),
            };
            let path = match model.map(str::parse::<ModelName>).transpose() {
                Ok(None) => "/v1/bundles".to_owned(),
                Ok(Some(model)) => format!("/v1/bundles?model={model}"),
                Err(e) => {
                    return Ok(Answer::refused(error("invalid", e, Some("`--model NAME` gives it another name"))));
                }
            };
            let request = server.request(Method::POST, &path).header(CONTENT_LENGTH, bytes);
            let sent = server.send(request.body(Body::wrap_stream(pieces(file)))).await;
            match check(sent).await? {
                Ok(response) => {
                    let mut answer: Answer = response.json().await.map_err(|e| CallError::Incomplete(explain(&e)))?;
                    if let Some(error) = &mut answer.error {
                        // The server does not know the file's name.
                        error.message = error.message.replacen("`bundle`", &format!("`{shown}`"), 1);
                    }
                    if let Some(Data::Imported { file, .. }) = &mut answer.data {
                        *file = shown;
                    }
                    Ok(answer)
                }
                Err(refused) => Ok(Answer::refused(refused)),
            }
        }
    }
}

/// Streams a file in pieces.
fn pieces(file: tokio::fs::File) -> impl futures::Stream<Item = std::io::Result<Vec<u8>>> {
    futures::stream::try_unfold(file, async |mut file| {
        let mut piece = vec![0; 1 << 18];
        let count = file.read(&mut piece).await?;
        piece.truncate(count);
        Ok((count > 0).then_some((piece, file)))
    })
}

impl Source for Place {
    async fn fetch(&self, digest: Digest, into: &mut impl FnMut(&[u8]) -> std::io::Result<()>) -> Result<(), ApiError> {
        let unwritten = |e: std::io::Error| error("storage", e, None);
        match self {
            Self::Here(store) => pass(store.blobs().read(digest), into),
            Self::Reading(store) => pass(store.blobs().read(digest), into),
            Self::At(server) => {
                let lost = |failed| {
                    let (CallError::Unreachable(why) | CallError::Incomplete(why)) = failed;
                    error(
                        "unreachable",
                        format!("blob {digest} was not received completely from `{}`: {why}", server.url()),
                        None,
                    )
                };
                let sent = server.send(server.request(Method::GET, &format!("/v1/blobs/{digest}"))).await;
                let mut response = check(sent).await.map_err(lost)??;
                while let Some(part) = response.chunk().await.map_err(|e| lost(CallError::Incomplete(explain(&e))))? {
                    into(&part).map_err(unwritten)?;
                }
                Ok(())
            }
        }
    }
}

/// Passes the parts of a local blob to `into`.
fn pass(
    reader: Result<crate::blob::Reader, checkpoint::BlobError>,
    into: &mut impl FnMut(&[u8]) -> std::io::Result<()>,
) -> Result<(), ApiError> {
    let damaged = |e: checkpoint::BlobError| error("damaged", e, Some("`registry fsck` checks the store"));
    let mut reader = reader.map_err(damaged)?;
    while let Some(part) = reader.next_part().map_err(damaged)? {
        into(&part).map_err(|e| error("storage", e, None))?;
    }
    Ok(())
}

/// Returns the user's name for the log of a store without a server; a server logs the token's name.
fn user() -> String {
    let named =
        ["USER", "LOGNAME"].into_iter().find_map(|name| std::env::var(name).ok().filter(|user| !user.is_empty()));
    named.unwrap_or_else(|| "unknown".into())
}
