//! A throw-away PostgreSQL from Debian's packages, for tests of the second catalog. Each test gets a database of its own.

use std::fs;
use std::os::unix::fs::chown;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use tempfile::TempDir;

/// A running server. It ends with this value, and with the process that started it.
#[derive(Debug)]
pub struct Postgres {
    dir: TempDir,
    bin: PathBuf,
    user: Option<(u32, u32)>,
    /// True if commits reach the disk, as in use; for measurements.
    writes_through: bool,
}

/// Gives a new store in `dir` a database in PostgreSQL if the variable `STRIDE_TEST_CATALOG` is `postgres`, or `durable`,
/// whose commits reach the disk.
///
/// # Panics
/// If PostgreSQL is not installed or does not start.
pub fn place_catalog(dir: &Path) {
    let asked = std::env::var("STRIDE_TEST_CATALOG").unwrap_or_default();
    let is_asked = matches!(&*asked, "postgres" | "durable");
    if !is_asked || fs::read_dir(dir).is_ok_and(|mut entries| entries.next().is_some()) {
        return;
    }
    let server = Postgres::shared().expect("PostgreSQL");
    fs::create_dir_all(dir).expect("a folder");
    fs::write(dir.join("CATALOG"), server.address(&server.create())).expect("a file");
}

/// Returns the folder of the newest installed server's programs.
fn programs() -> Option<PathBuf> {
    let versions = fs::read_dir("/usr/lib/postgresql").ok()?;
    let found = versions.filter_map(|entry| Some(entry.ok()?.path().join("bin")));
    found.filter(|bin| bin.join("initdb").exists()).max()
}

impl Postgres {
    /// Starts a server in a temporary folder. Returns `None` and says so if PostgreSQL is not installed.
    ///
    /// # Panics
    /// Panics if the server does not start.
    pub fn start() -> Option<Self> {
        let Some(bin) = programs() else {
            fixtures::skip(
                "PostgreSQL is not installed (Debian: `apt-get install postgresql`); its catalog is not tested",
            );
            return None;
        };
        let dir = tempfile::Builder::new().prefix("stride-pg").tempdir().expect("a temporary folder");
        // The server refuses to run as root.
        let user = nix::unistd::geteuid().is_root().then(|| {
            let nobody = nix::unistd::User::from_name("nobody").ok().flatten().expect("the user `nobody`");
            (nobody.uid.as_raw(), nobody.gid.as_raw())
        });
        if let Some((uid, gid)) = user {
            chown(dir.path(), Some(uid), Some(gid)).expect("a folder of the server's user");
        }
        let writes_through = std::env::var("STRIDE_TEST_CATALOG").is_ok_and(|catalog| catalog == "durable");
        let server = Self { dir, bin, user, writes_through };
        let data = server.data();
        server.run(
            "initdb",
            &["-D", &data, "-U", "stride", "-A", "trust", "-E", "UTF8", "--locale=C.UTF-8", "--no-sync"],
        );
        server.begin();
        Some(server)
    }

    /// Starts the stopped server.
    ///
    /// # Panics
    /// Panics if the server does not start.
    pub fn begin(&self) {
        let (data, socket) = (self.data(), self.dir.path().display().to_string());
        let log = format!("{socket}/log");
        let (fsync, settings) = match self.writes_through {
            true => ("on", ""),
            false => ("off", " -c autovacuum=off"),
        };
        let options = format!(
            "-c listen_addresses= -c unix_socket_directories={socket} -c max_connections=200 -c fsync={fsync}{settings}"
        );
        self.run("pg_ctl", &["-D", &data, "-w", "-l", &log, "-o", &options, "start"]);
    }

    /// Stops the server at once, as a crash does.
    ///
    /// # Panics
    /// Panics if the server does not stop.
    pub fn crash(&self) {
        self.run("pg_ctl", &["-D", &self.data(), "-w", "-m", "immediate", "stop"]);
    }

    fn data(&self) -> String {
        self.dir.path().join("data").display().to_string()
    }

    fn run(&self, program: &str, arguments: &[&str]) {
        let mut command = Command::new(self.bin.join(program));
        command.args(arguments).current_dir("/").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        if let Some((uid, gid)) = self.user {
            command.uid(uid).gid(gid);
        }
        let status = command.status().expect("a program of PostgreSQL");
        assert!(status.success(), "{program} {arguments:?}: {status}\n{}", self.log());
    }

    fn log(&self) -> String {
        fs::read_to_string(self.dir.path().join("log")).unwrap_or_default()
    }

    /// Returns the address of a database of this server.
    pub fn address(&self, database: &str) -> String {
        let socket = self.dir.path().display().to_string().replace('/', "%2F");
        format!("postgres://stride@localhost/{database}?host={socket}")
    }

    /// Runs a statement and returns its answer without decoration.
    ///
    /// # Panics
    /// Panics if the statement fails.
    pub fn sql(&self, database: &str, statement: &str) -> String {
        let host = self.dir.path();
        let psql = Path::new(&self.bin).join("psql");
        let asked =
            Command::new(psql).arg("-h").arg(host).args(["-U", "stride", "-d", database, "-XAtqc", statement]).output();
        let asked = asked.expect("psql");
        assert!(asked.status.success(), "{statement}: {}", String::from_utf8_lossy(&asked.stderr));
        String::from_utf8_lossy(&asked.stdout).trim().to_owned()
    }

    /// Creates an empty database and returns its name.
    pub fn create(&self) -> String {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let name = format!("t{}", NEXT.fetch_add(1, Ordering::Relaxed));
        self.sql("postgres", &format!("CREATE DATABASE {name}"));
        name
    }

    /// Returns a server that all tests of this process share; `None` if PostgreSQL is not installed. It ends with the process.
    pub fn shared() -> Option<&'static Self> {
        static SERVER: OnceLock<Option<Postgres>> = OnceLock::new();
        SERVER.get_or_init(|| {
            let server = Self::start()?;
            server.end_with_this_process();
            Some(server)
        });
        SERVER.get().and_then(Option::as_ref)
    }

    /// Starts a process that stops the server and removes its folder once this process has ended.
    fn end_with_this_process(&self) {
        let script = "while kill -0 $1 2>/dev/null; do sleep 0.5; done; kill -QUIT $(head -1 $2/data/postmaster.pid); sleep 1; rm -rf $2";
        let mut keeper = Command::new("sh");
        keeper.args(["-c", script, "keeper"]).arg(std::process::id().to_string()).arg(self.dir.path());
        keeper.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).process_group(0);
        drop(keeper.spawn().expect("a shell"));
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        self.crash();
    }
}
