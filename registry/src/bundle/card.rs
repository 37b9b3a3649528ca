//! The model card: describes a version in Markdown for readers who have only the file.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use checkpoint::model::Model;
use protocol::artifact::Role;
use protocol::{Manifest, printable};
use serde_json::Value;

use crate::leaderboard;
use crate::versions::Version;

/// Keys of a part's meta that the card shows.
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

/// Writes the card of a version; `parts` are the manifests of its parts.
pub fn card(version: &Version, manifest: &Manifest, model: &Model, parts: &BTreeMap<Role, Manifest>) -> String {
    let name = &version.model;
    let number = version.version;
    let mut text = format!(
        "# {name}, version {number}\n\nA text-to-motion model: `{}`, which generates motions of {}.\n\n\
         | | |\n|---|---|\n| artifact | `{}` |\n| generator | `{}` |\n| data format | {} |\n",
        model.generator,
        model.format.skeleton(),
        version.artifact,
        model.generator,
        model.format.name(),
    );
    let mut line = |arguments: std::fmt::Arguments<'_>| {
        // Writing to a `String` cannot fail.
        let _ = text.write_fmt(arguments);
        text.push('\n');
    };
    for key in ["run", "stage"] {
        if let Some(value) = version.source[key].as_str() {
            line(format_args!("| {key} | {} |", cell(value)));
        }
    }
    line(format_args!("\n## Parts\n\n| role | kind | bytes | meta |\n|---|---|---:|---|"));
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
        Some(sampler) => line(format_args!("Default settings, as evaluated: {sampler}.")),
        None => line(format_args!("Not evaluated; sampling uses the papers' settings.")),
    }
    line(format_args!("\n## Metrics\n\n{}", metrics(version)));
    line(format_args!(
        "\n## How to generate motions\n\n```sh\nregistry import {name}-{number}.tar.zst\n\
         trainer generate \"a person walks in a circle\" --model {name}@latest -o walk.bvh\n```\n\n\
         Exported files have the names in the manifest; weights are safetensors. {} files, {} bytes. This file grants no \
         licence: the terms of use follow from the training data.",
        manifest.files.len(),
        manifest.files.values().map(|file| file.bytes).sum::<u64>(),
    ));
    text
}

/// The table of metrics.
fn metrics(version: &Version) -> String {
    let mut lines = vec!["| evaluation | metric | value, ± half the 95 % interval |\n|---|---|---:|".to_owned()];
    for (stage, measures) in leaderboard::measured(version) {
        let stage = cell(stage.as_deref().unwrap_or("-"));
        for (metric, measure) in leaderboard::in_order(&measures) {
            lines.push(format!("| {stage} | {} | {} |", cell(metric), leaderboard::in_words(measure)));
        }
    }
    if lines.len() == 1 { "None.".to_owned() } else { lines.join("\n") }
}

/// Formats the shown keys of a part's meta in a line.
fn facts(meta: &Value) -> String {
    let fact = |key: &&'static str| Some(format!("{key} {}", short(meta.get(*key)?)));
    FACTS.iter().filter_map(fact).collect::<Vec<_>>().join("; ")
}

/// Formats a value without the syntax of JSON.
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

/// Escapes a text for a cell of a Markdown table.
fn cell(text: &str) -> String {
    printable(text).replace('|', "\\|").replace('\n', " ")
}
