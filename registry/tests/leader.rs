//! Leadership of a catalog in PostgreSQL: a stand-by takes over from a leader that was killed or stopped, and what the former
//! leader still tries is refused. Each remedy is taken out once, and is then missed.
//!
//! The leader is this test program again, as a child process.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cluster_tests::postgres::Postgres;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use registry::testing::slow::SlowBucket;
use registry::{Holder, LeaderTerms, OpenError, Place, PostgresCatalog, Store, Write, WriteError};
use serde_json::json;
use tempfile::TempDir;

const CHILD: &str = "STRIDE_LEADER_TEST";
/// Longest time until a stand-by leads.
const SOON: Duration = Duration::from_secs(4);
/// Time in which a stand-by without remedies does not lead.
const NEVER: Duration = Duration::from_secs(7);

fn fact(seq: u64, by: &str) -> Write {
    Write::Facts { seq, facts: json!({ "by": by }).to_string() }
}

fn catalog(address: &str, terms: LeaderTerms) -> PostgresCatalog {
    PostgresCatalog { address: address.parse().unwrap(), terms }
}

fn without_remedies() -> LeaderTerms {
    LeaderTerms { stalled: None, terminates: false, ..LeaderTerms::default() }
}

/// Leads and writes until it is superseded. Does nothing unless it is the child.
#[test]
fn child() {
    let Ok(text) = std::env::var(CHILD) else { return };
    let asked: Vec<&str> = text.split('|').collect();
    let [address, dir, stalls, has_timeout] = asked[..] else { panic!("{text}") };
    let dir = Path::new(dir);
    let terms = if has_timeout == "yes" { LeaderTerms::default() } else { without_remedies() };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let store = lead(&catalog(address, terms), dir).await.unwrap();
        for seq in 1.. {
            if seq == 10 {
                if stalls == "yes" {
                    fail::cfg("db::before_commit", "sleep(6000)").unwrap();
                }
                fs::write(dir.join("ready"), "").unwrap();
            }
            match store.write(vec![fact(seq, "the child")]).await {
                Ok(()) => tokio::time::sleep(Duration::from_millis(5)).await,
                Err(WriteError::Superseded { .. }) => break,
                Err(other) => panic!("{other}"),
            }
        }
        tokio::time::timeout(SOON, store.leadership().unwrap().superseded()).await.unwrap();
        assert!(!store.leadership().unwrap().leads());
        fs::write(dir.join("superseded"), "").unwrap();
    });
}

/// Opens the store with blobs that all folders share.
async fn lead(catalog: &PostgresCatalog, dir: &Path) -> Result<Store, OpenError> {
    let blobs: Place = dir.parent().unwrap().join("blobs").display().to_string().parse().unwrap();
    Store::open_on(catalog, dir, Some(&blobs), Holder::this_process("test")).await
}

struct Leader {
    server: &'static Postgres,
    database: String,
    dir: TempDir,
    child: Child,
}

impl Leader {
    fn start(stalls: bool, has_timeout: bool) -> Option<Self> {
        let server = Postgres::shared()?;
        let (database, dir) = (server.create(), tempfile::tempdir().unwrap());
        fs::create_dir_all(dir.path().join("a")).unwrap();
        fs::create_dir_all(dir.path().join("blobs")).unwrap();
        let word = |yes: bool| if yes { "yes" } else { "no" };
        let asked = format!(
            "{}|{}|{}|{}",
            server.address(&database),
            dir.path().join("a").display(),
            word(stalls),
            word(has_timeout)
        );
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "child", "--test-threads=1"]).env(CHILD, asked).stdout(Stdio::null());
        let leader = Self { server, database, dir, child: command.spawn().unwrap() };
        leader.wait_for("ready");
        Some(leader)
    }

    fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join("a").join(name)
    }

    fn wait_for(&self, name: &str) {
        let until = Instant::now() + cluster_tests::PATIENCE;
        while !self.file(name).exists() {
            assert!(Instant::now() < until, "no `{name}`");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(i32::try_from(self.child.id()).unwrap()), signal).unwrap();
    }

    fn facts(&self) -> String {
        self.server.sql(&self.database, "SELECT count(*) FROM facts WHERE facts LIKE '%the child%'")
    }

    fn epoch(&self) -> u64 {
        self.server.sql(&self.database, "SELECT epoch FROM leader").parse().unwrap()
    }

    /// Leads instead of the child. Returns the store, and the time until the row was taken.
    async fn stand_by(&self, terms: LeaderTerms, patience: Duration) -> Option<(Store, Duration)> {
        let (begun, before) = (Instant::now(), self.epoch());
        let catalog = catalog(&self.server.address(&self.database), terms);
        let dir = self.dir.path().join("b");
        let opening = async {
            Store::wait_to_lead(&catalog).await;
            loop {
                match lead(&catalog, &dir).await {
                    Ok(store) => return store,
                    Err(OpenError::Busy { .. }) => tokio::time::sleep(Duration::from_millis(50)).await,
                    Err(other) => panic!("{other}"),
                }
            }
        };
        let taken = async {
            while self.epoch() == before {
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            begun.elapsed()
        };
        let (store, took) = tokio::time::timeout(patience, async { tokio::join!(opening, taken) }).await.ok()?;
        Some((store, took))
    }

    /// Checks that the stand-by leads soon, and that the former leader writes nothing more and ends.
    async fn expect_take_over(mut self, terms: LeaderTerms) {
        let (store, took) = self.stand_by(terms, cluster_tests::PATIENCE).await.expect("it leads");
        assert!(took < SOON, "{took:?}");
        let before = self.facts();
        let next = store.recovery().await.unwrap().facts.len() as u64 + 1;
        store.write(vec![fact(next, "the stand-by")]).await.unwrap();
        // An error means that the child has ended.
        let _ = kill(Pid::from_raw(i32::try_from(self.child.id()).unwrap()), Signal::SIGCONT);
        if self.child.try_wait().unwrap().is_none() {
            self.wait_for("superseded");
        }
        self.child.wait().unwrap();
        assert_eq!(self.facts(), before, "a row of the former leader came late");
        store.write(vec![fact(next + 1, "the stand-by")]).await.unwrap();
        assert!(store.leadership().unwrap().leads());
    }
}

impl Drop for Leader {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test]
async fn a_stand_by_leads_soon_after_the_leader_was_killed() {
    let Some(mut leader) = Leader::start(false, true) else { return };
    leader.signal(Signal::SIGKILL);
    leader.child.wait().unwrap();
    leader.expect_take_over(LeaderTerms::default()).await;
}

#[tokio::test]
async fn a_stand_by_leads_soon_after_the_leader_was_stopped() {
    let Some(leader) = Leader::start(false, true) else { return };
    leader.signal(Signal::SIGSTOP);
    leader.expect_take_over(LeaderTerms::default()).await;
}

/// Starts a leader that sleeps inside a transaction, which holds the row. Going on, it tries to commit.
fn stalled(has_timeout: bool) -> Option<Leader> {
    let leader = Leader::start(true, has_timeout)?;
    let is_inside =
        "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND state = 'idle in transaction'";
    let until = Instant::now() + cluster_tests::PATIENCE;
    while leader.server.sql(&leader.database, is_inside) == "0" {
        assert!(Instant::now() < until, "the leader does not stall");
    }
    leader.signal(Signal::SIGSTOP);
    Some(leader)
}

#[tokio::test]
async fn the_server_ends_the_session_of_a_leader_that_stalls_inside_a_transaction() {
    let Some(leader) = stalled(true) else { return };
    leader.expect_take_over(LeaderTerms { terminates: false, ..LeaderTerms::default() }).await;
}

#[tokio::test]
async fn the_stand_by_ends_the_session_of_a_leader_that_stalls_inside_a_transaction() {
    let Some(leader) = stalled(false) else { return };
    leader.expect_take_over(LeaderTerms { stalled: None, ..LeaderTerms::default() }).await;
}

#[tokio::test]
async fn without_either_remedy_a_stalled_leader_is_never_replaced() {
    let Some(leader) = stalled(false) else { return };
    assert!(leader.stand_by(without_remedies(), NEVER).await.is_none(), "a remedy that is not needed");
}

#[tokio::test]
async fn a_leader_learns_by_its_own_clock_that_its_time_is_over() {
    let Some(server) = Postgres::shared() else { return };
    let dir = tempfile::tempdir().unwrap();
    let catalog =
        catalog(&server.address(&server.create()), LeaderTerms { relied_on: Duration::ZERO, ..LeaderTerms::default() });
    let store = lead(&catalog, &dir.path().join("a")).await.unwrap();
    assert!(!store.leadership().unwrap().leads());
    let refused = lead(&catalog, &dir.path().join("b")).await;
    assert!(matches!(refused, Err(OpenError::Busy { .. })), "{refused:?}");
    drop(store);
    // A leader that ends leaves the row at once.
    lead(&catalog, &dir.path().join("b")).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leader_goes_on_after_its_server_came_back_and_stores_nothing_twice() {
    let Some(server) = Postgres::start() else { return };
    let database = server.create();
    let dir = tempfile::tempdir().unwrap();
    let catalog = catalog(&server.address(&database), LeaderTerms::default());
    let bucket = SlowBucket::default();
    let blobs = bucket.place("p", dir.path());
    let store = Store::open_on_over(&catalog, dir.path(), blobs, Holder::this_process("test")).await.unwrap();
    let store = Arc::new(store);
    let writing = tokio::spawn({
        let store = Arc::clone(&store);
        async move {
            for seq in 1..=300 {
                store.write(vec![fact(seq, "the leader")]).await.unwrap();
            }
        }
    });
    for _ in 0..2 {
        tokio::task::block_in_place(|| {
            server.crash();
            server.begin();
        });
    }
    tokio::time::timeout(cluster_tests::PATIENCE, writing).await.unwrap().unwrap();
    assert_eq!(server.sql(&database, "SELECT count(*) FROM facts"), "300");
}
