//! A cable between two network interfaces that delivers every frame late, for kernels without `netem`.
//!
//! Its ends are TAP devices. A thread for each direction reads frames and another one writes them when they are due. It
//! passes segments as large as TCP makes them (`IFF_VNET_HDR`), so that a gigabit needs some ten thousand frames a second.
//! The delay is below TCP, which therefore sees it as on a long line.
#![allow(unsafe_code, reason = "TAP devices are made by ioctl")]

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _, Write as _};
use std::os::fd::AsRawFd as _;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

/// Longest frame with the header that describes its segments.
const FRAME: usize = (64 << 10) + 256;

/// Makes a TAP device of this name. It disappears with the file.
fn tap(name: &str) -> io::Result<File> {
    let file = OpenOptions::new().read(true).write(true).open("/dev/net/tun")?;
    // SAFETY: all zeros are a valid `ifreq`.
    let mut request: libc::ifreq = unsafe { std::mem::zeroed() };
    if name.len() >= request.ifr_name.len() {
        return Err(io::ErrorKind::InvalidFilename.into());
    }
    for (to, from) in request.ifr_name.iter_mut().zip(name.bytes()) {
        *to = from.cast_signed();
    }
    let flags = libc::IFF_TAP | libc::IFF_NO_PI | libc::IFF_VNET_HDR;
    request.ifr_ifru.ifru_flags = i16::try_from(flags).map_err(io::Error::other)?;
    // SAFETY: the request lives during the call, and the flag says which of its fields is read.
    let made = unsafe { libc::ioctl(file.as_raw_fd(), libc::TUNSETIFF, &raw mut request) };
    if made < 0 {
        return Err(io::Error::last_os_error());
    }
    let offload = libc::TUN_F_CSUM | libc::TUN_F_TSO4 | libc::TUN_F_TSO6;
    // SAFETY: takes a number.
    if unsafe { libc::ioctl(file.as_raw_fd(), libc::TUNSETOFFLOAD, libc::c_ulong::from(offload)) } < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(file)
}

/// Makes both ends and passes frames from now on, each `late` after it was read. Lasts until one end is removed.
///
/// # Errors
/// If this process may not make TAP devices.
pub fn lay([one, other]: [&str; 2], late: Duration) -> io::Result<()> {
    let (one, other) = (tap(one)?, tap(other)?);
    pass(one.try_clone()?, other.try_clone()?, late);
    pass(other, one, late);
    Ok(())
}

fn pass(mut from: File, mut to: File, late: Duration) {
    let (sender, receiver) = mpsc::channel::<(Instant, Vec<u8>)>();
    thread::spawn(move || {
        let mut frame = vec![0; FRAME];
        while let Ok(length) = from.read(&mut frame) {
            if sender.send((Instant::now() + late, frame[..length].to_vec())).is_err() {
                return;
            }
        }
    });
    thread::spawn(move || {
        for (due, frame) in receiver {
            thread::sleep(due.saturating_duration_since(Instant::now()));
            // A device that is down loses frames, as an unplugged cable does.
            let _ = to.write(&frame);
        }
    });
}
