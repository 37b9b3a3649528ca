//! Commands of engines, with a limit on their time.

use std::process::{Output, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use tokio::io::AsyncWriteExt as _;
use tokio::process::Command;

use crate::engine::EngineError;

/// Limit of one command. `sbatch` waits longer than this for a controller that is away.
pub const LIMIT: Duration = Duration::from_secs(20);
/// Bytes of a command's errors that are shown.
const SAID: usize = 500;

/// A program with its arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EngineCommand {
    pub program: String,
    pub arguments: Vec<String>,
    /// Text on its standard input.
    pub input: String,
}

impl EngineCommand {
    pub fn new(program: &str, arguments: impl IntoIterator<Item = impl Into<String>>) -> Self {
        let arguments = arguments.into_iter().map(Into::into).collect();
        Self { program: program.to_owned(), arguments, input: String::new() }
    }

    #[must_use]
    pub fn with_input(mut self, input: String) -> Self {
        self.input = input;
        self
    }

    /// Runs the command and returns its output. After `limit`, it is killed with all that it started.
    ///
    /// # Errors
    /// It cannot be started, it fails, or it hangs.
    pub async fn run(&self, limit: Duration) -> Result<String, EngineError> {
        let program = || self.program.clone();
        let mut command = Command::new(&self.program);
        command.args(&self.arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // A group of its own, so that children which hold the pipes open end with it.
        command.process_group(0).kill_on_drop(true);
        let missing = |error: std::io::Error| EngineError::Missing { program: program(), why: error.to_string() };
        let mut child = command.spawn().map_err(missing)?;
        let group = child.id().and_then(|id| i32::try_from(id).ok()).map(Pid::from_raw);
        let input = child.stdin.take();
        let work = async {
            if let Some(mut input) = input {
                // A command that reads nothing closes the pipe; its exit status tells more.
                let _ = input.write_all(self.input.as_bytes()).await;
            }
            child.wait_with_output().await
        };
        match tokio::time::timeout(limit, work).await {
            Ok(Ok(output)) => self.read(&output),
            Ok(Err(error)) => Err(missing(error)),
            Err(_) => {
                if let Some(group) = group {
                    // The group may have ended just now.
                    let _ = killpg(group, Signal::SIGKILL);
                }
                Err(EngineError::Hangs { program: program(), limit })
            }
        }
    }

    fn read(&self, output: &Output) -> Result<String, EngineError> {
        if output.status.success() {
            return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
        }
        let errors = String::from_utf8_lossy(&output.stderr);
        // The cause comes last: what stands before it is often a repetition.
        let errors = errors.trim();
        let skipped = errors.chars().count().saturating_sub(SAID);
        let mut said: String = errors.chars().skip(skipped).collect();
        if let (true, Some((_, whole))) = (skipped > 0, said.split_once('\n')) {
            said = whole.to_owned();
        }
        let said = if said.is_empty() { output.status.to_string() } else { protocol::printable(&said).into_owned() };
        Err(EngineError::Refused { program: self.program.clone(), said })
    }
}

/// Splits words into options, each with its value, and the other words. `takes_value` tells options whose value is the
/// next word.
pub fn split_options(words: Vec<String>, takes_value: impl Fn(&str) -> bool) -> (Vec<String>, Vec<String>) {
    let (mut options, mut others) = (Vec::new(), Vec::new());
    let mut words = words.into_iter();
    while let Some(word) = words.next() {
        if !word.starts_with('-') {
            others.push(word);
            continue;
        }
        let value = takes_value(&word).then(|| words.next()).flatten();
        options.push(word);
        options.extend(value);
    }
    (options, others)
}

/// A word for a POSIX shell.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,@%+".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[tokio::test]
    async fn a_hanging_command_ends_with_all_that_it_started() {
        // The grandchild keeps the pipe open.
        let command = EngineCommand::new("sh", ["-c", "sleep 60 & sleep 60"]);
        let begun = Instant::now();
        let error = command.run(Duration::from_millis(200)).await.expect_err("it hangs");
        assert!(matches!(error, EngineError::Hangs { .. }) && error.is_transient(), "{error}");
        assert!(begun.elapsed() < Duration::from_secs(20));
    }

    #[tokio::test]
    async fn a_failed_command_shows_its_errors() {
        let run = async |script: &str| EngineCommand::new("sh", ["-c", script]).run(LIMIT).await;
        assert_eq!(run("echo out; echo err >&2").await.as_deref(), Ok("out\n"));
        let error = run("echo no such partition >&2; exit 1").await.expect_err("it fails");
        assert_eq!(error.to_string(), "`sh` failed: no such partition");
        let error = run("for i in $(seq 60); do echo again $i >&2; done; echo the cause >&2; exit 1")
            .await
            .expect_err("it fails");
        let said = error.to_string();
        assert!(said.starts_with("`sh` failed: again ") && said.ends_with("\nthe cause"), "{said}");
        let error = EngineCommand::new("no-such-program", [""; 0]).run(LIMIT).await.expect_err("there is none");
        assert!(matches!(error, EngineError::Missing { .. }), "{error}");
        let echoed = EngineCommand::new("cat", [""; 0]).with_input("a job\n".into()).run(LIMIT).await;
        assert_eq!(echoed.as_deref(), Ok("a job\n"));
    }

    #[tokio::test]
    async fn a_quoted_word_reaches_the_program_unchanged() {
        for word in ["plain-1.0", "", "two words", "it's", "$(id)", "a\nb", "`x`;|&"] {
            let said =
                EngineCommand::new("sh", ["-c".to_owned(), format!("printf %s {}", quoted(word))]).run(LIMIT).await;
            assert_eq!(said.as_deref(), Ok(word));
        }
    }
}
