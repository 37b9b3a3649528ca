//! Files of a set out of an archive that is not trusted.
//!
//! Memory is bounded by a piece of a file. Only regular entries whose last name is in the list are read; their bytes
//! are checked before they get that name. Extensions of the format, which hold names of any length, count as entries.

use std::collections::BTreeMap;
use std::io::Read;

use flate2::read::MultiGzDecoder;
use tar::{Archive, EntryType};

use crate::dataset::list::Listed;
use crate::dataset::staging::{Staging, Wrong};

/// Largest unpacked size of an archive, in bytes.
const UNPACKED_BYTES: u64 = 16 << 30;
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
    for (number, entry) in archive.entries().map_err(damaged)?.raw(true).enumerate() {
        if missing.is_empty() {
            break;
        }
        if number >= ENTRIES {
            return Err(Wrong::Content(format!("the archive has more than {ENTRIES} entries")));
        }
        let entry = entry.map_err(damaged)?;
        let name = last_name(&entry.path_bytes());
        let Some((name, listed)) = missing.get_key_value(name.as_str()) else { continue };
        let (name, listed) = (*name, *listed);
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

/// The last part of a member's path; empty if it is not text.
fn last_name(path: &[u8]) -> String {
    let last = path.rsplit(|byte| *byte == b'/').next().unwrap_or_default();
    std::str::from_utf8(last).unwrap_or_default().to_owned()
}
