//! The model card: what a version is, in Markdown, for people who get the file and nothing else.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use checkpoint::model::Model;
use protocol::artifact::Role;
use protocol::{Manifest, printable};
use serde_json::Value;

use crate::leaderboard;
use crate::versions::Version;

/// Facts of a part's meta that say what it is, by key.
const FACTS: [&str; 12] = [
    "encoder",
    "family",
    "architecture",
    "latent",
    "features",
    "codes",
    "code_dim",
    "quantizers",
    "text_dim",
    "dim",
    "diffusion",
    "network",
];

/// The card of a version, whose parts' manifests are `parts`.
pub fn card(version: &Version, manifest: &Manifest, model: &Model, parts: &BTreeMap<Role, Manifest>) -> String {
    let (name, number) = (&version.model, version.version);
    let mut text = format!(
        "# {name}, version {number}\n\nA text-to-motion model: `{}`, which draws motions of {}.\n\n\
         | | |\n|---|---|\n| artifact | `{}` |\n| generator | `{}` |\n| data format | {} |\n",
        model.generator,
        model.format.skeleton(),
        version.artifact,
        model.generator,
        model.format.name(),
    );
    let mut line = |arguments: std::fmt::Arguments<'_>| {
        // Writing to a text cannot fail.
        let _ = text.write_fmt(arguments);
        text.push('\n');
    };
    for key in ["run", "stage"] {
        if let Some(value) = version.source[key].as_str() {
            line(format_args!("| {key} | {} |", cell(value)));
        }
    }
    line(format_args!("\n## Parts\n\n| role | kind | bytes | what its manifest says |\n|---|---|---:|---|"));
    for (role, part) in parts {
        let bytes: u64 = part.files.values().map(|file| file.bytes).sum();
        line(format_args!("| `{role}` | {} | {bytes} | {} |", part.kind.noun(), cell(&facts(&part.meta))));
    }
    line(format_args!(
        "\nStatistics of the training data (`mean`, `std`) are in the manifests of the parts that need them.\n\n## Data\n"
    ));
    match parts.values().find_map(|part| part.meta.get("features")) {
        Some(features) => line(format_args!(
            "Trained on motions in the format of {}, {features} features a frame.",
            model.format.name()
        )),
        None => line(format_args!("Trained on motions in the format of {}.", model.format.name())),
    }
    line(format_args!("\n## Sampler\n"));
    match &model.sampler {
        Some(sampler) => line(format_args!("Drawn as it was measured: {sampler}.")),
        None => line(format_args!("Nobody has measured it; it is drawn as its papers draw.")),
    }
    line(format_args!("\n## Metrics\n"));
    let measured = leaderboard::measured(version);
    if measured.is_empty() {
        line(format_args!("None."));
    } else {
        line(format_args!("| evaluation | metric | value, ± half the 95 % interval |\n|---|---|---:|"));
        for (stage, measures) in &measured {
            for (metric, measure) in leaderboard::in_order(measures) {
                let stage = stage.as_deref().unwrap_or("-");
                line(format_args!("| {} | {} | {} |", cell(stage), cell(metric), leaderboard::in_words(measure)));
            }
        }
    }
    line(format_args!(
        "\n## How to draw from it\n\n```sh\nregistry import {name}-{number}.tar.zst\n\
         trainer generate \"a person walks in a circle\" --model {name}@latest -o walk.bvh\n```\n\n\
         The folder's files have the names of the manifest; weights are safetensors. {} files, {} bytes. Nothing here says under which terms \
         the model may be used: that follows from the data that it was trained on.",
        manifest.files.len(),
        manifest.files.values().map(|file| file.bytes).sum::<u64>(),
    ));
    text
}

/// What a part's meta says of it, in a line.
fn facts(meta: &Value) -> String {
    let fact = |key: &&'static str| Some(format!("{key} {}", short(meta.get(*key)?)));
    FACTS.iter().filter_map(fact).collect::<Vec<_>>().join("; ")
}

/// A value without the signs of JSON.
fn short(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Object(map) => {
            let pairs: Vec<String> = map.iter().map(|(key, value)| format!("{key} {}", short(value))).collect();
            format!("({})", pairs.join(", "))
        }
        other => other.to_string(),
    }
}

/// A text in a cell of a table.
fn cell(text: &str) -> String {
    printable(text).replace('|', "\\|").replace('\n', " ")
}
