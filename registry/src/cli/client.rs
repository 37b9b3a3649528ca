//! Runs a command where it can be run: at the server that is named, here if it only reads or nobody holds the store, else at
//! the holder.

use std::path::Path;
use std::time::{Duration, Instant};

use access::{ConnectError, Server, ServerOptions, explain};
use checkpoint::published::Layout;
use protocol::message::ApiError;
use protocol::{Digest, ModelName, Owner};
use reqwest::header::CONTENT_LENGTH;
use reqwest::{Body, Method, Response};
use tokio::io::AsyncReadExt as _;

use super::args::Asked;
use super::export::{self, Source};
use super::{Answer, Command, Data, OutputArg, Verb, bundles, error, print, read, run};
use crate::{Holder, OpenError, ReadStore, Store};

/// How long to wait for a holder without an address, such as another `registry` command, to end or to get one.
const PATIENCE: Duration = Duration::from_secs(5);
const BETWEEN: Duration = Duration::from_millis(50);

/// Runs a verb on the store in `dir`, or at the server of `options`, and prints the answer; returns the exit code.
pub async fn execute(verb: Verb, dir: &Path, options: &ServerOptions, output: OutputArg) -> u8 {
    let (output, file) = output.split();
    let answer = match verb.asks(file) {
        Err(why) => Answer::refused(error("invalid", why, Some("`registry help` shows how commands are written"))),
        Ok(asked) => answer(asked, dir, options).await,
    };
    // A closed pipe (`| head`) is no failure of the command.
    let _ = print::show(&answer, output);
    answer.exit
}

async fn answer(asked: Asked, dir: &Path, options: &ServerOptions) -> Answer {
    match asked {
        Asked::Command(command) => ask(command, dir, options).await,
        Asked::Export { model, dir: into, layout } => {
            let to = layout.map_or(Destination::Folder(&into), |layout| Destination::Weights(&into, layout));
            with(dir, options, Need::Read, async |place| export_to(place, &model, to).await).await
        }
        Asked::Bundle { model, file } => {
            with(dir, options, Need::Read, async |place| export_to(place, &model, Destination::Bundle(&file)).await)
                .await
        }
        Asked::Import { file, model } => {
            with(dir, options, Need::Make, async |place| import(place, &file, model.as_deref()).await).await
        }
        Asked::Backup { dir: into } => match local(options, "a backup is made on the machine of the store") {
            Ok(()) => backup(dir, &into).await,
            Err(refused) => *refused,
        },
        Asked::Adopt { blobs } => adopt(dir, blobs.as_ref(), options).await,
        Asked::Restore { backup, to, blobs } => match crate::backup::restore(&backup, &to, blobs.as_ref()).await {
            Ok(summary) => Answer::done(Data::Restored { summary, dir: to }),
            Err(e) => Answer::from(e),
        },
    }
}

/// Runs a command on the store in `dir`, or at the server of `options`.
pub async fn ask(command: Command, dir: &Path, options: &ServerOptions) -> Answer {
    with(dir, options, command.need(), async |place| place.ask(&command).await).await
}

/// What a place must be good for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Need {
    Read,
    Collect,
    Write,
    /// A store that is made if there is none.
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

/// Refuses what can only be done where the store's folder is, if a server is named.
fn local(options: &ServerOptions, why: &str) -> Result<(), Box<Answer>> {
    match options.connect() {
        Ok(None) => Ok(()),
        Ok(Some(_)) => {
            let hint = "run it there with `--store DIR`, and without a server";
            Err(Box::new(Answer::refused(error("invalid", why, Some(hint)))))
        }
        Err(e) => Err(Box::new(refused(&e))),
    }
}

/// Only here: a store that is not whole has no server.
async fn adopt(dir: &Path, blobs: Option<&crate::Place>, options: &ServerOptions) -> Answer {
    if let Err(refused) = local(options, "a store is adopted on its machine") {
        return *refused;
    }
    match Store::adopt(dir, blobs, Holder::this_process("registry adopt")).await {
        Ok(store) => Answer::done(Data::Adopted { store: store.id().clone() }),
        Err(e) => Answer::from(&e),
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

/// Where commands are run.
enum Place {
    Here(Box<Store>),
    Reading(ReadStore),
    At(Server),
}

/// Why a holder did not do what it was asked.
enum Missed {
    /// It was not reached at all, so nothing was done.
    NotThere(String),
    /// It may or may not have been done.
    Broken(String),
}

impl Place {
    async fn ask(&self, command: &Command) -> Result<Answer, Missed> {
        match self {
            Self::Here(store) => Ok(run(command.clone(), store, &user()).await),
            Self::Reading(store) => Ok(read(command.clone(), store).await),
            Self::At(server) => {
                let sent = server.request(Method::POST, "/v1/registry").json(command).send().await;
                match check(sent).await? {
                    Ok(response) => response.json().await.map_err(|e| Missed::Broken(explain(&e))),
                    Err(refused) => Ok(Answer::refused(refused)),
                }
            }
        }
    }
}

/// The answer, or what was refused.
async fn check(sent: Result<Response, reqwest::Error>) -> Result<Result<Response, ApiError>, Missed> {
    let response =
        sent.map_err(|e| if e.is_connect() { Missed::NotThere(explain(&e)) } else { Missed::Broken(explain(&e)) })?;
    let status = response.status();
    if status.is_success() {
        return Ok(Ok(response));
    }
    let body = response.bytes().await.unwrap_or_default();
    Ok(Err(serde_json::from_slice(&body).unwrap_or_else(|_| {
        error("internal", format!("it answered {status}: {}", String::from_utf8_lossy(&body)), None)
    })))
}

/// Finds the place for `work`, and waits where it is about to be free. Work that only reads needs nobody to be free.
async fn with(
    dir: &Path,
    options: &ServerOptions,
    need: Need,
    work: impl AsyncFn(&Place) -> Result<Answer, Missed>,
) -> Answer {
    let internal = |_| Answer::refused(error("internal", "the store did not answer", None));
    match options.connect() {
        Ok(None) => {}
        Ok(Some(server)) => {
            let url = server.url().to_owned();
            return work(&Place::At(server)).await.unwrap_or_else(|missed| {
                let (Missed::NotThere(why) | Missed::Broken(why)) = missed;
                unreachable_(&format!("cannot reach `{url}`: {why}"))
            });
        }
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
                    // It may be ending, and the store be free in a moment.
                    Err(Missed::NotThere(why)) => format!("{busy}, which does not answer: {why}"),
                    Err(Missed::Broken(why)) => {
                        return unreachable_(&format!("{busy}, whose answer could not be read: {why}"));
                    }
                }
            }
            None => format!("{busy}, which takes no requests"),
        };
        if Instant::now() >= until {
            return unreachable_(&problem);
        }
        tokio::time::sleep(BETWEEN).await;
    }
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
        Some("wait for it to end, or see whether it hangs; then run the same command again"),
    ))
}

/// Where a version's files go.
#[derive(Clone, Copy)]
enum Destination<'a> {
    Folder(&'a Path),
    /// The weights alone, as others write them.
    Weights(&'a Path, Layout),
    Bundle(&'a Path),
}

async fn export_to(place: &Place, model: &str, to: Destination<'_>) -> Result<Answer, Missed> {
    let shown = place.ask(&Command::Show { reference: model.to_owned() }).await?;
    let Some(data) = shown.data else { return Ok(shown) };
    let Data::Version { version, .. } = data else {
        let hint = "say MODEL@best or MODEL:VERSION";
        return Ok(Answer::refused(error("invalid", format!("`{model}` is no one version"), Some(hint))));
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

/// Has a bundle of this machine registered where the store is.
async fn import(place: &Place, file: &Path, model: Option<&str>) -> Result<Answer, Missed> {
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
            match check(request.body(Body::wrap_stream(pieces(file))).send().await).await? {
                Ok(response) => {
                    let mut answer: Answer = response.json().await.map_err(|e| Missed::Broken(explain(&e)))?;
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

/// A file's bytes, piece by piece.
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
                let lost = |missed| {
                    let (Missed::NotThere(why) | Missed::Broken(why)) = missed;
                    error(
                        "unreachable",
                        format!("blob {digest} did not come whole from `{}`: {why}", server.url()),
                        None,
                    )
                };
                let sent = server.request(Method::GET, &format!("/v1/blobs/{digest}")).send().await;
                let mut response = check(sent).await.map_err(lost)??;
                while let Some(part) = response.chunk().await.map_err(|e| lost(Missed::Broken(explain(&e))))? {
                    into(&part).map_err(unwritten)?;
                }
                Ok(())
            }
        }
    }
}

/// Gives the parts of a blob of this machine to `into`.
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

/// Who moves an alias of a store that nobody serves; a server writes down whose token it was.
fn user() -> String {
    let named =
        ["USER", "LOGNAME"].into_iter().find_map(|name| std::env::var(name).ok().filter(|user| !user.is_empty()));
    named.unwrap_or_else(|| "unknown".into())
}
