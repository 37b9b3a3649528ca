//! `trainer run`: runs a pipeline on this machine.

use std::path::PathBuf;

use clap::Args;
use protocol::StageName;

use super::args::{self, BlobArgs, PipelineArgs, command_line};
use crate::local::{pipeline_file, run, verify};
use crate::report::print::Output;
use crate::report::problem::Result;

#[derive(Debug, Args)]
pub(super) struct RunArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Number of worker processes [default: one per core on CPU, one on a GPU]
    #[arg(long, value_name = "N", value_parser = args::count, allow_negative_numbers = true)]
    workers: Option<usize>,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    #[command(flatten)]
    blobs: BlobArgs,
    /// Stop after this stage
    #[arg(long, value_name = "STAGE")]
    until: Option<String>,
    /// Trains nothing; runs N steps of each training stage again and compares them with what is stored [default N: 20]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "20", value_parser = args::whole::<1>, conflicts_with_all = ["workers", "until"])]
    pub(super) verify: Option<u64>,
    /// Print a link to a page that shows the run live
    #[arg(long)]
    ui: bool,
    /// Format of the result
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

pub(super) async fn run_pipeline(args: RunArgs) -> Result<u8> {
    let file = pipeline_file::read_with_data(&args.pipeline.pipeline, &args.pipeline.set)?;
    if let Some(steps) = args.verify {
        return verify::verify(&file.pipeline, &args.store, steps, args.output).await;
    }
    let until = args.until.map(StageName::new);
    let options = run::Options {
        store: args.store,
        blobs: args.blobs.blobs,
        workers: args.workers,
        output: args.output,
        ui: args.ui,
        command: command_line(),
    };
    run::run(run::Request::Submit { file: Box::new(file), until }, options).await
}
