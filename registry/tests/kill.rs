//! `kill -9` at every fail point: partial writes are never visible, acknowledged data is never lost, and repeated work
//! gives the same digests.
//!
//! The test runs itself as a child process that saves checkpoints and records in a file what was acknowledged.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, ExitStatus};

use common::{artifact, fence, grant, metrics, open};
use protocol::{ArtifactKind, Digest, TaskId};
use registry::{Write, failpoints};
use serde_json::json;

const DIR: &str = "STRIDE_KILL_TEST_DIR";
const STEPS: u64 = 4;

/// Does nothing unless it is the child.
#[test]
fn child() {
    let Ok(dir) = std::env::var(DIR) else { return };
    failpoints::arm_from_env();
    let dir = Path::new(&dir);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let store = open(&dir.join("store")).await;
        let task = TaskId::new("r/s");
        let from = store.latest_checkpoint(&task).await.unwrap().map_or(0, |c| c.step);
        let granted = common::notes(&store).await.len() as u64 + 1;
        store
            .write(vec![
                fence("r/s", granted),
                Write::Facts { seq: granted, facts: json!({ "granted": granted }).to_string() },
            ])
            .await
            .unwrap();
        for step in from + 1..=STEPS {
            // Shares a blob with every other checkpoint, like frozen weights.
            store.blobs().put(b"frozen").unwrap();
            let manifest = artifact(store.blobs(), ArtifactKind::Checkpoint, &"x".repeat(100_000 + step as usize));
            let write = Write::Checkpoint { grant: grant("r/s", granted), step, manifest, metrics: metrics(&[]) };
            store.write(vec![write]).await.unwrap();
            fs::write(dir.join("acknowledged"), step.to_string()).unwrap();
        }
    });
}

fn run_child(dir: &Path, fail_at: Option<&str>) -> ExitStatus {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "child", "--test-threads=1"]).env(DIR, dir).stdout(std::process::Stdio::null());
    match fail_at {
        Some(point) => command.env("STRIDE_FAILPOINT", point),
        None => command.env_remove("STRIDE_FAILPOINT"),
    };
    command.status().unwrap()
}

async fn whole(dir: &Path) -> Vec<(u64, Digest)> {
    let store = open(&dir.join("store")).await;
    let report = store.fsck().await.unwrap();
    assert!(report.problems.is_empty(), "{:?}", report.problems);
    assert!(fs::read_dir(dir.join("store/staging")).unwrap().next().is_none());
    let checkpoints = store.checkpoints(&TaskId::new("r/s")).await.unwrap();
    let acknowledged = fs::read_to_string(dir.join("acknowledged")).map_or(0, |text| text.parse().unwrap_or(0));
    assert!(
        checkpoints.first().map_or(0, |c| c.step) >= acknowledged,
        "acknowledged {acknowledged}, stored {checkpoints:?}"
    );
    checkpoints.iter().map(|c| (c.step, c.manifest)).collect()
}

#[tokio::test]
async fn a_kill_at_any_point_leaves_a_whole_store_that_goes_on_to_the_same_end() {
    let undisturbed = tempfile::tempdir().unwrap();
    assert!(run_child(undisturbed.path(), None).success());
    let expected = whole(undisturbed.path()).await;
    assert_eq!(expected.len() as u64, STEPS);

    for point in failpoints::ALL {
        // At the very first pass, during the first checkpoint, and some checkpoints later.
        for nth in [1, 2, 3, 6] {
            let dir = tempfile::tempdir().unwrap();
            let fail_at = format!("{point}@{nth}");
            let status = run_child(dir.path(), Some(&fail_at));
            if status.success() && nth > STEPS {
                // There are fewer commits than that.
                assert!(point.starts_with("db::"), "{fail_at} was never reached");
            } else {
                assert_eq!(status.signal(), Some(9), "{fail_at}: {status}");
            }
            whole(dir.path()).await;
            assert!(run_child(dir.path(), None).success(), "{fail_at}: the second run");
            assert_eq!(whole(dir.path()).await, expected, "{fail_at}");
        }
    }
}
