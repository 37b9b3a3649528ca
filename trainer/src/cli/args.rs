//! Arguments that several verbs have.

use std::path::PathBuf;

use clap::Args;
use registry::Place;

/// A pipeline on the command line.
#[derive(Debug, Clone, Args)]
pub(super) struct PipelineArgs {
    /// The pipeline, a YAML file
    pub(super) pipeline: PathBuf,
    /// Overrides a key, such as `stages.vae.lr=1e-4`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
}

/// Where a store's blobs lie.
#[derive(Debug, Args)]
pub(super) struct BlobArgs {
    /// Where the blobs of a new store are to lie, which remembers it: another folder, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or
    /// az://CONTAINER/PREFIX; credentials come from AWS_*, GOOGLE_* or AZURE_* in the environment [default: in the store's folder]
    #[arg(long, env = "STRIDE_BLOBS", value_name = "PLACE")]
    pub(super) blobs: Option<Place>,
}
