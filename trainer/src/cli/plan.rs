//! `trainer plan`: shows what a run would do, and why.

use std::path::PathBuf;

use clap::Args;
use registry::{OpenError, ReadStore};

use super::args::PipelineArgs;
use crate::local::advice::advice;
use crate::local::{cost, pipeline_file, plan};
use crate::report::print::{self, Output};
use crate::report::problem::Result;

#[derive(Debug, Args)]
pub(super) struct PlanArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Tries no stage, and so omits parameters and times
    #[arg(long)]
    no_time: bool,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    /// Format of the plan
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

pub(super) async fn show_plan(args: PlanArgs) -> Result<u8> {
    let (file, missing) = pipeline_file::read_to_plan(&args.pipeline.pipeline, &args.pipeline.set)?;
    let store = match ReadStore::open(&args.store).await {
        Ok(store) => Some(store),
        Err(OpenError::NotAStore(_)) => None,
        Err(error) => return Err(error.into()),
    };
    let mut file = file;
    pipeline_file::resolve_versions(&mut file.pipeline, store.as_ref()).await?;
    let mut plan = plan::plan(&file.pipeline, store.as_ref()).await?;
    plan.missing = missing;
    if !args.no_time && plan.stages.iter().any(|step| step.action != "cached") {
        plan.estimate(&cost::estimates(&file.pipeline));
    }
    advice(&file.pipeline).iter().for_each(|note| print::note(&format!("note: {note}")));
    match args.output {
        Output::Json => print::json(&plan),
        Output::Table => print::out(&plan.screen(&file.pipeline)),
    }
    Ok(0)
}
