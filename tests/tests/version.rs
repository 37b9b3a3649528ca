//! The commit in `--version` is that of the checkout being built.

#[allow(dead_code, clippy::print_stdout, reason = "the rest is for build scripts, which print")]
#[path = "../../ops/version.rs"]
mod version;

use std::path::Path;
use std::process::Command;

fn git(folder: &Path, arguments: &[&str]) -> String {
    let identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"];
    let said = Command::new("git").arg("-C").arg(folder).args(identity).args(arguments).output().expect("git runs");
    assert!(said.status.success(), "git {arguments:?}: {}", String::from_utf8_lossy(&said.stderr));
    String::from_utf8(said.stdout).expect("UTF-8").trim().to_owned()
}

#[test]
fn a_checkout_has_its_commit_and_a_tarball_inside_another_checkout_has_none() {
    let folder = tempfile::tempdir().expect("a folder");
    assert_eq!(version::commit_of(folder.path()), None, "no git");
    git(folder.path(), &["init", "--quiet"]);
    assert_eq!(version::commit_of(folder.path()), None, "no commit");
    git(folder.path(), &["commit", "--quiet", "--allow-empty", "-m", "a"]);
    let (commit, changes_with) = version::commit_of(folder.path()).expect("a checkout");
    assert_eq!(commit, git(folder.path(), &["rev-parse", "HEAD"])[..12]);

    let before: Vec<_> = changes_with.iter().map(|path| std::fs::read(path).expect("a file that is watched")).collect();
    git(folder.path(), &["commit", "--quiet", "--allow-empty", "-m", "b"]);
    let after: Vec<_> = changes_with.iter().map(|path| std::fs::read(path).expect("a file that is watched")).collect();
    assert_ne!(before, after, "a commit changes a file that is watched");

    let inner = folder.path().join("unpacked");
    std::fs::create_dir(&inner).expect("a folder");
    assert_eq!(version::commit_of(&inner), None, "the commit is another project's");
    assert_eq!(version::commit_of(&inner.join("missing")), None);
}
