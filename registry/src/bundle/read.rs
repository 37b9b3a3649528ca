//! Reads a bundle as a stream without trusting it.
//!
//! Memory is bounded by the decompressor's window and by the limit of the manifests; a [`Sink`] gets the files piece by
//! piece. A file is one entry and may be several blobs. The manifest announces the unpacked size, and each of its files
//! is read once. Reading a small archive that unpacks to endless data stops at the first byte too many.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::{Component, Path};

use checkpoint::BlobError;
use checkpoint::model::{self, Model};
use protocol::artifact::{Chunk, Role};
use protocol::digest::Hasher;
use protocol::id::is_name;
use protocol::{ArtifactKind, Digest, Manifest, limits, printable};
use serde::Deserialize;
use tar::{Archive, EntryType};
use zstd::stream::read::Decoder;

use super::format::{CARD, HEAD, MANIFEST};
use super::{Bundle, BundleError, FILES, FORMAT, Head, MANIFESTS_BYTES, TEXT_BYTES, WINDOW_LOG};

/// Bytes of one read.
const PIECE: usize = 1 << 16;
/// Limit of zeros after the archive; tar pads to records of 10 KiB.
const PADDING: u64 = 1 << 16;
/// First bytes of every zstd frame.
const MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

type Result<T> = std::result::Result<T, BundleError>;

/// Receives the blobs of a bundle's files, one after the other. `()` only verifies them.
pub trait Sink {
    /// Starts a blob of `bytes` bytes whose announced digest is `digest`.
    fn begin(&mut self, digest: Digest, bytes: u64) -> std::result::Result<(), BlobError>;
    /// Appends bytes to the blob.
    fn write(&mut self, piece: &[u8]) -> std::result::Result<(), BlobError>;
    /// Ends a blob that was verified as `digest`.
    fn end(&mut self, digest: Digest) -> std::result::Result<(), BlobError>;
}

impl Sink for () {
    fn begin(&mut self, _: Digest, _: u64) -> std::result::Result<(), BlobError> {
        Ok(())
    }

    fn write(&mut self, _: &[u8]) -> std::result::Result<(), BlobError> {
        Ok(())
    }

    fn end(&mut self, _: Digest) -> std::result::Result<(), BlobError> {
        Ok(())
    }
}

/// Reads a whole bundle and passes its files to `sink`, the manifest first. Success means that every file of the
/// manifest was passed with the listed length and digest, and that the parts form the model.
///
/// # Errors
/// Returns the first error. Files passed to the sink before it must be discarded.
pub fn read(reader: impl Read, sink: &mut impl Sink) -> Result<Bundle> {
    let mut reader = reader;
    let mut magic = [0; 4];
    reader.read_exact(&mut magic).map_err(|_| BundleError::NotABundle("it has fewer than 4 bytes".into()))?;
    if magic != MAGIC {
        return Err(BundleError::NotABundle(
            "it is not compressed with zstd; expected a file of `registry export`".into(),
        ));
    }
    let mut decoder = Decoder::new(magic.as_slice().chain(reader)).map_err(|e| unreadable(&e))?;
    decoder.window_log_max(WINDOW_LOG).map_err(|e| unreadable(&e))?;
    let mut archive = Archive::new(decoder);
    let mut reading = Reading::default();
    // Raw: extensions, which hold names of any length, appear as separate entries and are refused.
    for (number, entry) in archive.entries().map_err(|e| unreadable(&e))?.raw(true).enumerate() {
        let mut entry = entry.map_err(|e| reading.cut(&e))?;
        let name = name(number, &entry)?;
        let bytes = entry.size();
        reading.entry(number, &name, bytes, &mut entry, sink)?;
    }
    let padding = archive.into_inner();
    check_padding(padding)?;
    reading.finish()
}

/// Returns the name of an entry, which must be a regular file.
fn name<R: Read>(number: usize, entry: &tar::Entry<'_, R>) -> Result<String> {
    let bytes = entry.path_bytes();
    let shown = printable(&String::from_utf8_lossy(&bytes)).into_owned();
    let refuse = |why: &str| Err(BundleError::Entry { entry: shown.clone(), why: why.to_owned() });
    match entry.header().entry_type() {
        EntryType::Regular => {}
        EntryType::Symlink | EntryType::Link => return refuse("it is a link; expected files only"),
        EntryType::Directory => return refuse("it is a folder; expected files only"),
        EntryType::GNULongName | EntryType::GNULongLink | EntryType::XHeader | EntryType::XGlobalHeader => {
            return refuse(
                "it is an extension of the tar format; expected plain entries with names of at most 255 bytes",
            );
        }
        _ => return refuse("it is neither file nor folder; expected files only"),
    }
    let Ok(name) = std::str::from_utf8(&bytes) else { return refuse("its name is not UTF-8") };
    if let Err(why) = check_name(name) {
        return refuse(why);
    }
    if number == 0 && name != HEAD {
        return Err(BundleError::NotABundle(format!("it starts with `{shown}`; expected `{HEAD}`")));
    }
    Ok(name.to_owned())
}

/// Checks that a name stays inside the folder on every platform.
fn check_name(name: &str) -> std::result::Result<(), &'static str> {
    if name.is_empty() {
        return Err("it has no name");
    }
    if name.starts_with('/') || name.starts_with('\\') || name.contains(':') {
        return Err("its name is absolute; expected a path inside the bundle");
    }
    if name.split('/').any(|part| part == "..") {
        return Err("its name has `..`, which leads out of the bundle");
    }
    let normal = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    if !normal || name.contains('\\') || name.contains("//") || name.chars().any(char::is_control) {
        return Err("its name is not a plain path inside the bundle");
    }
    Ok(())
}

/// State of a bundle being read.
#[derive(Default)]
struct Reading {
    head: Option<Head>,
    manifest: Option<(Manifest, Model)>,
    card: Option<String>,
    /// Manifests of parts.
    parts: BTreeMap<Role, Manifest>,
    /// Bytes of the manifests so far.
    manifests: u64,
    seen: BTreeSet<String>,
}

impl Reading {
    fn entry(
        &mut self,
        number: usize,
        name: &str,
        bytes: u64,
        from: &mut impl Read,
        sink: &mut impl Sink,
    ) -> Result<()> {
        let refuse = |why: String| BundleError::Entry { entry: name.to_owned(), why };
        if !self.seen.insert(name.to_owned()) {
            return Err(refuse("it appears twice in the bundle".into()));
        }
        match (number, name) {
            (0, HEAD) => {
                self.head = Some(head(&small(name, bytes, TEXT_BYTES, from)?)?);
                Ok(())
            }
            (1, MANIFEST) => {
                let content = small(name, bytes, MANIFESTS_BYTES, from)?;
                self.manifests += bytes;
                let expected = self.head.as_ref().map(|head| head.artifact);
                let found = Digest::of(&content);
                if expected != Some(found) {
                    let expected = expected.map_or_else(|| "none".into(), |digest| digest.short());
                    return Err(refuse(format!("it has digest {}, and `{HEAD}` says {expected}", found.short())));
                }
                let manifest = manifest(name, &content)?;
                let model = Model::read(&manifest).map_err(|e| refuse(e.to_string()))?;
                check_files(&manifest, &model).map_err(refuse)?;
                sink.begin(found, bytes)?;
                sink.write(&content)?;
                sink.end(found)?;
                self.manifest = Some((manifest, model));
                Ok(())
            }
            (1, _) => Err(refuse(format!("it is the second entry; expected `{MANIFEST}`"))),
            (_, CARD) => {
                let content = small(name, bytes, TEXT_BYTES, from)?;
                let text = String::from_utf8(content).map_err(|_| refuse("it is not UTF-8".into()))?;
                self.card = Some(text);
                Ok(())
            }
            _ => self.file(name, bytes, from, sink),
        }
    }

    /// Reads a file of the manifest.
    fn file(&mut self, name: &str, bytes: u64, from: &mut impl Read, sink: &mut impl Sink) -> Result<()> {
        let refuse = |why: String| BundleError::Entry { entry: name.to_owned(), why };
        let known = self.manifest.as_ref().and_then(|(manifest, model)| Some((manifest.files.get(name)?, model)));
        let Some((entry, model)) = known else {
            return Err(refuse(format!("`{MANIFEST}` does not list it")));
        };
        if bytes != entry.bytes {
            return Err(refuse(format!("it has {bytes} bytes, and `{MANIFEST}` says {}", entry.bytes)));
        }
        let role = name.strip_suffix("/manifest.json").and_then(|role| Role::try_from(role.to_owned()).ok());
        let role = role.filter(|role| model.parts.contains_key(role));
        let mut kept = role.as_ref().map(|_| Vec::new());
        if kept.is_some() {
            self.manifests += bytes;
            if self.manifests > MANIFESTS_BYTES {
                return Err(refuse(format!("the manifests have more than {MANIFESTS_BYTES} bytes together")));
            }
        }
        let mut whole = (!entry.chunks.is_empty()).then(Hasher::default);
        let mut left = bytes;
        for blob in entry.blobs() {
            let mut also = |piece: &[u8]| {
                left -= piece.len() as u64;
                whole.iter_mut().for_each(|hasher| hasher.update(piece));
                kept.iter_mut().for_each(|kept| kept.extend_from_slice(piece));
            };
            pass(blob, from, &mut also, sink).map_err(|why| match why {
                Spoiled::Refused(e) => BundleError::from(e),
                Spoiled::Unreadable(e) => refuse(format!("it cannot be unpacked: {e}")),
                Spoiled::Cut => refuse(format!("it is truncated: {left} of its {bytes} bytes are missing")),
                Spoiled::Other(found) => refuse(other(found, blob.digest)),
            })?;
        }
        if let Some(found) = whole.map(Hasher::finish).filter(|found| *found != entry.digest) {
            return Err(refuse(other(found, entry.digest)));
        }
        if let (Some(role), Some(content)) = (role, kept) {
            self.parts.insert(role, manifest(name, &content)?);
        }
        Ok(())
    }

    /// Translates an error of the archive's next entry.
    fn cut(&self, error: &std::io::Error) -> BundleError {
        if self.seen.is_empty() {
            unreadable(error)
        } else {
            BundleError::Damaged(format!("the archive is damaged: {error}"))
        }
    }

    fn finish(self) -> Result<Bundle> {
        let head = self.head.ok_or_else(|| missing(HEAD))?;
        let (manifest, model) = self.manifest.ok_or_else(|| missing(MANIFEST))?;
        if let Some(name) = manifest.files.keys().find(|name| !self.seen.contains(*name)) {
            return Err(missing(name));
        }
        // The model is assembled again from the parts' own manifests and compared.
        let whole = model::assemble(&model.generator, model.format, &self.parts);
        let whole = whole.map_err(|e| BundleError::Damaged(format!("its parts form no model: {e}")))?;
        let made = Model::read(&whole).map_err(|e| BundleError::Damaged(e.to_string()))?;
        if whole.files != manifest.files || made.parts != model.parts {
            let why = format!("the files of `{MANIFEST}` are not those that the manifests of its parts list");
            return Err(BundleError::Damaged(why));
        }
        Ok(Bundle { head, manifest, card: self.card })
    }
}

/// Reason why a blob of an entry was not passed.
enum Spoiled {
    /// By the sink.
    Refused(BlobError),
    Unreadable(std::io::Error),
    Cut,
    /// Its bytes hash to this digest.
    Other(Digest),
}

fn other(found: Digest, expected: Digest) -> String {
    format!("its bytes hash to {}, and `{MANIFEST}` says {}", found.short(), expected.short())
}

/// Passes the next bytes of an entry as one blob to `sink`, and each piece to `also`.
fn pass(
    blob: Chunk,
    from: &mut impl Read,
    also: &mut impl FnMut(&[u8]),
    sink: &mut impl Sink,
) -> std::result::Result<(), Spoiled> {
    sink.begin(blob.digest, blob.bytes).map_err(Spoiled::Refused)?;
    let mut hasher = Hasher::default();
    let mut piece = vec![0; PIECE];
    let mut left = blob.bytes;
    while left > 0 {
        let most = usize::try_from(left).unwrap_or(PIECE).min(PIECE);
        let count = match from.read(&mut piece[..most]) {
            Ok(0) => return Err(Spoiled::Cut),
            Ok(count) => count,
            Err(e) => return Err(Spoiled::Unreadable(e)),
        };
        left -= count as u64;
        hasher.update(&piece[..count]);
        sink.write(&piece[..count]).map_err(Spoiled::Refused)?;
        also(&piece[..count]);
    }
    match hasher.finish() {
        found if found == blob.digest => sink.end(blob.digest).map_err(Spoiled::Refused),
        found => Err(Spoiled::Other(found)),
    }
}

/// Reads a small entry into memory.
fn small(name: &str, bytes: u64, most: u64, from: &mut impl Read) -> Result<Vec<u8>> {
    let refuse = |why: String| BundleError::Entry { entry: name.to_owned(), why };
    if bytes > most {
        return Err(refuse(format!("it has {bytes} bytes; expected at most {most}")));
    }
    let mut content = Vec::new();
    from.take(bytes).read_to_end(&mut content).map_err(|e| refuse(format!("it cannot be unpacked: {e}")))?;
    if content.len() as u64 != bytes {
        return Err(refuse(format!(
            "it is truncated: {} of its {bytes} bytes are missing",
            bytes - content.len() as u64
        )));
    }
    Ok(content)
}

fn missing(name: &str) -> BundleError {
    BundleError::Damaged(format!("the bundle has no `{name}`: it is truncated or not a bundle"))
}

fn malformed_head(error: serde_json::Error) -> BundleError {
    BundleError::Entry { entry: HEAD.into(), why: format!("it cannot be parsed: {error}") }
}

fn head(content: &[u8]) -> Result<Head> {
    #[derive(Deserialize)]
    struct Format {
        format: u64,
    }
    let Format { format } = serde_json::from_slice(content).map_err(malformed_head)?;
    if format != u64::from(FORMAT) {
        return Err(BundleError::Newer { found: format });
    }
    let head: Head = serde_json::from_slice(content).map_err(malformed_head)?;
    if !is_name(head.model.as_str()) {
        let why = format!("`model` is {:?}, which is not a model name", printable(head.model.as_str()));
        return Err(BundleError::Entry { entry: HEAD.into(), why });
    }
    Ok(head)
}

fn manifest(name: &str, content: &[u8]) -> Result<Manifest> {
    let refuse = |why: String| BundleError::Entry { entry: name.to_owned(), why };
    let manifest: Manifest = serde_json::from_slice(content)
        .map_err(|e| refuse(format!("this build cannot parse it as a manifest: {e}")))?;
    if !manifest.is_readable() {
        let found = manifest.format;
        let known = Manifest::FORMAT;
        return Err(refuse(format!("it has format {found}, and this build reads {known}; use a newer build")));
    }
    manifest.check_files().map_err(&refuse)?;
    // A part's manifest is named by the digest of its canonical bytes, so other bytes are refused.
    if manifest.to_bytes() != content {
        return Err(refuse("it is not canonical JSON".into()));
    }
    Ok(manifest)
}

/// Checks the files that the model's manifest lists before any of them is read.
fn check_files(manifest: &Manifest, model: &Model) -> std::result::Result<(), String> {
    if manifest.files.len() > FILES {
        return Err(format!("it lists {} files; expected at most {FILES}", manifest.files.len()));
    }
    let mut total = 0u64;
    for (name, entry) in &manifest.files {
        check_name(name).map_err(|why| format!("invalid file name `{}` in the manifest: {why}", printable(name)))?;
        if [HEAD, MANIFEST, CARD].contains(&name.as_str()) {
            return Err(format!("it lists `{name}`, which is reserved for the bundle"));
        }
        total = total.saturating_add(entry.bytes);
    }
    if total > limits::BUNDLE_BYTES as u64 {
        return Err(format!("its files have {total} bytes; expected at most {}", limits::BUNDLE_BYTES));
    }
    for (role, digest) in &model.parts {
        let name = format!("{role}/manifest.json");
        if manifest.files.get(&name).map(|entry| entry.digest) != Some(*digest) {
            return Err(format!("its part `{role}` is {}, but it lists no `{name}` with this digest", digest.short()));
        }
    }
    if manifest.kind == ArtifactKind::Model { Ok(()) } else { Err("it is not a model's manifest".into()) }
}

/// Checks that only zeros follow the archive, and not too many.
fn check_padding(rest: impl Read) -> Result<()> {
    let mut padding = Vec::new();
    rest.take(PADDING + 1)
        .read_to_end(&mut padding)
        .map_err(|e| BundleError::Damaged(format!("its end is damaged: {e}")))?;
    if padding.len() as u64 > PADDING || padding.iter().any(|byte| *byte != 0) {
        return Err(BundleError::Damaged("data follows the end of the archive".into()));
    }
    Ok(())
}

fn unreadable(error: &std::io::Error) -> BundleError {
    BundleError::NotABundle(format!("it cannot be unpacked: {error}"))
}
