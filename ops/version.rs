// Shared by the build scripts of the programs: builds `STRIDE_VERSION`, the text of `--version`, from commit, features
// and licence.
//
// The commit is that of the git checkout being built, or `STRIDE_COMMIT` where there is none, as in a tarball. A debug
// build has no commit in its version, because it would be recompiled after every commit.

use std::path::Path;
use std::process::Command;

/// Prints `STRIDE_VERSION` for the package being built, which is in a folder of the checkout.
pub(crate) fn print_version() {
    let variable = |name: &str| std::env::var(name).unwrap_or_default();
    println!("cargo::rerun-if-env-changed=STRIDE_COMMIT");
    let root = Path::new(&variable("CARGO_MANIFEST_DIR")).join("..");
    let commit = match variable("STRIDE_COMMIT") {
        given if !given.is_empty() => format!("commit {given}"),
        _ if variable("PROFILE") != "release" => "debug build".to_owned(),
        _ => match commit_of(&root) {
            Some((commit, changes_with)) => {
                changes_with.iter().for_each(|path| println!("cargo::rerun-if-changed={path}"));
                format!("commit {commit}")
            }
            None => "commit unknown".to_owned(),
        },
    };
    let mut features: Vec<String> = std::env::vars()
        .filter_map(|(name, _)| Some(name.strip_prefix("CARGO_FEATURE_")?.to_lowercase().replace('_', "-")))
        .filter(|name| name != "default")
        .collect();
    features.sort();
    let features = if features.is_empty() { "none".to_owned() } else { features.join(", ") };
    let version = variable("CARGO_PKG_VERSION");
    let licence = variable("CARGO_PKG_LICENSE");
    println!("cargo::rustc-env=STRIDE_VERSION={version} ({commit}; features: {features}; licence: {licence})");
}

/// The commit of the checkout at `root`, and the files that change with it. `None` without git, and in a folder of
/// another checkout.
pub(crate) fn commit_of(root: &Path) -> Option<(String, Vec<String>)> {
    let git = |arguments: &[&str]| {
        let said = Command::new("git").arg("-C").arg(root).args(arguments).output().ok()?;
        let text = String::from_utf8(said.stdout).ok()?.trim().to_owned();
        (said.status.success() && !text.is_empty()).then_some(text)
    };
    let top = git(&["rev-parse", "--show-toplevel"])?;
    if std::fs::canonicalize(top).ok()? != std::fs::canonicalize(root).ok()? {
        return None;
    }
    let commit = git(&["rev-parse", "--short=12", "HEAD"])?;
    // The log of HEAD grows with every commit, wherever the branch itself is stored.
    let paths = ["HEAD", "logs/HEAD"].map(|name| git(&["rev-parse", "--path-format=absolute", "--git-path", name]));
    Some((commit, paths.into_iter().flatten().filter(|path| Path::new(path).exists()).collect()))
}
