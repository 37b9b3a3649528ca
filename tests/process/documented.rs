//! Runs the book's cluster and the units of `ops/` unchanged except for a few replacements: our own folder for the
//! machine's root, this machine for `coordinator`, a free port, and a smaller pipeline.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use cluster_tests::documented::{self, words};
use cluster_tests::{Bench, PATIENCE, Running, wait_for};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Creates a folder with `trainer` and `registry`. If `registry` is not built beside the trainer, it runs the
/// equivalent `trainer registry`.
pub(crate) fn programs(dir: &Path) -> PathBuf {
    let bin = dir.join("bin");
    fs::create_dir_all(&bin).expect("a folder");
    let registry = Path::new(TRAINER).with_file_name("registry");
    std::os::unix::fs::symlink(TRAINER, bin.join("trainer")).expect("a link");
    if registry.exists() {
        std::os::unix::fs::symlink(registry, bin.join("registry")).expect("a link");
    } else {
        let script = format!("#!/bin/sh\nexec '{TRAINER}' registry \"$@\"\n");
        fs::write(bin.join("registry"), script).expect("a script");
        fs::set_permissions(bin.join("registry"), std::os::unix::fs::PermissionsExt::from_mode(0o755)).expect("ours");
    }
    bin
}

pub(crate) fn free_port() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("bound").port().to_string()
}

/// The commands of the chapter "Clusters", with the replacements of this test.
fn cluster(port: &str) -> Vec<String> {
    let lines = documented::run_by(&Bench::repository(), "tests/process/documented.rs");
    let smoke = Bench::config("smoke.yaml");
    let here = |line: String| {
        let line = line.replace("coordinator", "localhost").replace("7700", port);
        line.replace("configs/quickstart.yaml", &smoke).replace("quickstart@", "smoke@")
    };
    lines.into_iter().map(here).collect()
}

pub(crate) fn bash(dir: &Path, preamble: &str, line: &str) -> Command {
    let mut command = Command::new("bash");
    let path = format!("{}:{}", dir.join("bin").display(), std::env::var("PATH").unwrap_or_default());
    command.args(["-euc", &format!("{preamble}\n{line}")]).current_dir(dir).env("PATH", path).stdin(Stdio::null());
    for (name, _) in std::env::vars() {
        if name.starts_with("STRIDE_") {
            command.env_remove(name);
        }
    }
    command
}

fn has_openssl() -> bool {
    let found = Command::new("openssl").arg("version").output().is_ok_and(|output| output.status.success());
    if !found {
        fixtures::skip("the documented commands make a certificate with openssl, which is not here");
    }
    found
}

#[test]
fn the_cluster_of_the_book() {
    if !has_openssl() {
        return;
    }
    let bench = Bench::new(TRAINER);
    let dir = bench.path();
    programs(dir);
    let port = free_port();
    let (mut preamble, mut running, mut ran) = (String::new(), Vec::new(), 0);
    for line in cluster(&port) {
        ran += 1;
        println!("$ {line}");
        if line.starts_with("umask") || line.starts_with("export") {
            preamble += &format!("{line}\n");
        } else if line.starts_with("trainer serve") || line.starts_with("trainer worker join") {
            let log = dir.join(format!("{ran}.log"));
            let mut process = Running::logged(&mut bash(dir, &preamble, &format!("exec {line}")), &log);
            wait_for("the server to listen, or the worker to be sent off", || {
                assert!(process.alive(), "{line} ended:\n{}", fs::read_to_string(&log).unwrap_or_default());
                (line.contains("worker") || dir.join(".stride/token").exists()).then_some(())
            });
            running.push(process);
        } else {
            let said = Running::start(bash(dir, &preamble, &line)).wait();
            assert_eq!(said.code, Some(0), "{line}\n{}\n{}", said.stdout, said.stderr);
            if line.starts_with("trainer status") {
                assert!(said.stdout.contains("finished"), "{}", said.stdout);
            }
            if line.starts_with("registry list") {
                assert!(said.stdout.contains("smoke"), "{}", said.stdout);
            }
        }
    }
    assert!(running.len() == 2 && ran >= 12, "{} of {ran} commands keep running", running.len());
    assert!(dir.join("model/manifest.json").exists(), "the client has the files");
}

/// The keys of a unit, each with its last value.
fn unit(name: &str) -> (String, BTreeMap<String, String>) {
    let text = fs::read_to_string(Bench::repository().join("ops").join(name)).expect("a unit");
    let pairs = text.lines().filter(|line| !line.starts_with('#')).filter_map(|line| line.split_once('='));
    let keys = pairs.map(|(key, value)| (key.to_owned(), value.to_owned())).collect();
    (text, keys)
}

#[test]
fn the_units_of_systemd() {
    if !has_openssl() {
        return;
    }
    let bench = Bench::new(TRAINER);
    let dir = bench.path();
    let root = dir.join("root");
    for folder in ["etc/stride", "var/lib/stride", "var/cache", "srv/data", "usr/local"] {
        fs::create_dir_all(root.join(folder)).expect("a folder");
    }
    let bin = programs(dir);
    std::os::unix::fs::symlink(bin, root.join("usr/local/bin")).expect("a link");
    let port = free_port();
    // Create tokens and certificate as in the book, at the paths that the units use.
    for line in cluster(&port).iter().take_while(|line| !line.starts_with("trainer")) {
        let etc = root.join("etc/stride");
        let mut command = bash(dir, "umask 077", line);
        let said = Running::start({
            command.current_dir(&etc);
            command
        });
        assert_eq!(said.wait().code, Some(0), "{line}");
    }
    let here = |text: &str| {
        let mut text = text.replace("coordinator", "localhost").replace("7700", &port);
        for folder in ["/usr/local/bin/", "/var/lib/stride", "/srv/data", "/etc/stride"] {
            text = text.replace(folder, &format!("{}{folder}", root.display()));
        }
        text.replace("%H-%i", "here-1").replace("%C/stride-%i", &root.join("var/cache").display().to_string())
    };
    let start = |line: &str, environment: &BTreeMap<String, String>, log: &str| {
        let words = words(&here(line));
        let mut command = Command::new(&words[0]);
        command.args(&words[1..]).current_dir(&root).env_clear().envs(environment).stdin(Stdio::null());
        Running::logged(&mut command, &dir.join(log))
    };

    let (_, server) = unit("stride.service");
    let mut serve = start(&server["ExecStart"], &BTreeMap::new(), "serve.log");
    let token = root.join("var/lib/stride/store/token");
    wait_for("the server to start", || {
        assert!(serve.alive(), "{}", fs::read_to_string(dir.join("serve.log")).unwrap_or_default());
        token.exists().then_some(())
    });

    let (text, worker) = unit("stride-worker@.service");
    assert_eq!(worker["EnvironmentFile"], "/etc/stride/worker.env");
    // Only systemd can enforce these; that they are there is all that can be tested here.
    assert_eq!(worker["IPAddressDeny"], "any");
    assert!(worker["IPAddressAllow"].starts_with("localhost ") && !worker["IPAddressAllow"].contains("any"));
    // The environment file in the unit's own comment.
    let shown = text.lines().filter_map(|line| line.strip_prefix("#   ")).filter_map(|line| line.split_once('='));
    let environment: BTreeMap<String, String> = shown
        .map(|(name, value)| (name.to_owned(), here(value)))
        .filter(|(name, _)| name.starts_with("STRIDE_"))
        .collect();
    assert_eq!(environment.len(), 4, "{environment:?}");
    let mut join = start(&worker["ExecStart"], &environment, "worker.log");

    let url = format!("https://localhost:{port}");
    let etc = |name: &str| root.join("etc/stride").join(name).display().to_string();
    let (me, ca) = (etc("me.token"), etc("tls.crt"));
    let options = ["--server", &url, "--token-file", &me, "--ca", &ca];
    let ask = |arguments: &[&str]| bench.run(&[arguments, &options].concat());
    wait_for("the worker to join", || {
        assert!(join.alive(), "{}", fs::read_to_string(dir.join("worker.log")).unwrap_or_default());
        ask(&["worker", "list"]).expect_code(0).stdout.contains("here-1").then_some(())
    });
    ask(&["submit", &Bench::config("smoke.yaml"), "--until", "vae", "--follow"]).expect_code(0);
    assert!(ask(&["status"]).expect_code(0).stdout.contains("vae"));
    ask(&["registry", "list"]).expect_code(0);

    // Errors for callers with a wrong token, no token or no certificate.
    let nodes = etc("nodes.token");
    let said = bench.run(&["registry", "list", "--server", &url, "--token-file", &nodes, "--ca", &ca]).expect_code(5);
    assert!(said.stderr.contains("`nodes` has the scope worker"), "{}", said.stderr);
    let said = bench.run(&["status", "--server", &url, "--ca", &ca]).expect_code(5);
    assert!(said.stderr.contains("--token-file"), "{}", said.stderr);
    let said = bench.run(&["status", "--server", &url, "--token-file", &me]).expect_code(6);
    assert!(said.stderr.contains("certificate"), "{}", said.stderr);
    let plain = format!("http://localhost:{port}");
    let said = bench.run(&["status", "--server", &plain, "--token-file", &me]).expect_code(1);
    assert!(said.stderr.contains("speaks TLS") && said.stderr.contains("https://"), "{}", said.stderr);

    // SIGTERM, as systemd sends it.
    join.signal(nix::sys::signal::Signal::SIGTERM);
    assert_eq!(join.wait().code, Some(0));
    serve.signal(nix::sys::signal::Signal::SIGTERM);
    assert_eq!(serve.wait().code, Some(0));
    assert!(!token.exists() && PATIENCE.as_secs() > 0);
}

#[test]
fn the_container_file_builds_what_there_is() {
    let root = Bench::repository();
    let text = fs::read_to_string(root.join("ops/Containerfile")).expect("a container file");
    let line =
        |start: &str| text.lines().find(|line| line.starts_with(start)).unwrap_or_else(|| panic!("no `{start}`"));
    let manifest = fs::read_to_string(root.join("Cargo.toml")).expect("a manifest");
    let version = manifest.lines().find_map(|line| line.strip_prefix("rust-version = ")).expect("a version");
    assert!(
        line("FROM docker.io/library/rust:").contains(version.trim_matches('"')),
        "the toolchain is that of Cargo.toml"
    );
    let bases: Vec<&str> = text.lines().filter(|line| line.starts_with("FROM ")).collect();
    assert!(bases.len() == 2 && bases.iter().all(|base| base.contains("@sha256:")), "bases by digest: {bases:?}");

    let build = words(line("RUN cargo build"));
    for (_, program) in build.iter().zip(&build[1..]).filter(|(option, _)| *option == "--bin") {
        assert!(root.join(program).join("src/main.rs").exists(), "`{program}` is built");
        assert!(line("COPY --from=build").contains(&format!("/src/target/release/{program}")), "`{program}` is copied");
    }
    let entry: Vec<String> = serde_json::from_str(line("ENTRYPOINT").trim_start_matches("ENTRYPOINT ")).expect("JSON");
    let arguments: Vec<String> = serde_json::from_str(line("CMD").trim_start_matches("CMD ")).expect("JSON");
    assert_eq!(entry, ["trainer"]);
    let bench = Bench::new(TRAINER);
    bench.run(&arguments.iter().map(String::as_str).collect::<Vec<_>>()).expect_code(0);

    // The commands in the comments parse: `plan` replaces `run`, and `serve` binds no port.
    let inside = |comment: &str| {
        let line = text.lines().find(|line| line.contains(comment)).expect("a comment with a command");
        words(line.split_once(" stride ").expect("the image's name").1)
    };
    let run = inside("Runs the quickstart:");
    let pipeline = run[1].replace("/usr/share/stride", &root.display().to_string());
    assert!(run[0] == "run" && Path::new(&pipeline).exists(), "{run:?}");
    bench.run(&["plan", &pipeline]).expect_code(0);
    let serve = inside("Serves:");
    let serve: Vec<&str> = serve.iter().map(String::as_str).collect();
    let said = bench.run(&serve).expect_code(2);
    assert!(said.stderr.contains("/etc/stride/tokens"), "it wants the file that the comment mounts: {}", said.stderr);
}

/// Plans every pipeline in the documents, and every shipped one.
#[test]
fn every_pipeline_of_the_documents_and_of_configs_can_be_planned() {
    let root = Bench::repository();
    let bench = Bench::new(TRAINER);
    let mut planned = 0;
    let mut plan = |place: &str, path: &Path| {
        let path = path.display().to_string();
        let said = bench.run(&["plan", "--no-time", &path]);
        assert!(said.code == Some(0), "{place}: {}", said.stderr);
        planned += 1;
    };
    for document in documented::all(&root) {
        for (line, text) in documented::pipelines(&document) {
            let path = bench.path().join("shown.yaml");
            fs::write(&path, text).expect("written");
            plan(&format!("{}:{line}", document.display()), &path);
        }
    }
    for folder in ["configs", "docs/results"] {
        for entry in fs::read_dir(root.join(folder)).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.extension().is_some_and(|extension| extension == "yaml") {
                plan(&path.display().to_string(), &path);
            }
        }
    }
    assert!(planned >= 30, "only {planned} pipelines were found");
}

#[test]
fn a_version_says_what_was_built_and_under_which_licence() {
    let bench = Bench::new(TRAINER);
    let said = bench.run(&["--version"]).expect_code(0).stdout;
    let line = said.lines().next().expect("a line");
    assert!(line.starts_with(&format!("trainer {} (", env!("CARGO_PKG_VERSION"))), "{line}");
    assert!(line.contains("debug build;") || line.contains("commit "), "{line}");
    assert!(line.contains("features: ") && line.contains("flex"), "{line}");
    assert!(line.contains("licence: MIT OR Apache-2.0"), "{line}");
    let root = Bench::repository();
    let readme = fs::read_to_string(root.join("README.md")).expect("a README");
    for (name, words) in [("LICENSE-MIT", "Permission is hereby granted"), ("LICENSE-APACHE", "Apache License")] {
        let text = fs::read_to_string(root.join(name)).expect("a licence");
        assert!(text.contains(words) && readme.contains(&format!("]({name})")), "{name}");
    }
}

/// Runs the examples of `--help` that need no model, and checks their output.
#[test]
fn a_shell_and_a_manual_get_what_they_read() {
    let bench = Bench::new(TRAINER);
    for (shell, part) in [("bash", "complete -F"), ("zsh", "#compdef trainer"), ("fish", "complete -c trainer")] {
        let script = bench.run(&["completions", shell]).expect_code(0).stdout;
        assert!(script.contains(part) && script.contains("generate"), "{shell}: {} bytes", script.len());
    }
    bench.run(&["man", "pages"]).expect_code(0);
    for page in ["trainer.1", "trainer-run.1", "trainer-worker-join.1"] {
        let text = fs::read_to_string(bench.path().join("pages").join(page)).expect("a page");
        assert!(text.contains(".TH"), "{page}");
    }
}

#[test]
fn a_doctor_says_what_is_missing_and_what_to_do() {
    let bench = Bench::new(TRAINER);
    let said = bench.run(&["doctor"]).expect_code(0).stdout;
    assert!(
        said.contains("warn  store    there is no store in `.stride`; `trainer run PIPELINE` creates one"),
        "{said}"
    );
    assert!(said.contains("ok    device   `flex`") && said.contains("  disk  "), "{said}");
    bench.run(&["run", &Bench::config("smoke.yaml"), "--until", "dataset", "--workers", "1"]).expect_code(0);
    let said = bench.run(&["doctor", "-o", "json"]).expect_code(0).json();
    let findings = said["findings"].as_array().expect("findings");
    let store = findings.iter().find(|finding| finding["what"] == "store").expect("the store");
    assert_eq!((&store["state"], &store["hint"]), (&"ok".into(), &serde_json::Value::Null));
    let said = bench.run(&["doctor", "--server", "http://127.0.0.1:1"]).expect_code(1).stdout;
    let line = said.lines().find(|line| line.contains("server")).expect("the server");
    assert!(line.starts_with("FAIL") && line.contains("trainer serve"), "{line}");
    assert!(bench.path().read_dir().expect("a folder").count() == 1, "it writes nothing but what the run wrote");
}
