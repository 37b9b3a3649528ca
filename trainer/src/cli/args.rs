//! Arguments that several commands share.

use std::path::PathBuf;

use clap::Args;
use protocol::limits;
use registry::Place;

/// Parses a whole number of at least `LEAST`.
pub(super) fn whole<const LEAST: u64>(text: &str) -> Result<u64, String> {
    match text.parse::<u64>() {
        Ok(number) if number >= LEAST => Ok(number),
        _ => Err(format!("expected a whole number of {LEAST} or more")),
    }
}

/// As [`whole`], for counts.
pub(super) fn count(text: &str) -> Result<usize, String> {
    whole::<1>(text).and_then(|number| usize::try_from(number).map_err(|error| error.to_string()))
}

/// Parses the priority of a run.
pub(super) fn priority(text: &str) -> Result<i32, String> {
    let most = limits::PRIORITY;
    let priority = text.parse::<i32>().ok().filter(|priority| (-most..=most).contains(priority));
    priority.ok_or_else(|| format!("expected a whole number from -{most} to {most}"))
}

/// A pipeline file with overrides.
#[derive(Debug, Clone, Args)]
pub(super) struct PipelineArgs {
    /// The pipeline, a YAML file
    pub(super) pipeline: PathBuf,
    /// Overrides a key, such as `stages.vae.lr=1e-4`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
}

/// Location of a store's blobs.
#[derive(Debug, Args)]
pub(super) struct BlobArgs {
    /// Location of a new store's blobs, which the store remembers: another folder, s3://BUCKET/PREFIX,
    /// gs://BUCKET/PREFIX or az://CONTAINER/PREFIX; credentials come from AWS_*, GOOGLE_* or AZURE_* in the environment
    /// [default: the store's folder]
    #[arg(long, env = "STRIDE_BLOBS", value_name = "PLACE")]
    pub(super) blobs: Option<Place>,
}

/// The command as typed, for messages that suggest how to continue.
pub(super) fn command_line() -> String {
    let quoted = std::env::args().skip(1).map(|argument| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=@:,+".contains(c);
        if argument.chars().all(plain) { argument } else { format!("'{}'", argument.replace('\'', "'\\''")) }
    });
    std::iter::once("trainer".to_owned()).chain(quoted).collect::<Vec<_>>().join(" ")
}
