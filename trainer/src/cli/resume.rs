//! `trainer resume`: continues a run, on its server or in this process.

use clap::Args;

use super::args::{self, command_line};
use super::remote;
use crate::client::Target;
use crate::local::run;
use crate::reader::Reader;
use crate::report::print::Output;
use crate::report::problem::Result;
use crate::report::summary;

#[derive(Debug, Args)]
pub(super) struct ResumeArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    #[command(flatten)]
    target: Target,
    /// Number of worker processes, when no server is running
    #[arg(long, value_name = "N", value_parser = args::count, allow_negative_numbers = true)]
    workers: Option<usize>,
    /// Format of the result
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

pub(super) async fn resume(args: ResumeArgs) -> Result<u8> {
    // Find the run first: nothing is started for a run that does not exist.
    let reader = Reader::open(&args.target).await?;
    let found = reader.find(&args.run).await?;
    let client = match reader {
        Reader::Server(client) => client,
        Reader::Store(records) => {
            // No server holds the store, so this process does the work.
            records.close().await;
            let options = run::Options {
                store: args.target.store,
                blobs: None,
                workers: args.workers,
                output: args.output,
                ui: false,
                command: command_line(),
            };
            return run::run(run::Request::Resume(found.run), options).await;
        }
    };
    let view = client.control(&found.run, "resume").await?;
    let whys = summary::whys(client.settings(&view.run).await?);
    remote::show(&view, &whys, args.output);
    Ok(0)
}
