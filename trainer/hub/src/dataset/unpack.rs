//! Files of a set out of an archive that is not trusted.
//!
//! Memory is bounded by a piece of a file. Only regular entries whose last name is in the list are read; their bytes
//! are checked before they get that name. Extensions of the format hold long names; a name above the limit is ignored.

use std::collections::BTreeMap;
use std::io::Read;

use flate2::read::MultiGzDecoder;
use tar::{Archive, Entry, EntryType, PaxExtensions};

use crate::dataset::list::Listed;
use crate::dataset::staging::{Staging, Wrong};

/// Largest unpacked size of an archive, in bytes.
const UNPACKED_BYTES: u64 = 16 << 30;
/// Largest extension that is read, in bytes.
const EXTENSION_BYTES: u64 = 64 << 10;
/// Largest number of entries of an archive.
const ENTRIES: usize = 200_000;

/// Moves the missing files out of an archive until none is missing or the archive ends.
pub(crate) fn unpack(
    archive: impl Read,
    staging: &Staging,
    missing: &mut BTreeMap<&str, &Listed>,
    unpacked: &mut dyn FnMut(usize),
) -> Result<(), Wrong> {
    let damaged = |error: std::io::Error| Wrong::Content(format!("not a complete .tar.gz archive: {error}"));
    let mut archive = Archive::new(MultiGzDecoder::new(archive).take(UNPACKED_BYTES));
    let mut long_name = None;
    for (number, entry) in archive.entries().map_err(damaged)?.raw(true).enumerate() {
        if missing.is_empty() {
            break;
        }
        if number >= ENTRIES {
            return Err(Wrong::Content(format!("the archive has more than {ENTRIES} entries")));
        }
        let mut entry = entry.map_err(damaged)?;
        if is_extension(&entry) {
            long_name = extended_name(&mut entry).map_err(damaged)?.or(long_name);
            continue;
        }
        let name = long_name.take().unwrap_or_else(|| last_name(&entry.path_bytes()));
        let Some((name, listed)) = missing.get_key_value(name.as_str()) else { continue };
        let name = *name;
        let listed = *listed;
        if !matches!(entry.header().entry_type(), EntryType::Regular | EntryType::Continuous) {
            return Err(Wrong::Content(format!("`{name}` is not a regular file of the archive")));
        }
        if entry.size() != listed.bytes {
            return Err(Wrong::Content(format!("`{name}` has {} bytes; expected {}", entry.size(), listed.bytes)));
        }
        staging.keep(name, listed, entry)?;
        missing.remove(name);
        unpacked(missing.len());
    }
    Ok(())
}

fn is_extension<R: Read>(entry: &Entry<'_, R>) -> bool {
    let kind = entry.header().entry_type();
    kind.is_pax_local_extensions()
        || kind.is_pax_global_extensions()
        || kind.is_gnu_longname()
        || kind.is_gnu_longlink()
}

/// The last part of the path that an extension gives to the next entry.
fn extended_name<R: Read>(entry: &mut Entry<'_, R>) -> std::io::Result<Option<String>> {
    let kind = entry.header().entry_type();
    if entry.size() > EXTENSION_BYTES || !(kind.is_pax_local_extensions() || kind.is_gnu_longname()) {
        return Ok(None);
    }
    let mut bytes = Vec::new();
    entry.read_to_end(&mut bytes)?;
    if kind.is_gnu_longname() {
        return Ok(Some(last_name(bytes.strip_suffix(b"\0").unwrap_or(&bytes))));
    }
    let mut name = None;
    for record in PaxExtensions::new(&bytes) {
        let record = record?;
        if record.key_bytes() == b"path" {
            name = Some(last_name(record.value_bytes()));
        }
    }
    Ok(name)
}

/// The last part of a member's path; empty if it is not text.
fn last_name(path: &[u8]) -> String {
    let last = path.rsplit(|byte| *byte == b'/').next().unwrap_or_default();
    std::str::from_utf8(last).unwrap_or_default().to_owned()
}
