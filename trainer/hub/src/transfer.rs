//! Transfer of one file over HTTP, which a later attempt or another process continues.
//!
//! The bytes are in a file beside their place, and the identity that the server gave them (`ETag`) in another. An
//! attempt asks for the rest of these bytes (`Range`, `If-Range`). A server that sends all of them makes it start again.
//! A transfer is complete only if the server ended it as announced; the caller checks the content.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use protocol::Digest;
use reqwest::blocking::{Client, ClientBuilder, Response};
use reqwest::header::{CONTENT_RANGE, ETAG, HeaderMap, IF_RANGE, RANGE, RETRY_AFTER};
use reqwest::{StatusCode, Url};

/// Time limit for connecting.
const CONNECT: Duration = Duration::from_secs(10);
/// Time limit for each read.
const SILENCE: Duration = Duration::from_secs(60);
/// Number of attempts in a row that may bring no new bytes.
const ATTEMPTS: u32 = 4;
/// Longest pause that a server may ask for.
const PATIENCE: Duration = Duration::from_secs(60);

/// A file to transfer.
pub(crate) struct Wanted<'a> {
    pub(crate) url: Url,
    /// Token for the first host; not sent to another one.
    pub(crate) token: Option<&'a str>,
    /// Largest accepted size, in bytes.
    pub(crate) most: u64,
    /// True if the address always has the same bytes, so that those of any earlier attempt fit.
    pub(crate) fixed: bool,
    /// Pause after the first failed attempt; each later one doubles it.
    pub(crate) pause: Duration,
}

/// Reason for an incomplete transfer.
#[derive(Debug)]
pub(crate) enum Interrupted {
    /// The server cannot be reached, or stopped sending; the same transfer may succeed later.
    Away(String),
    /// The server refuses the request.
    Refused(StatusCode),
    /// The file has more bytes than accepted.
    TooLarge,
    /// The disk refuses the bytes.
    Io(PathBuf, std::io::Error),
}

/// Bytes that have arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrived {
    /// Number of bytes, with those of earlier attempts.
    pub bytes: u64,
    /// Size of the file, if the server announces it.
    pub of: Option<u64>,
}

/// Builds a client whose time limits apply to each read, not to the whole transfer.
pub(crate) fn client(of: impl FnOnce(ClientBuilder) -> ClientBuilder) -> Result<Client, String> {
    access::tls::install_provider();
    let builder = Client::builder().connect_timeout(CONNECT).timeout(SILENCE).user_agent("stride");
    of(builder).build().map_err(|error| chain(&error))
}

/// An error with its causes.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(error.source(), |cause| cause.source());
    causes.fold(error.to_string(), |said, cause| format!("{said}: {cause}"))
}

/// Transfers the file to `part`, after the bytes that are already there.
///
/// # Errors
/// If the last attempts brought nothing new. `part` then has the bytes to continue from.
pub(crate) fn transfer(
    client: &Client,
    wanted: &Wanted<'_>,
    part: &Path,
    arrived: &mut dyn FnMut(Arrived),
) -> Result<(), Interrupted> {
    let mut most = 0;
    let mut failed = 0;
    let mut pause = wanted.pause;
    loop {
        let Err(Failed { why, after }) = attempt(client, wanted, part, arrived) else { return Ok(()) };
        let bytes = length(part);
        failed = if bytes > most { 1 } else { failed + 1 };
        pause = if bytes > most { wanted.pause } else { pause * 2 };
        most = most.max(bytes);
        if failed >= ATTEMPTS || !matches!(why, Interrupted::Away(_)) {
            return Err(why);
        }
        std::thread::sleep(after.unwrap_or(pause).min(PATIENCE));
    }
}

/// Removes a part and the identity of its bytes.
pub(crate) fn discard(part: &Path) {
    // A part that cannot be removed is overwritten by the next attempt, which reports why it cannot.
    let _ = (fs::remove_file(part), fs::remove_file(identity_file(part)));
}

/// The SHA-256 of a file in hexadecimal.
pub(crate) fn file_sha256(file: &Path) -> std::io::Result<String> {
    Ok(Digest::of_all(&mut File::open(file)?)?.0.hex())
}

fn length(part: &Path) -> u64 {
    // A part that is missing has no bytes.
    fs::metadata(part).map_or(0, |found| found.len())
}

fn identity_file(part: &Path) -> PathBuf {
    let mut name = part.as_os_str().to_owned();
    name.push(".etag");
    name.into()
}

/// Reason for the end of an attempt.
struct Failed {
    why: Interrupted,
    /// Pause that the server asks for.
    after: Option<Duration>,
}

impl From<Interrupted> for Failed {
    fn from(why: Interrupted) -> Self {
        Self { why, after: None }
    }
}

fn away(why: impl Into<String>) -> Failed {
    Interrupted::Away(why.into()).into()
}

fn io(path: &Path) -> impl Fn(std::io::Error) -> Failed + '_ {
    |error| Interrupted::Io(path.to_owned(), error).into()
}

/// Asks once for the bytes that are missing, and appends them.
fn attempt(client: &Client, wanted: &Wanted<'_>, part: &Path, arrived: &mut dyn FnMut(Arrived)) -> Result<(), Failed> {
    let have = length(part);
    let known = fs::read_to_string(identity_file(part)).ok().filter(|_| have > 0);
    let mut request = client.get(wanted.url.clone());
    if let Some(token) = wanted.token {
        request = request.bearer_auth(token);
    }
    let continues = have > 0 && (wanted.fixed || known.is_some());
    if continues {
        request = request.header(RANGE, format!("bytes={have}-"));
        if let Some(tag) = known.filter(|_| !wanted.fixed) {
            request = request.header(IF_RANGE, tag);
        }
    }
    let response = request.send().map_err(|error| away(chain(&error)))?;
    let start = match response.status() {
        StatusCode::PARTIAL_CONTENT if continues && range_start(response.headers()) == Some(have) => have,
        StatusCode::RANGE_NOT_SATISFIABLE if continues && whole_size(response.headers()) == Some(have) => return Ok(()),
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            discard(part);
            return Err(away("the server has other bytes than before"));
        }
        status if status.is_success() => 0,
        status if status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS => {
            let after = response.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
            let why = Interrupted::Away(format!("the server answered {status}"));
            return Err(Failed { why, after: after.map(Duration::from_secs) });
        }
        status => return Err(Interrupted::Refused(status).into()),
    };
    append(response, wanted, part, start, arrived)
}

/// First byte of an answer's range.
fn range_start(headers: &HeaderMap) -> Option<u64> {
    let range = headers.get(CONTENT_RANGE)?.to_str().ok()?.strip_prefix("bytes ")?;
    range.split_once('-')?.0.parse().ok()
}

/// Size of the file in a refusal of a range: `bytes */SIZE`.
fn whole_size(headers: &HeaderMap) -> Option<u64> {
    headers.get(CONTENT_RANGE)?.to_str().ok()?.strip_prefix("bytes */")?.parse().ok()
}

/// The identity of the bytes, if a later request may depend on it.
fn strong_tag(headers: &HeaderMap) -> Option<&str> {
    headers.get(ETAG)?.to_str().ok().filter(|tag| tag.starts_with('"') && tag.len() <= 256)
}

/// Writes the body of an answer from byte `start` of the part.
fn append(
    mut response: Response,
    wanted: &Wanted<'_>,
    part: &Path,
    start: u64,
    arrived: &mut dyn FnMut(Arrived),
) -> Result<(), Failed> {
    let of = response.content_length().map(|rest| rest.saturating_add(start));
    if of.is_some_and(|bytes| bytes > wanted.most) {
        return Err(Interrupted::TooLarge.into());
    }
    let mut file = opened(part, start, strong_tag(response.headers())).map_err(io(part))?;
    let mut bytes = start;
    let mut piece = vec![0; 256 << 10];
    arrived(Arrived { bytes, of });
    loop {
        let count = match response.read(&mut piece) {
            Ok(0) => break,
            Ok(count) => count,
            Err(error) => return Err(away(format!("the transfer ended after {bytes} bytes: {}", chain(&error)))),
        };
        if bytes + count as u64 > wanted.most {
            return Err(Interrupted::TooLarge.into());
        }
        file.write_all(&piece[..count]).map_err(io(part))?;
        bytes += count as u64;
        arrived(Arrived { bytes, of });
    }
    if let Some(of) = of.filter(|of| *of != bytes) {
        return Err(away(format!("the transfer ended after {bytes} of {of} bytes")));
    }
    file.sync_all().map_err(io(part))
}

/// Opens the part at `start`. A part that begins anew is emptied before the identity of its bytes changes.
fn opened(part: &Path, start: u64, tag: Option<&str>) -> std::io::Result<File> {
    let mut file = OpenOptions::new().create(true).write(true).truncate(start == 0).open(part)?;
    if start > 0 {
        file.seek(SeekFrom::Start(start))?;
        return Ok(file);
    }
    match tag {
        Some(tag) => fs::write(identity_file(part), tag)?,
        None => match fs::remove_file(identity_file(part)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error),
            _ => {}
        },
    }
    Ok(file)
}
