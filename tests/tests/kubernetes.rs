//! The manifests of `ops/kubernetes` against the schemas of Kubernetes, and against what the launcher expects of them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

use cluster_tests::Bench;

/// The oldest version that has every field of the manifests as stable, and a newer one.
const VERSIONS: [&str; 2] = ["1.31", "1.37"];
const VALIDATOR: &str = "kubernetes-validate==1.37.*";

fn skip(why: &str) {
    assert!(std::env::var_os("CI").is_none(), "{why}");
    fixtures::skip(why);
}

/// Runs a command. The error has all that it printed: `venv` prints what failed to its standard output.
fn succeeds(command: &mut Command) -> Result<(), String> {
    let done = command.output().map_err(|e| e.to_string())?;
    let said = || {
        format!("{}, {}{}", done.status, String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr))
    };
    if done.status.success() { Ok(()) } else { Err(said()) }
}

/// A program made available by pip in an environment of the target folder.
fn validator() -> Option<PathBuf> {
    /// Tests run side by side, and only one of them makes the environment.
    static MAKING: Mutex<()> = Mutex::new(());
    let _making = MAKING.lock();
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| Bench::repository().join("target"), PathBuf::from);
    let environment = target.join("kubernetes-python");
    let program = environment.join("bin/kubernetes-validate");
    if !program.exists() {
        let mut make = Command::new("python3");
        make.args(["-m", "venv"]).arg(&environment);
        let mut install = Command::new(environment.join("bin/python"));
        install.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", VALIDATOR]);
        for (mut command, missing) in
            [(make, "python3 has no venv"), (install, "pip cannot install kubernetes-validate")]
        {
            if let Err(why) = succeeds(&mut command) {
                skip(&format!("{missing}: {why}"));
                return None;
            }
        }
    }
    Some(program)
}

fn base() -> PathBuf {
    Bench::repository().join("ops/kubernetes/base")
}

fn manifests() -> Vec<PathBuf> {
    let files = fs::read_dir(base()).expect("the manifests").map(|entry| entry.expect("an entry").path());
    let mut files: Vec<PathBuf> = files.filter(|path| !path.ends_with("kustomization.yaml")).collect();
    files.sort();
    files
}

/// Validates a file, and returns the validator's errors.
fn errors(program: &Path, file: &Path, version: &str) -> Option<String> {
    let output = Command::new(program).args(["--kubernetes-version", version, "--strict"]).arg(file).output();
    let output = output.expect("the validator runs");
    let said = String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout);
    // It only warns of a kind that it does not know.
    (!output.status.success() || said.contains("WARN")).then_some(said)
}

#[test]
fn the_manifests_of_kubernetes_are_valid_and_a_misspelt_key_is_not() {
    let Some(program) = validator() else { return };
    let files = manifests();
    assert!(files.len() >= 4, "{files:?}");
    for file in &files {
        for version in VERSIONS {
            assert_eq!(errors(&program, file, version), None, "{}", file.display());
        }
    }
    let folder = tempfile::tempdir().expect("a folder");
    let misspelt = [("worker.yaml", "podFailurePolicy"), ("server.yaml", "readOnlyRootFilesystem")];
    for (name, key) in misspelt {
        let text = fs::read_to_string(base().join(name)).expect("a manifest");
        let wrong = text.replacen(key, &key.replacen('o', "0", 1), 1);
        assert_ne!(text, wrong, "{name} has `{key}`");
        let file = folder.path().join(name);
        fs::write(&file, wrong).expect("written");
        let said = errors(&program, &file, VERSIONS[0]).unwrap_or_else(|| panic!("`{key}` of {name} is misspelt"));
        assert!(said.contains(&key.replacen('o', "0", 1)), "{said}");
    }
}

/// Checks the objects that `kubectl apply -k` would send, for both folders.
#[test]
fn kustomize_builds_the_manifests_for_one_namespace() {
    let Some(program) = validator() else { return };
    let has_kubectl = Command::new("kubectl").args(["version", "--client"]).output().is_ok_and(|o| o.status.success());
    if !has_kubectl {
        fixtures::skip("no kubectl here");
        return;
    }
    for (folder, queued) in [("base", false), ("kueue", true)] {
        let folder = Bench::repository().join("ops/kubernetes").join(folder);
        let output = Command::new("kubectl").arg("kustomize").arg(&folder).output().expect("kubectl runs");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(text.contains("kueue.x-k8s.io/queue-name: stride"), queued, "{text}");
        assert!(!text.contains("image: stride\n"), "each image is replaced");
        let file = tempfile::Builder::new().suffix(".yaml").tempfile().expect("a file");
        fs::write(file.path(), text).expect("written");
        assert_eq!(errors(&program, file.path(), VERSIONS[1]), None);
    }
}

/// Times, names and rights that the launcher and the worker rely on.
#[test]
fn the_template_of_workers_is_what_the_launcher_expects() {
    let read = |name: &str| fs::read_to_string(base().join(name)).expect("a manifest");
    let worker = read("worker.yaml");
    let launcher =
        fs::read_to_string(Bench::repository().join("trainer/launcher/src/kubernetes.rs")).expect("a source");
    assert!(launcher.contains("TEMPLATE: &str = \"stride-worker\"") && worker.contains("name: stride-worker"));
    for needed in ["suspend: true", "completionMode: Indexed", "type: DisruptionTarget", "restartPolicy: Never"] {
        assert!(worker.contains(needed), "{needed}");
    }
    let number = |key: &str| -> u64 {
        let (_, rest) = worker.split_once(key).unwrap_or_else(|| panic!("`{key}`"));
        let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
        digits.parse().expect("a number")
    };
    assert!(number("terminationGracePeriodSeconds: ") > number("--leave-within="), "a pod is killed after it has left");
    let server = read("server.yaml");
    for text in [&worker, &server] {
        for needed in ["runAsNonRoot: true", "readOnlyRootFilesystem: true", "drop: [ALL]"] {
            assert!(text.contains(needed), "{needed}");
        }
    }
    assert!(
        server.contains("type: Recreate")
            && server.contains("readinessProbe")
            && server.contains("PodDisruptionBudget")
    );
}
