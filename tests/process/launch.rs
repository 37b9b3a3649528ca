//! Runs the commands of the chapter "Clusters" about `trainer launch`, unchanged except for a few replacements: our own
//! folder for shared ones, the CPU for the GPU, and shorter times. Slurm is a real one. `kubectl` and `ssh` are
//! stand-ins that start real workers here.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;

use cluster_tests::slurm::Slurm;
use cluster_tests::{Bench, Running, documented, wait_for};
use nix::sys::signal::Signal;

use crate::documented::{bash, free_port, programs};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Acts as `kubectl` for the calls of the book and of the launcher: a Job is a file and a process.
const KUBECTL: &str = r#"#!/usr/bin/env python3
import json, os, pathlib, signal, subprocess, sys
state = pathlib.Path(os.environ["KUBERNETES_STAND_IN"])
words, fields, options = [], {}, iter(sys.argv[1:])
for word in options:
    if word in ("-n", "-f", "-k", "-l", "-o"):
        fields[word] = next(options)
    elif not word.startswith("-"):
        words.append(word)
def alive(job):
    try:
        # A process that has ended and that nothing waits for is no longer alive.
        return ") Z " not in pathlib.Path(f"/proc/{job['pid']}/stat").read_text()
    except OSError:
        return False
jobs = {path.stem: json.loads(path.read_text()) for path in state.glob("*.json")}
if words[0] == "apply" or words[:2] == ["create", "secret"]:
    files = [word.split("=", 1)[1] for word in sys.argv if word.startswith("--from-file=")]
    sys.exit(0 if all(os.path.exists(file) for file in files) else 1)
elif words[:2] == ["get", "cronjob"]:
    assert words[2] == "stride-worker", words
    arguments = ["worker", "join", os.environ["STAND_IN_SERVER"], "--token-file=" + os.environ["STAND_IN_TOKEN"]]
    pod = {"spec": {"containers": [{"name": "worker", "args": arguments}]}}
    print(json.dumps({"spec": {"jobTemplate": {"spec": {"completionMode": "Indexed", "template": pod}}}}))
elif words[:2] == ["get", "jobs"]:
    key, value = fields["-l"].split("=")
    items = []
    for name, job in jobs.items():
        if job["labels"].get(key) == value:
            over = [] if alive(job) else [{"type": "Complete", "status": "True"}]
            metadata = {"name": name} | ({"deletionTimestamp": "2026-01-01T00:00:00Z"} if job["deleted"] and alive(job) else {})
            items.append({"metadata": metadata, "status": {"ready": 1, "conditions": over}})
    print(json.dumps({"items": items}))
elif words[0] == "create":
    job = json.load(sys.stdin)
    name, arguments = job["metadata"]["name"], job["spec"]["template"]["spec"]["containers"][0]["args"]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("STRIDE_")}
    log = open(state / f"{name}.log", "w")
    process = subprocess.Popen([os.environ["STAND_IN_TRAINER"], *arguments], env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
    (state / f"{name}.json").write_text(json.dumps({"pid": process.pid, "labels": job["metadata"]["labels"], "deleted": False}))
elif words[:2] == ["delete", "job"]:
    job = jobs[words[2]]
    if alive(job):
        os.kill(job["pid"], signal.SIGTERM)
    (state / f"{words[2]}.json").write_text(json.dumps(job | {"deleted": True}))
else:
    sys.exit(f"no such call: {sys.argv}")
"#;

/// Runs the script of `ssh` here, and marks its processes with the name of the machine.
const SSH: &str = r#"#!/bin/sh
while case "$1" in -*) true;; *) false;; esac; do shift; done
export STAND_IN_HOST="$1"
exec sh -c "$2"
"#;

/// Shows the processes of one machine of that `ssh`.
const PS: &str = r#"#!/bin/sh
[ -n "$STAND_IN_HOST" ] || exec /bin/ps "$@"
/bin/ps "$@" | while read -r pid rest; do
    case "$pid" in
        [0-9]*) grep -qz "^STAND_IN_HOST=$STAND_IN_HOST\$" "/proc/$pid/environ" 2>/dev/null || continue;;
    esac
    echo "$pid $rest"
done
"#;

struct Site {
    bench: Bench,
    url: String,
    server: Running,
    engine: &'static str,
    /// Settings of every command.
    preamble: String,
}

impl Site {
    /// A server with the tokens of the book.
    fn start(engine: &'static str) -> Self {
        let bench = Bench::new(TRAINER);
        let dir = bench.path();
        programs(dir);
        let secrets = "me admin token-of-the-user-0123456789\nnodes worker token-of-the-workers-0123456789\n";
        fs::write(dir.join("tokens"), secrets).expect("tokens");
        for (line, file) in secrets.lines().zip(["me.token", "nodes.token"]) {
            fs::write(dir.join(file), format!("{line}\n")).expect("a token");
        }
        for file in ["tokens", "me.token", "nodes.token"] {
            fs::set_permissions(dir.join(file), fs::Permissions::from_mode(0o600)).expect("ours");
        }
        let tokens = documented::run_by(&Bench::repository(), "tests/process/launch.rs, tokens").join("\n");
        let tokens = tokens.replace("openssl rand -hex 32", "echo token-of-the-launcher-0123456789");
        assert_eq!(Running::start(bash(dir, "", &tokens)).wait().code, Some(0));
        let port = free_port();
        let url = format!("http://127.0.0.1:{port}");
        let serve = format!("exec trainer serve --bind 127.0.0.1:{port} --token-file tokens");
        let mut server = Running::logged(&mut bash(dir, "", &serve), &dir.join("serve.log"));
        wait_for("the server to listen", || {
            assert!(server.alive(), "{}", fs::read_to_string(dir.join("serve.log")).unwrap_or_default());
            dir.join(".stride/token").exists().then_some(())
        });
        let preamble = format!("export STRIDE_SERVER={url} STRIDE_TOKEN_FILE=launcher.token\n");
        Self { bench, url, server, engine, preamble }
    }

    fn program(&self, name: &str, text: &str) {
        let path = self.bench.path().join("bin").join(name);
        fs::write(&path, text).expect("a program");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("ours");
    }

    fn set(&mut self, name: &str, value: impl std::fmt::Display) {
        self.preamble += &format!("export {name}='{value}'\n");
    }

    /// The commands of the engine's section.
    fn lines(&self) -> Vec<String> {
        let engine = self.engine;
        let lines = documented::run_by(&Bench::repository(), &format!("tests/process/launch.rs, {engine}"));
        let name = format!("t{}-{engine}", std::process::id());
        let here = |line: String| {
            let line = line.replace("/shared/", &format!("{}/", self.bench.path().display()));
            let line = line.replace("--backend cuda", "--backend flex").replace("--idle 10m", "--idle 2s");
            let line =
                line.replace("ops/kubernetes", &Bench::repository().join("ops/kubernetes").display().to_string());
            let named = |verb: &str, line: String| line.replace(verb, &format!("{verb} --name {name}"));
            let line = named(&format!("launch {engine}"), line);
            named(&format!("launch stop {engine}"), named(&format!("launch status {engine}"), line))
        };
        lines.into_iter().map(here).collect()
    }

    fn said(&self, line: &str) -> String {
        let said = Running::start(bash(self.bench.path(), &self.preamble, line)).wait();
        assert_eq!(said.code, Some(0), "{line}\n{}\n{}", said.stdout, said.stderr);
        said.stdout
    }

    /// Runs each command of the section: the launcher works on a run, its worker leaves, and a second one is stopped.
    fn check(self) {
        let lines = self.lines();
        let (mut launched, mut ran) = (None, 0);
        let dir = self.bench.path().to_owned();
        let log = dir.join("launch.log");
        let written = |path: &Path| fs::read_to_string(path).unwrap_or_default();
        let run = |seed: u32| {
            let smoke = Bench::config("smoke.yaml");
            format!(
                "trainer submit {smoke} --set seed={seed} --until dataset --follow --server {} --token-file me.token",
                self.url
            )
        };
        for line in &lines {
            ran += 1;
            if line.contains("--workers") {
                let mut launcher = Running::logged(&mut bash(&dir, &self.preamble, &format!("exec {line}")), &log);
                self.said(&run(1));
                wait_for("the launcher to end its idle worker", || {
                    assert!(launcher.alive(), "{}", written(&log));
                    written(&log).contains("asked to leave").then_some(())
                });
                self.said(&run(2));
                launched = Some(launcher);
            } else if line.contains("launch status") {
                let said = self.said(line);
                assert!(said.contains("OLDEST WAIT") && said.contains("STATE"), "{said}");
            } else if line.contains("launch stop") {
                let launcher: Running = launched.take().expect("a launcher");
                launcher.signal(Signal::SIGTERM);
                launcher.wait();
                self.said(line);
                let status = line.replace("launch stop", "launch status");
                let name = format!("t{}-", std::process::id());
                wait_for("all jobs to end", || (!self.said(&status).contains(&name)).then_some(()));
            } else {
                self.said(line);
            }
        }
        assert!(ran >= 3, "{lines:?}");
        assert!(written(&log).matches("submitted").count() >= 1, "{}", written(&log));
        self.server.signal(Signal::SIGTERM);
        self.server.wait();
    }
}

#[test]
fn a_launcher_on_slurm_as_the_book_shows_it() {
    let Some(slurm) = Slurm::start(2) else { return };
    let mut site = Site::start("slurm");
    site.set("SLURM_CONF", slurm.configuration().display());
    site.check();
}

#[test]
fn a_launcher_on_kubernetes_as_the_book_shows_it() {
    if !Command::new("python3").arg("--version").output().is_ok_and(|said| said.status.success()) {
        fixtures::skip("the stand-in for kubectl needs python3, which is not here");
        return;
    }
    let mut site = Site::start("kubernetes");
    let dir = site.bench.path().to_owned();
    fs::create_dir(dir.join("jobs")).expect("a folder");
    for file in ["tls.crt", "tls.key"] {
        fs::write(dir.join(file), "").expect("a file");
    }
    site.program("kubectl", KUBECTL);
    site.set("KUBERNETES_STAND_IN", dir.join("jobs").display());
    site.set("STAND_IN_TRAINER", TRAINER);
    site.set("STAND_IN_TOKEN", dir.join("nodes.token").display());
    let url = site.url.clone();
    site.set("STAND_IN_SERVER", url);
    site.check();
}

#[test]
fn a_launcher_by_ssh_as_the_book_shows_it() {
    let site = Site::start("ssh");
    site.program("ssh", SSH);
    site.program("ps", PS);
    site.check();
}

#[test]
fn a_launcher_of_this_machine_as_the_book_shows_it() {
    Site::start("local").check();
}
