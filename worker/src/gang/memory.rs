//! Gradients between two members of one machine, by memory instead of by their connection.
//!
//! A member makes memory for a peer and announces it in its greeting: process, file descriptor, size and a random mark.
//! A peer that opens it by `/proc` and finds the mark maps it for reading only, and says so in its next greeting. Later
//! frames of the exchange have no payload, and their numbers are in the memory. All frames still pass over the connection,
//! which shows their order, the silence of a peer and its loss. A buffer that no longer fits gets larger memory, which is
//! announced in the same way.
//!
//! A peer does not read while the owner writes. It sends its sum after it has copied the parts, and it begins the next step
//! after it has copied the sum. The owner may be a step ahead by then and write the next parts. So parts and sums have
//! places of their own, however long the buffers of both steps are. A peer that reads at another time gets wrong
//! numbers, and no more.
//!
//! Not its job: which numbers are sent when (`exchange`).
//!
//! Processes that do not see each other (another machine, user or container, or `--sandbox`) use their connection.
#![allow(unsafe_code, reason = "memory that another process may write has no safe type")]

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::fd::AsRawFd as _;

use memmap2::{Mmap, MmapMut};

/// Largest memory for a peer. A longer buffer passes over the connection.
const MOST_BYTES: usize = 1 << 30;
/// Bytes of the random mark at the beginning.
const MARK: usize = 16;
/// Begin of the numbers, which keeps them aligned.
const NUMBERS: usize = 64;

/// The place of a member's memory for a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Announcement {
    process: u32,
    descriptor: u32,
    bytes: u64,
    /// Number of floats for parts, which come before those for sums.
    parts: u64,
    mark: [u8; MARK],
}

impl Announcement {
    /// Length on the wire.
    pub(super) const BYTES: usize = 24 + MARK;

    pub(super) fn to_bytes(self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        bytes[..4].copy_from_slice(&self.process.to_le_bytes());
        bytes[4..8].copy_from_slice(&self.descriptor.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.bytes.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.parts.to_le_bytes());
        bytes[24..].copy_from_slice(&self.mark);
        bytes
    }

    pub(super) fn read(bytes: &[u8]) -> Option<Self> {
        let (numbers, mark) = bytes.split_at_checked(24)?;
        let process = u32::from_le_bytes(numbers[..4].try_into().ok()?);
        let descriptor = u32::from_le_bytes(numbers[4..8].try_into().ok()?);
        let bytes = u64::from_le_bytes(numbers[8..16].try_into().ok()?);
        let parts = u64::from_le_bytes(numbers[16..].try_into().ok()?);
        Some(Self { process, descriptor, bytes, parts, mark: mark.try_into().ok()? })
    }
}

/// Memory that this member writes and one peer reads.
#[derive(Debug)]
pub(super) struct Outgoing {
    map: MmapMut,
    announcement: Announcement,
    /// Keeps the descriptor open until the peer has opened it.
    _file: File,
}

impl Outgoing {
    /// Makes memory for so many floats of parts and of sums.
    pub(super) fn new(parts: usize, sums: usize) -> io::Result<Self> {
        let numbers = parts.checked_add(sums);
        let bytes = numbers.and_then(|numbers| numbers.checked_mul(4)?.checked_add(NUMBERS));
        let bytes = bytes.filter(|bytes| *bytes <= MOST_BYTES).ok_or(io::ErrorKind::FileTooLarge)?;
        let file = sealed_memory(bytes as u64)?;
        // SAFETY: the size is sealed, and the other process maps it for reading only.
        let mut map = unsafe { MmapMut::map_mut(&file)? };
        let mut mark = [0; MARK];
        getrandom::fill(&mut mark).map_err(io::Error::other)?;
        map[..MARK].copy_from_slice(&mark);
        let descriptor = u32::try_from(file.as_raw_fd()).map_err(io::Error::other)?;
        let (process, bytes, parts) = (std::process::id(), bytes as u64, parts as u64);
        let announcement = Announcement { process, descriptor, bytes, parts, mark };
        Ok(Self { map, announcement, _file: file })
    }

    pub(super) fn announcement(&self) -> Announcement {
        self.announcement
    }

    /// The numbers for parts and those for sums.
    fn areas(&mut self) -> (&mut [f32], &mut [f32]) {
        let parts = usize::try_from(self.announcement.parts).expect("it is in memory");
        bytemuck::cast_slice_mut(&mut self.map[NUMBERS..]).split_at_mut(parts)
    }

    fn fits(&mut self, parts: usize, sums: usize) -> bool {
        let areas = self.areas();
        areas.0.len() >= parts && areas.1.len() >= sums
    }

    /// The numbers of parts at these places.
    ///
    /// # Panics
    /// If a place lies outside; the caller chose the size.
    pub(super) fn parts(&mut self, places: Range<usize>) -> &mut [f32] {
        &mut self.areas().0[places]
    }

    /// The first `length` numbers of the sum.
    ///
    /// # Panics
    /// If it is longer than the caller chose.
    pub(super) fn sum(&mut self, length: usize) -> &mut [f32] {
        &mut self.areas().1[..length]
    }
}

/// Memory that a peer writes and this member reads.
#[derive(Debug)]
pub(super) struct Incoming {
    map: Mmap,
    /// Number of floats for parts.
    parts: usize,
}

impl Incoming {
    /// Opens a peer's memory. Fails if this process does not see it.
    pub(super) fn open(announced: &Announcement) -> io::Result<Self> {
        let Announcement { process, descriptor, bytes, parts, mark } = announced;
        let path = format!("/proc/{process}/fd/{descriptor}");
        let other = || io::Error::from(io::ErrorKind::InvalidData);
        // Opening another kind of file could wait or act.
        let found = std::fs::metadata(&path)?;
        if !found.is_file() || found.len() != *bytes || *bytes < NUMBERS as u64 || *bytes > MOST_BYTES as u64 {
            return Err(other());
        }
        let file = File::open(&path)?;
        check_sealed(&file)?;
        // SAFETY: the size is sealed, so that no page disappears. Numbers are only copied out, see `read`.
        let map = unsafe { Mmap::map(&file)? };
        if map.len() as u64 != *bytes || map[..MARK] != *mark {
            return Err(other());
        }
        Ok(Self { map, parts: usize::try_from(*parts).map_err(|_| other())? })
    }

    /// Copies the numbers of parts from place `at` on. Returns false if the memory is shorter.
    pub(super) fn read_parts(&self, at: usize, out: &mut [f32]) -> bool {
        self.read(at, out)
    }

    /// Copies the sum. Returns false if the memory is shorter.
    pub(super) fn read_sum(&self, out: &mut [f32]) -> bool {
        self.read(self.parts, out)
    }

    fn read(&self, at: usize, out: &mut [f32]) -> bool {
        let numbers = (self.map.len() - NUMBERS) / 4;
        if at.checked_add(out.len()).is_none_or(|end| end > numbers) {
            return false;
        }
        // SAFETY: the range lies inside, the numbers are aligned, and no reference to them is made that a wrong write
        // of the peer could invalidate. Any bits are a float.
        unsafe {
            let from = self.map.as_ptr().add(NUMBERS).cast::<f32>().add(at);
            std::ptr::copy_nonoverlapping(from, out.as_mut_ptr(), out.len());
        }
        true
    }
}

/// The memory of both directions between this member and a peer.
#[derive(Debug, Default)]
pub(super) struct Between {
    outgoing: Option<Outgoing>,
    /// Step whose greeting announced the memory.
    announced: Option<u64>,
    /// True if the peer has mapped it.
    is_mapped: bool,
    incoming: Option<Incoming>,
}

impl Between {
    /// Makes memory for so many floats of parts and of sums, unless they fit in the announced memory. A stage whose next
    /// phase trains a larger network thus gets larger memory. After a failure no memory is made again.
    pub(super) fn announce(&mut self, step: u64, parts: usize, sums: usize) -> Option<Announcement> {
        let fits = self.outgoing.as_mut().map(|outgoing| outgoing.fits(parts, sums));
        if fits.unwrap_or(self.announced.is_some()) {
            return None;
        }
        self.announced = Some(step);
        self.is_mapped = false;
        self.outgoing = Outgoing::new(parts, sums)
            .inspect_err(|error| tracing::debug!("no memory for a peer; its connection is used: {error}"))
            .ok();
        self.outgoing.as_ref().map(Outgoing::announcement)
    }

    /// Handles a peer's greeting of `step`: the memory that it announces, and if it has mapped this member's.
    pub(super) fn greeted(&mut self, step: u64, announced: Option<&Announcement>, is_mapped: bool) {
        // The greeting of the announcing step crosses the announcement, and tells of earlier memory.
        if self.announced.is_some_and(|announced| announced < step) {
            self.is_mapped = is_mapped;
            self.outgoing = self.outgoing.take().filter(|_| is_mapped);
        }
        if let Some(announced) = announced {
            self.incoming = Incoming::open(announced)
                .inspect_err(|error| tracing::debug!("a peer's memory is not seen; its connection is used: {error}"))
                .ok();
        }
    }

    /// Returns true if this member has mapped the peer's memory.
    pub(super) fn has_incoming(&self) -> bool {
        self.incoming.is_some()
    }

    /// The memory to write for the peer, if it reads it.
    pub(super) fn outgoing(&mut self) -> Option<&mut Outgoing> {
        self.outgoing.as_mut().filter(|_| self.is_mapped)
    }

    /// Copies the peer's parts from place `at` on. Returns false if there is no such memory.
    pub(super) fn read_parts(&self, at: usize, out: &mut [f32]) -> bool {
        self.incoming.as_ref().is_some_and(|incoming| incoming.read_parts(at, out))
    }

    /// Copies the peer's sum. Returns false if there is no such memory.
    pub(super) fn read_sum(&self, out: &mut [f32]) -> bool {
        self.incoming.as_ref().is_some_and(|incoming| incoming.read_sum(out))
    }
}

#[cfg(target_os = "linux")]
fn sealed_memory(bytes: u64) -> io::Result<File> {
    use nix::fcntl::{FcntlArg, SealFlag, fcntl};
    use nix::sys::memfd::{MFdFlags, memfd_create};
    let flags = MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING;
    let file = File::from(memfd_create("stride-gang", flags)?);
    file.set_len(bytes)?;
    let seals = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW | SealFlag::F_SEAL_SEAL;
    fcntl(&file, FcntlArg::F_ADD_SEALS(seals))?;
    Ok(file)
}

#[cfg(target_os = "linux")]
fn check_sealed(file: &File) -> io::Result<()> {
    use nix::fcntl::{FcntlArg, SealFlag, fcntl};
    let seals = SealFlag::from_bits_truncate(fcntl(file, FcntlArg::F_GET_SEALS)?);
    if seals.contains(SealFlag::F_SEAL_SHRINK) { Ok(()) } else { Err(io::ErrorKind::InvalidData.into()) }
}

#[cfg(not(target_os = "linux"))]
fn sealed_memory(_bytes: u64) -> io::Result<File> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(not(target_os = "linux"))]
fn check_sealed(_file: &File) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_pass_and_nothing_outside_is_read() {
        let mut own = Outgoing::new(990, 10).expect("memory");
        own.sum(10).copy_from_slice(&[0.5; 10]);
        own.parts(0..990).fill(2.0);
        let theirs = Incoming::open(&own.announcement()).expect("the same process");
        let mut out = [0.0; 10];
        assert!(theirs.read_sum(&mut out));
        assert_eq!(out, [0.5; 10], "parts do not touch the sum");
        assert!(!theirs.read_sum(&mut [0.0; 11]) && !theirs.read_parts(991, &mut out));
        assert!(!theirs.read_parts(usize::MAX, &mut out));
        drop(own);
        assert!(theirs.read_parts(980, &mut out), "it stays as long as somebody maps it");
        assert_eq!(out, [2.0; 10]);
    }

    #[test]
    fn what_is_not_the_announced_memory_is_refused() {
        let own = Outgoing::new(900, 100).expect("memory");
        let right = own.announcement();
        assert_eq!(Announcement::read(&right.to_bytes()), Some(right));
        let other = Outgoing::new(900, 100).expect("memory");
        let wrong = [
            Announcement { mark: [0; MARK], ..right },
            Announcement { bytes: right.bytes - 4, ..right },
            Announcement { process: 0, ..right },
            Announcement { descriptor: u32::MAX, ..right },
            Announcement { descriptor: other.announcement().descriptor, ..right },
        ];
        for announced in wrong {
            assert!(Incoming::open(&announced).is_err(), "{announced:?}");
        }
        // A file that its owner could cut off under the reader.
        let file = tempfile::NamedTempFile::new().expect("a file");
        let bytes = right.bytes;
        file.as_file().set_len(bytes).expect("set");
        let descriptor = u32::try_from(file.as_file().as_raw_fd()).expect("a descriptor");
        assert!(Incoming::open(&Announcement { descriptor, mark: [0; MARK], ..right }).is_err());
        assert!(Outgoing::new(usize::MAX, 1).is_err() && Outgoing::new(MOST_BYTES / 2, MOST_BYTES / 2).is_err());
        assert_eq!(Announcement::read(&right.to_bytes()[1..]), None);
    }
}
