//! Closed outputs, such as `| head -3` or a closed terminal. Commands neither hang nor panic, and the exit code reports
//! the result.

use std::io::{BufRead as _, BufReader, pipe};
use std::process::{Child, ExitStatus, Stdio};

use cluster_tests::{Bench, wait_for};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// A command that ends with its test.
struct Ends(Child);

impl Ends {
    fn wait(&mut self, what: &str) -> ExitStatus {
        wait_for(what, || self.0.try_wait().expect("the child can be waited for"))
    }
}

impl Drop for Ends {
    fn drop(&mut self) {
        // Already ended, unless the test failed.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Runs a command with both outputs closed before it starts.
#[track_caller]
fn unread(bench: &Bench, arguments: &[&str]) -> Option<i32> {
    let (reader, writer) = pipe().expect("a pipe");
    drop(reader);
    let mut command = bench.command(arguments);
    command.env("RUST_LOG", "debug").stdout(writer.try_clone().expect("one pipe twice")).stderr(writer);
    Ends(command.spawn().expect("the trainer starts")).wait(&format!("{arguments:?} to end")).code()
}

#[test]
fn a_command_that_nobody_reads_ends_with_its_code() {
    let bench = Bench::new(TRAINER);
    let config = Bench::config("smoke.yaml");
    // The coordinator logs that the gate refuses. At this point a run with closed outputs once hung for ever.
    let run = ["run", &config, "--set", "release.promote.require=[\"latent_fid <= -1\"]"];
    let mut command = bench.command(&run);
    let mut child = Ends(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the trainer starts"));
    let mut first = String::new();
    BufReader::new(child.0.stderr.take().expect("piped")).read_line(&mut first).expect("a line");
    assert!(first.starts_with("run "), "{first}");
    drop(child.0.stdout.take());
    assert_eq!(child.wait("the run to end").code(), Some(1), "the gate fails");

    for arguments in [
        &run[..],
        &["run", &config, "--set", "nonsense"],
        &["plan", &config],
        &["plan", &config, "-o", "json"],
        &["status"],
        &["status", "--all"],
        &["logs"],
        &["registry", "list"],
        &["registry", "show", "nobody"],
        &["devices"],
        &["generate", "a person walks", "--model", "nobody", "-o", "x.gif"],
        &["cancel", "nothing"],
    ] {
        let said = bench.run(arguments);
        assert_eq!(
            unread(&bench, arguments),
            said.code,
            "{arguments:?}; with a reader: {}{}",
            said.stdout,
            said.stderr
        );
    }
}
