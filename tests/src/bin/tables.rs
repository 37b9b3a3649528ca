//! Fills a template with numbers of a run: `tables TEMPLATE RUN.json PIPELINE.json OUT.md [README NAME]`. With the last
//! two arguments, the text also replaces README's section between the lines of that name. `docs/results/regenerate.sh`
//! calls it.

use std::path::Path;
use std::process::ExitCode;

use cluster_tests::tables::{Source, between, render};

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
    let [template, run, pipeline, out, readme @ ..] = arguments else {
        return Err("expected TEMPLATE RUN.json PIPELINE.json OUT.md [README NAME]".into());
    };
    let source = Source { run: json(run)?, pipeline: json(pipeline)? };
    let text = render(&read(template)?, &source).map_err(|why| format!("{template}: {why}"))?;
    save(out, &text)?;
    if let [readme, name] = readme
        && Path::new(readme).is_file()
    {
        let new = between(&read(readme)?, name, &text).map_err(|why| format!("{readme}: {why}"))?;
        save(readme, &new)?;
    }
    Ok(())
}

fn read(path: &str) -> Result<String, String> {
    std::fs::read_to_string(path).map_err(|error| format!("{path}: {error}"))
}

fn json(path: &str) -> Result<serde_json::Value, String> {
    serde_json::from_str(&read(path)?).map_err(|error| format!("{path}: {error}"))
}

fn save(path: &str, text: &str) -> Result<(), String> {
    std::fs::write(path, text).map_err(|error| format!("{path}: {error}"))
}
