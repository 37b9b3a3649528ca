//! Fills a template with numbers of a run: `tables TEMPLATE RUN.json PIPELINE.json OUT.md`. `docs/results/regenerate.sh`
//! calls it.

use std::process::ExitCode;

use tables::{Source, render};

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match write(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("error: {why}");
            ExitCode::FAILURE
        }
    }
}

fn write(arguments: &[String]) -> Result<(), String> {
    let [template, run, pipeline, out] = arguments else {
        return Err("expected TEMPLATE RUN.json PIPELINE.json OUT.md".into());
    };
    let source = Source { run: json(run)?, pipeline: json(pipeline)? };
    let text = render(&read(template)?, &source).map_err(|why| format!("{template}: {why}"))?;
    std::fs::write(out, text).map_err(|error| format!("{out}: {error}"))
}

fn read(path: &str) -> Result<String, String> {
    std::fs::read_to_string(path).map_err(|error| format!("{path}: {error}"))
}

fn json(path: &str) -> Result<serde_json::Value, String> {
    serde_json::from_str(&read(path)?).map_err(|error| format!("{path}: {error}"))
}
