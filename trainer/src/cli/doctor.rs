//! `trainer doctor`: checks what commands need on this machine, with advice for each problem.
//!
//! It starts nothing and changes nothing.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use clap::Args;
use registry::doctor::{Finding, State, disk, permissions};
use registry::{OpenError, ReadStore, RunListQuery};

use crate::client::{Client, Target, shown};
use crate::report::print::{self, Output};
use crate::report::problem::{Result, exit};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  trainer doctor
  trainer doctor --store .stride -o json")]
pub(crate) struct DoctorArgs {
    #[command(flatten)]
    target: Target,
    /// Format of the findings
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

/// Runs all checks. Returns exit code 1 if one fails.
pub(crate) async fn doctor(args: DoctorArgs) -> Result<u8> {
    let dir = &args.target.store;
    let mut findings = vec![Finding::ok("version", env!("STRIDE_VERSION"))];
    findings.extend(devices());
    findings.extend(store(dir).await);
    findings.push(disk(dir));
    findings.extend(token_file(args.target.server.connection.token.token_file.as_deref()));
    findings.extend(server(&args.target).await);
    findings.push(program("ffmpeg", "`-o FILE.mp4` needs it; `.gif`, `.html` and `.png` do not"));
    let failed = findings.iter().any(|finding| finding.state == State::Fail);
    match args.output {
        Output::Json => print::json(&serde_json::json!({"schema_version": 1, "findings": findings})),
        Output::Table => findings.iter().for_each(|finding| print::out(&line(finding))),
    }
    Ok(if failed { exit::FAILED } else { 0 })
}

fn line(finding: &Finding) -> String {
    let state = match finding.state {
        State::Ok => "ok",
        State::Warn => "warn",
        State::Fail => "FAIL",
    };
    let Finding { what, found, .. } = finding;
    let hint = finding.hint.as_ref().map(|hint| format!("; {hint}")).unwrap_or_default();
    format!("{state:<4}  {what:<7}  {found}{hint}")
}

fn devices() -> Vec<Finding> {
    let here = models::device::available();
    let finding = |device: &models::device::DeviceInfo| {
        let backend = device.backend.name();
        match device.index {
            Some(index) => Finding::ok("device", format!("`{backend}` {index}: {}", device.name)),
            None => Finding::warn("device", format!("`{backend}` has no device"), device.note.clone()),
        }
    };
    here.iter().map(finding).collect()
}

async fn store(dir: &Path) -> Vec<Finding> {
    let name = shown(dir);
    let store = match ReadStore::open(dir).await {
        Ok(store) => store,
        Err(OpenError::NotAStore(_)) => {
            let hint = "`trainer run PIPELINE` creates one; --store selects another folder";
            return vec![Finding::warn("store", format!("there is no store in `{name}`"), hint)];
        }
        Err(error) => {
            let hint = error.hint();
            return vec![Finding::fail("store", error.to_string(), hint)];
        }
    };
    store.close().await;
    let mut findings = Vec::new();
    match ReadStore::holder_of(dir) {
        Ok(Some(holder)) => findings.push(Finding::ok("store", format!("`{name}`, held by {holder}"))),
        Ok(None) => {
            findings.push(Finding::ok("store", format!("`{name}`; no process holds it")));
            if dir.join("token").exists() {
                let found = format!("`{name}/token` was left by a process that was killed");
                findings.push(Finding::warn(
                    "store",
                    found,
                    "the token is no longer valid, and the next `trainer run` replaces the file",
                ));
            }
        }
        Err(error) => {
            let hint = error.hint();
            findings.push(Finding::fail("store", error.to_string(), hint));
        }
    }
    findings.extend(permissions(dir, &name));
    findings
}

fn token_file(path: Option<&Path>) -> Option<Finding> {
    let path = path?;
    let name = path.display();
    Some(match std::fs::metadata(path) {
        Err(error) => Finding::fail("token", format!("`{name}`: {error}"), "set the file with --token-file"),
        Ok(found) if !found.is_file() => {
            Finding::fail("token", format!("`{name}` is not a regular file"), "choose a regular file")
        }
        Ok(found) if found.permissions().mode() & 0o077 != 0 => {
            let says = format!("other users may read `{name}`");
            Finding::warn("token", says, format!("`chmod 600 {name}` prevents that"))
        }
        Ok(_) => Finding::ok("token", format!("other users cannot read `{name}`")),
    })
}

/// Checks the server that commands would use, if there is one.
async fn server(target: &Target) -> Option<Finding> {
    let asked = match Client::running(target).await {
        Ok(None) => return None,
        Ok(Some(client)) => client.run_list(&RunListQuery { limit: 1, ..RunListQuery::default() }).await,
        Err(problem) => Err(problem),
    };
    Some(match asked {
        Ok(_) => Finding::ok("server", "it answers and accepts the token"),
        Err(problem) => {
            let hint = problem.hint.unwrap_or_else(|| "start it with `trainer serve`".to_owned());
            Finding::fail("server", problem.error.to_string(), hint)
        }
    })
}

fn program(name: &'static str, hint: &str) -> Finding {
    let folders = std::env::var_os("PATH").unwrap_or_default();
    let found: Option<PathBuf> =
        std::env::split_paths(&folders).map(|folder| folder.join(name)).find(|path| path.is_file());
    match found {
        Some(path) => Finding::ok(name, path.display().to_string()),
        None => Finding::warn(name, "not found in PATH", hint),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_state_finding_and_what_to_do() {
        let (fine, full) =
            (Finding::ok("disk", "9 GiB are free"), Finding::fail("disk", "0 GiB are free", "remove some"));
        assert_eq!(line(&fine), "ok    disk     9 GiB are free");
        assert_eq!(line(&full), "FAIL  disk     0 GiB are free; remove some");
    }

    #[test]
    fn an_open_token_file_is_pointed_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let state = || token_file(Some(&path)).map(|finding| finding.state);
        assert_eq!(state(), Some(State::Fail), "it is not there");
        std::fs::write(&path, "x").unwrap();
        for (mode, expected) in [(0o644, State::Warn), (0o600, State::Ok)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(state(), Some(expected), "{mode:o}");
        }
        assert!(token_file(None).is_none());
    }
}
