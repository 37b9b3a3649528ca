//! A power loss under SQLite: a file's content falls back to that of its last sync.
#![allow(unsafe_code, reason = "SQLite's file systems are tables of C functions")]

use std::collections::BTreeMap;
use std::ffi::{CStr, OsStr, c_char, c_int};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};

use libsqlite3_sys as ffi;

type Sync = unsafe extern "C" fn(*mut ffi::sqlite3_file, c_int) -> c_int;

/// Open files and their synced content.
struct Files {
    /// Address of the operating system's file system; 0 before it is known.
    system: usize,
    /// Path and system sync function of each open file, by its address.
    open: BTreeMap<usize, (PathBuf, Sync)>,
    synced: BTreeMap<PathBuf, Vec<u8>>,
}

static FILES: Mutex<Files> = Mutex::new(Files { system: 0, open: BTreeMap::new(), synced: BTreeMap::new() });

fn files() -> MutexGuard<'static, Files> {
    FILES.lock().unwrap()
}

/// Intercepts the file system of every database that this process opens later. Call it before the first one is opened.
pub fn stand_between() {
    // SAFETY: SQLite never frees its table, and the registered copy is leaked.
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

/// Opens a file through the system and replaces its sync function.
unsafe extern "C" fn open(
    _: *mut ffi::sqlite3_vfs,
    name: *const c_char,
    file: *mut ffi::sqlite3_file,
    flags: c_int,
    got: *mut c_int,
) -> c_int {
    let system = files().system as *mut ffi::sqlite3_vfs;
    // SAFETY: the arguments are SQLite's own. An open file has a table of functions; it gets a copy that is leaked. The
    // system's functions find all their data in the file.
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
    // SAFETY: the system's own function is called on its own file.
    let done = unsafe { system(file, flags) };
    // The file may be gone with its test's folder.
    if done == ffi::SQLITE_OK
        && let Ok(bytes) = fs::read(&path)
    {
        files.synced.insert(path, bytes);
    }
    done
}

/// Copies the store in `dir` to `to` as after a power loss now: database and log have their last synced content.
pub fn lose_power(dir: &Path, to: &Path) {
    let files = files();
    copy(dir, to);
    // Files that SQLite has removed stay removed.
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
            // A small file that is being replaced already exists under its new name.
            let _ = fs::copy(&from, &into);
        }
    }
}
