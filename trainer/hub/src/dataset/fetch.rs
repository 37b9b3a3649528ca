//! Fetching of a set, in this order: existing files, the archive, its files, the tables, the rename.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use motion::DataPath;
use reqwest::Url;
use reqwest::redirect::Policy;

use crate::dataset::error::{FetchError, io_error};
use crate::dataset::list::{Listed, PublicSet};
use crate::dataset::staging::{Staging, Wrong, is_listed};
use crate::dataset::unpack::unpack;
use crate::transfer::{Arrived, Interrupted, Wanted, client, discard, transfer};

/// Largest archive, in bytes.
const ARCHIVE_BYTES: u64 = 4 << 30;
/// Name of the file with source and licence.
const NOTICE: &str = "SOURCE.txt";
/// Number of names in a message.
const NAMED: usize = 3;

/// Place of the files.
#[derive(Debug, Clone, Copy)]
pub enum Source<'a> {
    /// Address of a `.tar.gz`.
    Address(&'a str),
    /// A folder with the files in it or below it, such as a clone; or a `.tar.gz`.
    Local(&'a Path),
}

/// A file that is made for the set, such as its captions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    pub name: &'static str,
    pub text: String,
}

/// Makes the tables of a set from the names of its recordings.
pub type MakeTables<'a> = dyn Fn(&[&str]) -> Result<Vec<Table>, String> + 'a;

/// Progress of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// Files of an earlier attempt are compared with the list.
    Checked { files: usize },
    /// The archive arrives.
    Arrived(Arrived),
    /// Files are checked and kept.
    Kept { files: usize, of: usize },
}

/// A request for a set.
#[derive(Debug)]
pub struct Fetch<'a> {
    pub set: &'a PublicSet,
    pub folder: &'a Path,
    pub source: Source<'a>,
    /// Completes the set without the files that a local source lacks.
    pub partial: bool,
    /// Pause after the first failed attempt of a transfer; each later one doubles it.
    pub pause: Duration,
}

/// A complete set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fetched {
    /// Number of files in the folder.
    pub files: usize,
    /// Number of files that an earlier attempt had checked.
    pub kept: usize,
    /// Number of listed files that a local source lacks.
    pub missing: usize,
    /// True if the folder was complete before.
    pub was_complete: bool,
}

impl Fetch<'_> {
    /// Returns true if the licence was accepted before: the set exists, or an earlier attempt has started to fetch it.
    pub fn is_accepted(&self) -> bool {
        is_taken(self.folder) || Staging::is_accepted(self.folder)
    }

    /// Completes the set. `tables` makes further files from the names of the recordings.
    ///
    /// # Errors
    /// The folder then does not exist, and the same command continues.
    pub fn run(&self, tables: &MakeTables<'_>, progress: &mut dyn FnMut(Progress)) -> Result<Fetched, FetchError> {
        if is_taken(self.folder) {
            return self.compare();
        }
        let staging = Staging::open(self.folder)?;
        staging.accept()?;
        let all = self.set.files.len();
        let mut missing: BTreeMap<&str, &Listed> =
            self.set.files.iter().map(|(name, listed)| (name.as_str(), listed)).collect();
        staging.check(&mut missing, &mut |files| progress(Progress::Checked { files }))?;
        let kept = all - missing.len();
        if !missing.is_empty() {
            match self.source {
                Source::Address(address) => self.take_from_address(address, &staging, &mut missing, progress)?,
                Source::Local(path) if path.is_dir() => from_folder(path, &staging, &mut missing, progress)?,
                Source::Local(path) => {
                    let archive = File::open(path).map_err(io_error(path, 0))?;
                    let from = path.display().to_string();
                    take(archive, &from, &staging, &mut missing, &mut |left| {
                        progress(Progress::Kept { files: all - left, of: all });
                    })?;
                }
            }
        }
        let there: Vec<&str> =
            self.set.files.keys().map(String::as_str).filter(|name| !missing.contains_key(name)).collect();
        self.refuse_missing(&missing, &there)?;
        let notice = Table { name: NOTICE, text: self.set.notice.clone() };
        let tables = tables(&there).map_err(|what| FetchError::Content { from: self.set.name.clone(), what })?;
        for table in tables.iter().chain([&notice]) {
            let path = staging.files().join(table.name);
            fs::write(&path, &table.text).map_err(io_error(&path, table.text.len() as u64))?;
        }
        let fetched = Fetched { files: there.len(), kept, missing: missing.len(), was_complete: false };
        staging.finish(self.folder)?;
        Ok(fetched)
    }

    /// Checks an existing folder.
    fn compare(&self) -> Result<Fetched, FetchError> {
        let mut differ = Vec::new();
        let mut missing = 0;
        for (name, listed) in &self.set.files {
            let path = self.folder.join(name);
            match is_listed(&path, listed) {
                Ok(true) => {}
                Ok(false) => differ.push(name.as_str()),
                Err(error) if error.kind() == io::ErrorKind::NotFound => missing += 1,
                Err(error) => return Err(io_error(&path, 0)(error)),
            }
        }
        let files = self.set.files.len() - missing;
        let taken = |what: String| Err(FetchError::Taken { folder: self.folder.into(), what });
        if !differ.is_empty() {
            return taken(format!("{} files differ from the published ones: {}", differ.len(), some(&differ)));
        }
        if !self.folder.join(NOTICE).is_file() || files == 0 {
            return taken(format!("the folder is not empty, and is not the set `{}`", self.set.name));
        }
        if missing > 0 && !self.partial {
            return taken(format!("the folder has {files} of {} files of the set", self.set.files.len()));
        }
        Ok(Fetched { files, kept: files, missing, was_complete: true })
    }

    fn refuse_missing(&self, missing: &BTreeMap<&str, &Listed>, there: &[&str]) -> Result<(), FetchError> {
        let from = match self.source {
            Source::Address(address) => address.to_owned(),
            Source::Local(path) => path.display().to_string(),
        };
        let names: Vec<&str> = missing.keys().copied().collect();
        let lacks = || format!("lacks {} of {} files: {}", names.len(), self.set.files.len(), some(&names));
        match self.source {
            _ if missing.is_empty() => Ok(()),
            Source::Local(_) if self.partial && !there.is_empty() => Ok(()),
            Source::Local(_) if !there.is_empty() => {
                Err(FetchError::Content { from, what: format!("{}; `--partial` accepts that", lacks()) })
            }
            _ => Err(FetchError::Content { from, what: lacks() }),
        }
    }

    /// Downloads the archive unless it exists, and extracts the files.
    fn take_from_address(
        &self,
        address: &str,
        staging: &Staging,
        missing: &mut BTreeMap<&str, &Listed>,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), FetchError> {
        let archive = staging.archive();
        let part = staging.archive_part();
        if !archive.is_file() {
            let refused = |why: String| FetchError::Refused { address: address.into(), why };
            let away = |why: String| FetchError::Away { address: address.into(), why };
            let url = Url::parse(address).map_err(|error| refused(format!("not a valid address: {error}")))?;
            let wanted = Wanted { url, token: None, most: ARCHIVE_BYTES, fixed: false, pause: self.pause };
            let client = client(|builder| builder.redirect(Policy::limited(5))).map_err(away)?;
            let bytes = bytes_of(missing);
            transfer(&client, &wanted, &part, &mut |arrived| progress(Progress::Arrived(arrived))).map_err(|why| {
                match why {
                    Interrupted::Away(why) => away(why),
                    Interrupted::Refused(status) => refused(format!("the server answered {status}")),
                    Interrupted::TooLarge => refused(format!("the archive has more than {ARCHIVE_BYTES} bytes")),
                    Interrupted::Io(file, source) => io_error(&file, bytes)(source),
                }
            })?;
            fs::rename(&part, &archive).map_err(io_error(&archive, 0))?;
            discard(&part);
        }
        let all = self.set.files.len();
        let file = File::open(&archive).map_err(io_error(&archive, 0))?;
        let taken = take(file, address, staging, missing, &mut |left| {
            progress(Progress::Kept { files: all - left, of: all });
        });
        // An archive with other content is of no further use.
        if matches!(taken, Err(FetchError::Content { .. })) || (taken.is_ok() && !missing.is_empty()) {
            fs::remove_file(&archive).map_err(io_error(&archive, 0))?;
        }
        taken
    }
}

fn bytes_of(missing: &BTreeMap<&str, &Listed>) -> u64 {
    missing.values().map(|listed| listed.bytes).sum()
}

/// Names some of many files.
fn some(names: &[&str]) -> String {
    let more = if names.len() > NAMED { ", ..." } else { "" };
    format!("{}{more}", names[..names.len().min(NAMED)].join(", "))
}

/// Returns true if the folder has entries, or is no folder.
fn is_taken(folder: &Path) -> bool {
    match fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_some(),
        Err(error) => error.kind() != io::ErrorKind::NotFound,
    }
}

/// Takes the missing files out of an archive.
fn take(
    archive: File,
    from: &str,
    staging: &Staging,
    missing: &mut BTreeMap<&str, &Listed>,
    unpacked: &mut dyn FnMut(usize),
) -> Result<(), FetchError> {
    unpack(io::BufReader::new(archive), staging, missing, unpacked).map_err(|wrong| match wrong {
        Wrong::Content(what) => FetchError::Content { from: from.to_owned(), what },
        Wrong::Io(error) => io_error(&staging.files(), bytes_of(missing))(error),
    })
}

/// Copies the missing files out of a folder and those below it.
fn from_folder(
    folder: &Path,
    staging: &Staging,
    missing: &mut BTreeMap<&str, &Listed>,
    progress: &mut dyn FnMut(Progress),
) -> Result<(), FetchError> {
    let from = || folder.display().to_string();
    let tree = DataPath::local(folder).tree();
    let found = tree.map_err(|error| FetchError::Content { from: from(), what: error.to_string() })?;
    let of = missing.len();
    for path in found {
        let path: PathBuf = path.shown().to_owned();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let Some((name, listed)) = missing.get_key_value(name.as_str()) else { continue };
        let name = *name;
        let listed = *listed;
        let file = File::open(&path).map_err(io_error(&path, 0))?;
        staging.keep(name, listed, file).map_err(|wrong| match wrong {
            Wrong::Content(what) => FetchError::Content { from: from(), what },
            Wrong::Io(error) => io_error(&staging.files(), bytes_of(missing))(error),
        })?;
        missing.remove(name);
        progress(Progress::Kept { files: of - missing.len(), of });
    }
    Ok(())
}
