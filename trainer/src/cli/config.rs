//! `trainer config show` and `trainer devices`.

use clap::{Args, Subcommand};
use models::device::{self, DeviceInfo};
use serde_json::Value;

use super::args::PipelineArgs;
use crate::local::pipeline_file;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};

#[derive(Debug, Subcommand)]
pub(crate) enum ConfigVerb {
    /// Checks a pipeline and shows it with every default filled in
    #[command(after_help = "Example:\n  trainer config show configs/quickstart.yaml --set seed=7")]
    Show {
        #[command(flatten)]
        pipeline: PipelineArgs,
        /// Format of the pipeline: YAML or JSON
        #[arg(short, long, value_enum, default_value_t)]
        output: Output,
    },
}

#[derive(Debug, Args)]
pub(crate) struct DevicesArgs {
    /// Format of the list
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct SchemaArgs {
    /// Prints `docs/pipeline.md` instead, the reference of all stage kinds and their keys
    #[arg(long)]
    markdown: bool,
}

pub(crate) fn schema(args: &SchemaArgs) -> u8 {
    if args.markdown {
        print::out(pipeline::markdown().trim_end());
    } else {
        print::json(&pipeline::json_schema());
    }
    0
}

pub(crate) fn config(verb: &ConfigVerb) -> Result<u8> {
    let ConfigVerb::Show { pipeline: args, output } = verb;
    let pipeline = pipeline_file::read(&args.pipeline, &args.set)?.pipeline;
    if *output == Output::Json {
        print::json(&pipeline);
        return Ok(0);
    }
    let fault = |error: serde_json::Error| Problem::new(exit::FAULT, error);
    let mut text = format!("name: {}\nseed: {}\nbackend: {}\n", pipeline.name, pipeline.seed, pipeline.backend.name());
    if pipeline.priority != 0 {
        text.push_str(&format!("priority: {}\n", pipeline.priority));
    }
    text.push_str("stages:\n");
    for stage in &pipeline.stages {
        text.push_str(&format!("  {}:\n    kind: {}\n", stage.name, stage.settings.kind()));
        let mut settings = serde_json::to_value(&stage.settings).map_err(fault)?;
        if let Some(map) = settings.as_object_mut() {
            map.remove("kind");
        }
        yaml(&settings, 4, &mut text);
        yaml(&serde_json::to_value(&stage.placement).map_err(fault)?, 4, &mut text);
    }
    print::out(text.trim_end());
    Ok(0)
}

/// Writes block mappings with flow lists. Quotes every text that could be read as another type.
fn yaml(value: &Value, indent: usize, text: &mut String) {
    let Some(map) = value.as_object() else { return };
    for (key, value) in map {
        let pad = " ".repeat(indent);
        if value.is_object() {
            text.push_str(&format!("{pad}{key}:\n"));
            yaml(value, indent + 2, text);
        } else {
            let plain = |s: &str| {
                s.starts_with(|c: char| c.is_ascii_lowercase())
                    && s.bytes().all(|b| b.is_ascii_alphanumeric() || b"_-./".contains(&b))
                    && !matches!(s, "true" | "false" | "null")
            };
            let shown = match value.as_str() {
                Some(word) if plain(word) => word.to_owned(),
                _ => value.to_string(),
            };
            text.push_str(&format!("{pad}{key}: {shown}\n"));
        }
    }
}

pub(crate) fn devices(args: &DevicesArgs) -> u8 {
    let devices = device::available();
    match args.output {
        Output::Json => {
            let object = |device: &DeviceInfo| {
                serde_json::json!({
                    "backend": device.backend.name(),
                    "index": device.index,
                    "name": device.name,
                    "note": device.note,
                })
            };
            let list: Vec<Value> = devices.iter().map(object).collect();
            print::json(&serde_json::json!({"schema_version": 1, "devices": list}));
        }
        Output::Table => {
            let row = |device: &DeviceInfo| {
                let index = device.index.map_or_else(|| "-".to_owned(), |index| index.to_string());
                vec![device.backend.name().to_owned(), index, device.name.clone(), device.note.clone()]
            };
            print::out(&print::table(&["BACKEND", "DEVICE", "NAME", "NOTE"], devices.iter().map(row).collect()));
        }
    }
    0
}
