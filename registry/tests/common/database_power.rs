//! A disk under SQLite that can lose its power: what a file holds is then what it held when it was synced last.
#![allow(unsafe_code, reason = "SQLite's file systems are tables of C functions")]

use std::collections::BTreeMap;
use std::ffi::{CStr, OsStr, c_char, c_int};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};

use libsqlite3_sys as ffi;

type Sync = unsafe extern "C" fn(*mut ffi::sqlite3_file, c_int) -> c_int;

/// What was opened and what was synced.
struct Files {
    /// The operating system's file system, by its address; 0 until it was taken.
    system: usize,
    /// By the address of the open file: where it lies, and the system's sync.
    open: BTreeMap<usize, (PathBuf, Sync)>,
    synced: BTreeMap<PathBuf, Vec<u8>>,
}

static FILES: Mutex<Files> = Mutex::new(Files { system: 0, open: BTreeMap::new(), synced: BTreeMap::new() });

fn files() -> MutexGuard<'static, Files> {
    FILES.lock().unwrap()
}

/// Stands between SQLite and the system, for every database that this process opens from now on. Call it before any is opened.
pub fn stand_between() {
    // SAFETY: the table that SQLite gives is never freed, and neither is the copy that is registered in its place.
    unsafe {
        let system = ffi::sqlite3_vfs_find(std::ptr::null());
        files().system = system as usize;
        let mut ours = *system;
        ours.zName = c"power".as_ptr();
        ours.pNext = std::ptr::null_mut();
        ours.xOpen = Some(open);
        assert_eq!(ffi::sqlite3_vfs_register(Box::leak(Box::new(ours)), 1), ffi::SQLITE_OK);
    }
}

/// Opens a file as the system does, and takes the place of its sync.
unsafe extern "C" fn open(
    _: *mut ffi::sqlite3_vfs,
    name: *const c_char,
    file: *mut ffi::sqlite3_file,
    flags: c_int,
    got: *mut c_int,
) -> c_int {
    let system = files().system as *mut ffi::sqlite3_vfs;
    // SAFETY: what SQLite passes is passed on. Once it is open a file has a table of functions, of which it gets a copy that
    // is never freed; the system's functions find all that they need in the file.
    unsafe {
        let done = ((*system).xOpen.unwrap())(system, name, file, flags, got);
        if done == ffi::SQLITE_OK && !name.is_null() {
            let mut methods = *(*file).pMethods;
            let path = PathBuf::from(OsStr::from_bytes(CStr::from_ptr(name).to_bytes()));
            files().open.insert(file as usize, (path, methods.xSync.unwrap()));
            methods.xSync = Some(sync);
            (*file).pMethods = Box::leak(Box::new(methods));
        }
        done
    }
}

unsafe extern "C" fn sync(file: *mut ffi::sqlite3_file, flags: c_int) -> c_int {
    let mut files = files();
    let (path, system) = files.open[&(file as usize)].clone();
    // SAFETY: the system's own function, on its own file.
    let done = unsafe { system(file, flags) };
    // A file whose folder is gone with its test is nobody's any more.
    if done == ffi::SQLITE_OK
        && let Ok(bytes) = fs::read(&path)
    {
        files.synced.insert(path, bytes);
    }
    done
}

/// Copies the store in `dir` to `to` as it is after a loss of power right now: of the database and its log what was synced.
pub fn lose_power(dir: &Path, to: &Path) {
    let files = files();
    copy(dir, to);
    // What SQLite has removed stays removed.
    for (path, bytes) in files.synced.iter().filter(|(path, _)| path.parent() == Some(dir) && path.exists()) {
        fs::write(to.join(path.file_name().unwrap()), bytes).unwrap();
    }
}

fn copy(dir: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(dir).unwrap().map(|entry| entry.unwrap()) {
        let (from, into) = (entry.path(), to.join(entry.file_name()));
        if entry.file_type().unwrap().is_dir() {
            copy(&from, &into);
        } else if !entry.file_name().to_string_lossy().starts_with("stride.db") {
            // A small file that is replaced at this moment is there under its new name.
            let _ = fs::copy(&from, &into);
        }
    }
}
