//! Prints answers to the terminal: data to stdout, messages to stderr.

use std::collections::BTreeMap;
use std::io::{self, Write};

use checkpoint::model::{Model, Parts};
use protocol::artifact::Role;
use protocol::message::ApiError;
use protocol::units::{counted, size};
use protocol::{Digest, Manifest, RunId, printable};
use serde_json::json;

use super::{Answer, Data, Output};
use crate::audit::AuditEntry;
use crate::backup::Summary;
use crate::clock::format_ms;
use crate::forget::Forgotten;
use crate::retention::Plan;
use crate::table::table;
use crate::versions::{self, Action, Promotion, Version};
use crate::{LineageNode, fsck, leaderboard};

/// Prints an answer.
pub(super) fn show(answer: &Answer, output: Output) -> io::Result<()> {
    if let Some(data) = &answer.data {
        let text = match output {
            Output::Table => render(data),
            Output::Json => {
                let mut value = serde_json::to_value(data)?;
                value["schema_version"] = json!(1);
                format!("{value:#}\n")
            }
        };
        io::stdout().lock().write_all(printable(&text).as_bytes())?;
    }
    answer.error.as_ref().map_or(Ok(()), |error| show_error(error, output))
}

/// Prints an error to stderr: message, empty line, hint and the command that explains it, or one JSON object.
pub fn show_error(error: &ApiError, output: Output) -> io::Result<()> {
    let mut stderr = io::stderr().lock();
    match output {
        Output::Json => writeln!(stderr, "{}", printable(&format!("{:#}", json!({ "error": error })))),
        Output::Table => {
            writeln!(stderr, "error: {}", printable(&error.message))?;
            let hint = error.hint.as_ref().map(|hint| format!("hint: {}\n", printable(hint))).unwrap_or_default();
            writeln!(stderr, "\n{hint}more: trainer explain {}", printable(&error.code))
        }
    }
}

/// Formats an answer's data as text.
pub fn render(data: &Data) -> String {
    match data {
        Data::Models { models } => models_as_table(models),
        Data::Model { model, versions } => versions_as_table(model, versions),
        Data::Version { version, manifest, fits, bases } => version_in_full(version, manifest, fits, bases),
        Data::History { model, history } if history.is_empty() => format!("no alias of `{model}` has moved yet\n"),
        Data::History { history, .. } => history_as_table(history),
        Data::Audit { entries } => audit_as_table(entries),
        Data::Promotion { promotion } => {
            let Promotion { model, alias, from, to, .. } = promotion;
            let from = from.map_or_else(|| "nothing".into(), |from| format!("version {from}"));
            let mut text = format!("{model}@{alias} points at version {to} (before: {from})\n");
            for gate in &promotion.gates {
                text += &format!("  gate `{}` holds: {}\n", gate.gate, gate.message);
            }
            text
        }
        Data::Comparison { comparison, style } => comparison.render(*style),
        Data::Leaderboard { leaderboard, style } => leaderboard.render(*style),
        Data::Lineage { nodes } => lineage_as_table(nodes),
        Data::Fsck { report } => problems_of(report),
        Data::Gc { dry_run, plan } => removed(*dry_run, plan),
        Data::Adopted { store } => {
            format!("store {store} is repaired; `registry fsck` lists missing data\n")
        }
        Data::Forgotten { runs } => forgotten(runs),
        Data::BackedUp { summary, dir } => {
            let Summary { store, at_ms, blobs, bytes } = summary;
            let at = format_ms(*at_ms);
            let bytes = size(*bytes);
            let dir = dir.display();
            format!("store {store} of {at} is in `{dir}`: the database and {blobs} blobs ({bytes}), all verified\n")
        }
        Data::Restored { summary, dir } => {
            let Summary { store, at_ms, blobs, bytes } = summary;
            let at = format_ms(*at_ms);
            let bytes = size(*bytes);
            let dir = dir.display();
            format!("`{dir}` is store {store} as of {at}: {blobs} blobs ({bytes}), all verified\n")
        }
        Data::Migrated { from, to, rows } => {
            format!("{rows} rows of `{from}` are in `{to}`, all verified; the store uses it from now on\n")
        }
        Data::Exported { version, dir, files, left_out } => {
            let without = match left_out.is_empty() {
                true => String::new(),
                false => format!("; the layout cannot hold {}", left_out.join(", ")),
            };
            format!("{}:{} is in `{}`: {}{without}\n", version.model, version.version, dir.display(), files.join(", "))
        }
        Data::Imported { version, file } => {
            let model = &version.model;
            let number = version.version;
            format!(
                "`{file}` is {model}:{number}; `trainer generate \"a person walks\" --model {model}:{number}` uses it\n"
            )
        }
    }
}

fn models_as_table(models: &[versions::Model]) -> String {
    if models.is_empty() {
        return "no models yet; a `register` stage creates one\n".into();
    }
    let mut table = table(["MODEL", "VERSIONS", "BEST", "METRIC", "ALIASES"]);
    for model in models {
        let mode = model.mode.map(|mode| format!(" ({})", json!(mode).as_str().unwrap_or_default()));
        table.add_row([
            model.model.to_string(),
            model.versions.to_string(),
            dash(model.best),
            format!("{}{}", dash(model.metric.as_ref()), mode.unwrap_or_default()),
            list(model.aliases.iter().map(|(alias, version)| format!("{alias}={version}"))),
        ]);
    }
    format!("{}\n", table.trim_fmt())
}

fn versions_as_table(model: &versions::Model, versions: &[Version]) -> String {
    let mut table = table(["VERSION", "ALIASES", "METRICS", "FROM", "REGISTERED"]);
    for version in versions {
        let best = (model.best == Some(version.version)).then(|| "best".to_owned());
        let metrics = leaderboard::in_brief(version, model.metric.as_deref());
        table.add_row([
            version.version.to_string(),
            list(best.into_iter().chain(version.aliases.iter().cloned())),
            list(metrics.into_iter().map(|(metric, measure)| format!("{metric}={}", leaderboard::in_words(measure)))),
            source(version),
            format_ms(version.created_ms),
        ]);
    }
    format!("{}\n{}\n", model.model, table.trim_fmt())
}

fn version_in_full(version: &Version, manifest: &Manifest, fits: &BTreeMap<Role, Parts>, bases: &[String]) -> String {
    let mut text = format!("{}:{}\n", version.model, version.version);
    let lines = [
        ("artifact", version.artifact.to_string()),
        ("aliases", list(version.aliases.iter().cloned())),
        ("from", source(version)),
        ("registered", format_ms(version.created_ms)),
    ];
    for (name, value) in lines.into_iter().chain(drawn(manifest)).chain(made_for(fits)).chain(beside(bases)) {
        text += &format!("  {name:<11} {value}\n");
    }
    let mut values = table(["EVALUATION", "METRIC", "VALUE, ± HALF THE 95 % INTERVAL"]);
    for (stage, measures) in leaderboard::measured(version) {
        for (metric, measure) in leaderboard::in_order(&measures) {
            values.add_row([dash(stage.as_ref()), metric.clone(), leaderboard::in_words(measure)]);
        }
    }
    if !version.metrics.is_empty() {
        text += &format!("{}\n\n", values.trim_fmt());
    }
    let mut files = table(["FILE", "BYTES", "BLOB"]);
    for (name, file) in &manifest.files {
        files.add_row([name.clone(), file.bytes.to_string(), file.digest.short()]);
    }
    format!("{text}{}\n", files.trim_fmt())
}

fn history_as_table(history: &[Promotion]) -> String {
    let mut table = table(["#", "WHEN", "ALIAS", "ACTION", "FROM", "TO", "WHO", "WHY", "GATES"]);
    for entry in history {
        table.add_row([
            entry.id.to_string(),
            format_ms(entry.at_ms),
            entry.alias.to_string(),
            action(entry).to_owned(),
            dash(entry.from),
            entry.to.to_string(),
            entry.actor.clone(),
            entry.reason.clone(),
            list(entry.gates.iter().map(|gate| format!("{} ({})", gate.gate, dash(gate.value)))),
        ]);
    }
    format!("{}\n", table.trim_fmt())
}

fn audit_as_table(entries: &[AuditEntry]) -> String {
    if entries.is_empty() {
        return "the audit log is empty\n".into();
    }
    let mut table = table(["WHEN", "WHO", "FROM", "CALL", "OBJECT", "STATUS", "CALLS"]);
    for entry in entries {
        table.add_row([
            format_ms(entry.at_ms),
            entry.who.clone(),
            entry.from.clone(),
            entry.call.clone(),
            entry.object.clone(),
            entry.status.to_string(),
            entry.count.to_string(),
        ]);
    }
    format!("{}\n", table.trim_fmt())
}

fn lineage_as_table(nodes: &[LineageNode]) -> String {
    let mut table = table(["ARTIFACT", "KIND", "STAGE", "RUN", "MADE OF"]);
    for node in nodes {
        table.add_row([
            format!("{}{}", "  ".repeat(node.depth as usize), node.digest.short()),
            dash(node.kind.as_ref()),
            dash(node.stage.as_ref()),
            dash(node.run.as_ref()),
            list(node.inputs.iter().map(|(role, digest)| format!("{role}={}", digest.short()))),
        ]);
    }
    format!("{}\n", table.trim_fmt())
}

fn problems_of(report: &fsck::Report) -> String {
    let mut text = format!(
        "{} blobs ({}) hashed, {} references followed, {}\n",
        report.blobs,
        size(report.bytes),
        report.references,
        counted(report.problems.len(), "problem")
    );
    for problem in &report.problems {
        text += &format!("  {problem}\n");
    }
    for note in &report.notes {
        text += &format!("  note: {note}\n");
    }
    text
}

/// Largest number of blobs that a collection lists.
const SHOWN: usize = 20;

fn removed(dry_run: bool, plan: &Plan) -> String {
    let mut text = String::new();
    for digest in plan.remove.iter().take(SHOWN) {
        text += &format!("  {digest}\n");
    }
    if let Some(more) = plan.remove.len().checked_sub(SHOWN).filter(|more| *more > 0) {
        text += &format!("  and {more} more; `-o json` lists all\n");
    }
    let verb = if dry_run { "would remove" } else { "removed" };
    let fresh = if plan.fresh == 0 { String::new() } else { format!(", {} within their grace period", plan.fresh) };
    let count = plan.remove.len();
    let bytes = size(plan.bytes);
    let kept = plan.kept;
    let uploads = match plan.uploads {
        0 => String::new(),
        1 => ", the parts of 1 unfinished upload".to_owned(),
        uploads => format!(", the parts of {uploads} unfinished uploads"),
    };
    text + &format!("{verb} {count} blobs ({bytes}){uploads}; {kept} are needed{fresh}\n")
}

fn forgotten(runs: &[(RunId, Forgotten)]) -> String {
    if runs.is_empty() {
        return "no run that ended before that time has data to forget\n".into();
    }
    let mut text = String::new();
    for (run, gone) in runs {
        let Forgotten { values, lines, checkpoints, results, kept } = gone;
        text += &format!(
            "forgot {run}: {values} values, {lines} log lines, {checkpoints} checkpoints, {results} results of stages\n"
        );
        for stage in kept {
            text += &format!("  {stage} stays: a model, a pin or another run needs it\n");
        }
    }
    text + "`registry gc` removes blobs that are no longer needed\n"
}

fn action(entry: &Promotion) -> &'static str {
    match entry.action {
        Action::Promote => "promote",
        Action::Rollback => "rollback",
    }
}

fn dash<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(|| "-".into(), |value| value.to_string())
}

fn list(items: impl Iterator<Item = String>) -> String {
    let items: Vec<_> = items.collect();
    if items.is_empty() { "-".into() } else { items.join(", ") }
}

/// Describes a model's generator, sampler and parts.
fn drawn(manifest: &Manifest) -> Vec<(&'static str, String)> {
    let Ok(model) = Model::read(manifest) else { return Vec::new() };
    let sampler = model.sampler.map_or_else(|| "not evaluated".to_owned(), |sampler| sampler.to_string());
    let part = |(role, digest): (&Role, &Digest)| format!("{role}={}", digest.short());
    vec![
        ("generator", format!("{}, {}", model.generator, model.format.name())),
        ("sampler", sampler),
        ("parts", list(model.parts.iter().map(part))),
    ]
}

/// Lists the parts that each part was made for.
fn made_for(fits: &BTreeMap<Role, Parts>) -> Option<(&'static str, String)> {
    if fits.is_empty() {
        return None;
    }
    let mut all = Vec::new();
    for (role, parts) in fits {
        let parts: Vec<String> = parts.iter().map(|(role, digest)| format!("{role}={}", digest.short())).collect();
        all.push(format!("{role} for {}", parts.join(" and ")));
    }
    Some(("fits", all.join(", ")))
}

/// Lists the versions that a control part was made for.
fn beside(bases: &[String]) -> Option<(&'static str, String)> {
    (!bases.is_empty()).then(|| ("bases", list(bases.iter().cloned())))
}

fn source(version: &Version) -> String {
    let part = |name: &str| version.source[name].as_str().map(str::to_owned);
    list(part("run").into_iter().chain(part("stage")).chain(crate::bundle::origin(&version.source)))
}
