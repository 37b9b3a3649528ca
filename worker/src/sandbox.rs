//! Landlock rules of `--sandbox`: the files that a worker's process may still access.
//!
//! The rules are a second line of defence behind [`DataAccess`](stages::external::DataAccess). They apply to every thread and
//! library of the process, for any pipeline. The kernel applies them to the calling thread and its children, so they are
//! set before another thread exists. Landlock limits TCP by port only; the unit file or the container limits the hosts.

use std::path::{Path, PathBuf};

/// Folders that programs and their libraries live in, and files that name resolution and TLS read.
#[cfg(target_os = "linux")]
const SYSTEM: &[&str] = &[
    "/usr",
    "/lib",
    "/lib64",
    "/etc/ld.so.cache",
    "/etc/resolv.conf",
    "/etc/hosts",
    "/etc/host.conf",
    "/etc/nsswitch.conf",
    "/etc/gai.conf",
    "/etc/localtime",
    "/etc/ssl",
    "/etc/pki",
    "/etc/ca-certificates",
    "/etc/vulkan",
    "/run/systemd/resolve",
    "/proc/meminfo",
    "/proc/cpuinfo",
    "/proc/stat",
    "/proc/self",
    "/proc/sys",
    "/proc/driver",
    "/sys",
];

/// Devices that computing needs.
#[cfg(target_os = "linux")]
const DEVICES: &[&str] = &["/dev/null", "/dev/urandom", "/dev/random", "/dev/shm", "/dev/dri"];

/// Folders of a sandboxed worker.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Sandbox {
    /// Folders to read: data roots and the local store.
    pub(crate) read: Vec<PathBuf>,
    /// Folders to write: the blob cache.
    pub(crate) write: Vec<PathBuf>,
}

/// Why a process stays open.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SandboxError {
    /// The system has no Landlock, or one that is too old to close the file system.
    #[error("--sandbox needs Linux 5.13 or newer with Landlock enabled; start the worker in a container instead")]
    Unsupported,
    /// A folder that the worker needs cannot be opened.
    #[error("--sandbox: cannot open `{path}`: {message}")]
    Path {
        /// The folder that cannot be opened.
        path: String,
        /// Its error.
        message: String,
    },
    /// The kernel refuses a rule.
    #[error("--sandbox: the kernel refuses it: {0}")]
    Kernel(String),
}

impl Sandbox {
    /// Closes all of the file system but the sandbox's folders, the system's libraries and the temporary folder; also other
    /// processes' signals and abstract sockets where the kernel can.
    ///
    /// # Errors
    /// A system without Landlock, a folder that does not open, or a rule that the kernel refuses. The process must end then: it
    /// would work unprotected.
    #[cfg(target_os = "linux")]
    pub(crate) fn enter(&self) -> Result<(), SandboxError> {
        use landlock::{
            ABI, Access as _, AccessFs, CompatLevel, Compatible as _, Ruleset, RulesetAttr as _,
            RulesetCreatedAttr as _, RulesetStatus, Scope,
        };

        let kernel = |error: landlock::RulesetError| SandboxError::Kernel(error.to_string());
        let abi = ABI::V6;
        // No program is started: nothing may be executed.
        let read = AccessFs::from_read(abi) & !AccessFs::Execute;
        let write = AccessFs::from_all(abi) & !AccessFs::Execute;
        let mut rules = Ruleset::default()
            .set_compatibility(CompatLevel::BestEffort)
            .handle_access(AccessFs::from_all(abi))
            .and_then(|ruleset| ruleset.scope(Scope::from_all(abi)))
            .and_then(Ruleset::create)
            .map_err(kernel)?;
        for path in present(SYSTEM) {
            rules = rules.add_rule(rule(&path, read)?).map_err(kernel)?;
        }
        let nvidia = std::fs::read_dir("/dev").into_iter().flatten().flatten().map(|entry| entry.path());
        let nvidia = nvidia.filter(|path| path.to_string_lossy().starts_with("/dev/nvidia"));
        let devices = present(DEVICES).chain(nvidia);
        for path in devices.chain([std::env::temp_dir()]).chain(self.write.iter().cloned()) {
            rules = rules.add_rule(rule(&path, write)?).map_err(kernel)?;
        }
        for path in &self.read {
            rules = rules.add_rule(rule(path, read)?).map_err(kernel)?;
        }
        match rules.restrict_self().map_err(kernel)?.ruleset {
            RulesetStatus::NotEnforced => Err(SandboxError::Unsupported),
            RulesetStatus::FullyEnforced | RulesetStatus::PartiallyEnforced => Ok(()),
        }
    }

    /// Refuses: other systems have no such wall.
    #[cfg(not(target_os = "linux"))]
    pub(crate) fn enter(&self) -> Result<(), SandboxError> {
        Err(SandboxError::Unsupported)
    }
}

/// Paths that exist: systems differ in what they have.
#[cfg(target_os = "linux")]
fn present(paths: &'static [&'static str]) -> impl Iterator<Item = PathBuf> {
    paths.iter().map(PathBuf::from).filter(|path| path.exists())
}

#[cfg(target_os = "linux")]
fn rule(
    path: &Path,
    access: landlock::BitFlags<landlock::AccessFs>,
) -> Result<landlock::PathBeneath<landlock::PathFd>, SandboxError> {
    let opened = landlock::PathFd::new(path)
        .map_err(|error| SandboxError::Path { path: path.display().to_string(), message: error.to_string() })?;
    // A file takes fewer rights than a folder.
    let access = if path.is_dir() { access } else { access & landlock::AccessFs::from_file(landlock::ABI::V6) };
    Ok(landlock::PathBeneath::new(opened, access))
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::fs;
    use std::io::ErrorKind;
    use std::net::{TcpListener, TcpStream};
    use std::process::Command;

    use super::*;

    /// Rules hold for a thread and those that it starts, so a thread of its own leaves the other tests open.
    #[test]
    fn a_closed_thread_reads_its_folders_alone_and_writes_only_its_cache() {
        let folders = tempfile::tempdir_in(env!("CARGO_MANIFEST_DIR")).unwrap();
        let at = |name: &str| folders.path().join(name);
        for name in ["data", "cache", "other"] {
            fs::create_dir(at(name)).unwrap();
            fs::write(at(name).join("file"), name).unwrap();
        }
        std::os::unix::fs::symlink(at("other/file"), at("data/link")).unwrap();
        let sandbox = Sandbox { read: vec![at("data")], write: vec![at("cache")] };
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let denied =
            |result: std::io::Result<()>| result.map_err(|error| error.kind()) == Err(ErrorKind::PermissionDenied);
        let closed = || {
            sandbox.enter()?;
            assert_eq!(fs::read_to_string(at("data/file")).unwrap(), "data");
            fs::write(at("cache/new"), "new").unwrap();
            assert_eq!(fs::read_to_string(at("cache/new")).unwrap(), "new");
            assert!(fs::read_to_string("/proc/meminfo").is_ok(), "what limits of memory are judged by");
            assert!(fs::read_to_string("/proc/self/status").is_ok(), "what limits of memory are judged by");
            for path in [
                at("other/file"),
                at("data/link"),
                "/etc/passwd".into(),
                concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml").into(),
            ] {
                assert!(denied(fs::read(&path).map(drop)), "{}", path.display());
            }
            assert!(denied(fs::write(at("data/file"), "changed")), "a data root is only read");
            assert!(denied(fs::remove_file(at("data/file"))), "a data root is only read");
            assert!(
                TcpStream::connect(listener.local_addr().unwrap()).is_ok(),
                "units and containers limit the network"
            );
            assert!(denied(Command::new("/bin/sh").arg("-c").arg("true").status().map(drop)), "no program is started");
            std::thread::scope(|scope| {
                let later = scope.spawn(|| fs::read(at("other/file")).map(drop));
                assert!(denied(later.join().unwrap()), "threads that it starts are closed too");
            });
            Ok::<_, SandboxError>(())
        };
        let entered = std::thread::scope(|scope| scope.spawn(closed).join().unwrap());
        match entered {
            Err(SandboxError::Unsupported) if std::env::var_os("CI").is_none() => {
                eprintln!("SKIPPED: no Landlock here")
            }
            entered => entered.unwrap(),
        }
        assert_eq!(fs::read_to_string(at("other/file")).unwrap(), "other", "the other threads stay open");
    }

    #[test]
    fn a_folder_that_is_missing_is_named() {
        let sandbox = Sandbox { read: vec!["/no/such/folder".into()], ..Sandbox::default() };
        let refused = std::thread::spawn(move || sandbox.enter()).join().unwrap();
        assert!(matches!(&refused, Err(SandboxError::Path { path, .. }) if path == "/no/such/folder"), "{refused:?}");
    }
}
