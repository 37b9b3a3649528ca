//! Arguments that several commands share.

use std::path::PathBuf;

use clap::Args;
use registry::Place;

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
