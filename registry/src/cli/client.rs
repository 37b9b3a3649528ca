//! Runs a command where it can be run: here if nobody holds the store, else at its holder.

use std::path::Path;
use std::time::{Duration, Instant};

use super::{Answer, Command, Output, Verb, error, print, run};
use crate::{Holder, OpenError, Store};

/// How long to wait for a holder without an address, such as another `registry` command, to end or to get one.
const PATIENCE: Duration = Duration::from_secs(5);
const BETWEEN: Duration = Duration::from_millis(50);

/// Runs a verb on the store in `dir` and prints the answer; returns the exit code.
pub async fn execute(verb: Verb, dir: &Path, output: Output) -> u8 {
    let answer = match verb.into_command() {
        Ok(command) => ask(command, dir).await,
        Err(e) => Answer::refused(error("invalid", format!("the folder does not resolve: {e}"), None)),
    };
    // A closed pipe (`| head`) is no failure of the command.
    let _ = print::show(&answer, output);
    answer.exit
}

/// Runs a command on the store in `dir`: here if nobody holds it, else at its holder.
pub async fn ask(command: Command, dir: &Path) -> Answer {
    let until = Instant::now() + PATIENCE;
    loop {
        let busy = match Store::open_existing(dir, Holder::this_process("registry")).await {
            Ok(store) => return run(command, &store).await,
            Err(e) => e,
        };
        let OpenError::Busy { holder, .. } = &busy else { return Answer::from(&busy) };
        let problem = match &holder.address {
            Some(address) => match post(address, &command).await {
                Ok(answer) => return answer,
                // Not reached at all, so nothing was done: it may be ending, and the store be free in a moment.
                Err(e) if e.is_connect() => format!("{busy}, which does not answer: {}", innermost(&e)),
                Err(e) => return unreachable_(&format!("{busy}, whose answer could not be read: {}", innermost(&e))),
            },
            None => format!("{busy}, which takes no requests"),
        };
        if Instant::now() >= until {
            return unreachable_(&problem);
        }
        tokio::time::sleep(BETWEEN).await;
    }
}

fn unreachable_(message: &str) -> Answer {
    Answer::refused(error(
        "unreachable",
        message,
        Some("wait for it to end, or see whether it hangs; then run the same command again"),
    ))
}

async fn post(address: &str, command: &Command) -> Result<Answer, reqwest::Error> {
    let client = reqwest::Client::builder().connect_timeout(Duration::from_secs(5)).build()?;
    client.post(format!("{address}/v1/registry")).json(command).send().await?.error_for_status()?.json().await
}

fn innermost(e: &dyn std::error::Error) -> String {
    let mut inner = e;
    while let Some(source) = inner.source() {
        inner = source;
    }
    inner.to_string()
}
