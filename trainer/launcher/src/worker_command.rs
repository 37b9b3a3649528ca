//! The command line of the workers that a launcher starts.

use protocol::Labels;
use protocol::stage::Backend;

use crate::command::quoted;

/// The command line of a worker, without its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerCommand {
    /// The program on the machine of the worker.
    pub program: String,
    /// The coordinator's URL as the worker reaches it.
    pub url: String,
    pub backend: Backend,
    pub labels: Labels,
    /// Further arguments of `worker join`.
    pub more: Vec<String>,
}

impl WorkerCommand {
    /// Arguments after `worker join URL`.
    pub fn options(&self, worker: &str) -> Vec<String> {
        let mut options = vec!["--name".to_owned(), worker.to_owned()];
        options.extend(["--backend".to_owned(), self.backend.name().to_owned()]);
        for label in self.labels.iter() {
            options.extend(["--label".to_owned(), label.to_owned()]);
        }
        options.extend(self.more.iter().cloned());
        options
    }

    /// The command for a shell.
    pub fn line(&self, worker: &str) -> String {
        let mut words = vec![self.program.clone(), "worker".to_owned(), "join".to_owned(), self.url.clone()];
        words.extend(self.options(worker));
        words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ")
    }
}

/// Removes the launcher's own token from a shell's environment.
pub const WITHOUT_TOKEN: &str = "unset STRIDE_TOKEN STRIDE_TOKEN_FILE";
