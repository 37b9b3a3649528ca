//! All that the command prints. stdout is data, stderr is for people.
//!
//! Whatever is printed goes through [`printable`], for much of it comes from files and other people's machines. A reader that has left is no
//! failure of the command: what it would have read is dropped, and the exit code stays.

use std::io::{IsTerminal, Write};

use clap::ValueEnum;
use comfy_table::{ContentArrangement, Table, presets};
use protocol::printable;
use serde::Serialize;

use crate::problem::Problem;

/// How an answer is printed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Output {
    /// For people.
    #[default]
    Table,
    /// For programs: one object on stdout; errors as one object on stderr.
    Json,
}

/// Data.
pub(crate) fn out(text: &str) {
    // A closed pipe (`| head`) is no failure of the command.
    let _ = writeln!(std::io::stdout().lock(), "{}", printable(text));
}

/// One line of a stream; ends the process quietly when nobody reads any more.
pub(crate) fn line(text: &str) {
    if writeln!(std::io::stdout().lock(), "{}", printable(text)).is_err() {
        std::process::exit(0);
    }
}

/// A message.
pub(crate) fn note(text: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{}", printable(text));
}

/// One JSON object on stdout.
pub(crate) fn json(value: &impl Serialize) {
    match serde_json::to_string_pretty(value) {
        Ok(text) => out(&text),
        Err(error) => note(&format!("error: the answer does not serialise: {error}")),
    }
}

/// An error, on stderr.
pub(crate) fn problem(problem: &Problem, output: Output) {
    let chain: Vec<String> = problem.error.chain().map(ToString::to_string).collect();
    // A cause whose text its effect already has says nothing new.
    let mut message = chain[0].clone();
    for cause in &chain[1..] {
        if !message.contains(cause.as_str()) {
            message.push_str(": ");
            message.push_str(cause);
        }
    }
    if output == Output::Json {
        let value = serde_json::json!({"error": {"code": problem.exit, "message": message, "hint": problem.hint}});
        note(&value.to_string());
        return;
    }
    note(&format!("error: {message}"));
    if let Some(hint) = &problem.hint {
        note(&format!("\nhint: {hint}"));
    }
}

/// Columns under headings, without lines between them.
pub(crate) fn table(head: &[&str], rows: Vec<Vec<String>>) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(head.iter().copied());
    for row in rows {
        table.add_row(row);
    }
    table.lines().map(|line| line.trim_end().trim_start_matches(' ').to_owned()).collect::<Vec<_>>().join("\n")
}

/// Whether progress bars make sense.
pub(crate) fn on_terminal() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// `41 s`, `3 min 05 s`, `2 h 10 min`.
pub(crate) fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..10 => format!("{seconds:.1} s"),
        10..60 => format!("{whole} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

/// `0.0531`, `78.2`, `1.2e-7`.
pub(crate) fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 || !value.is_finite() {
        format!("{value}")
    } else if (1e-3..1e6).contains(&size) {
        let decimals = (3 - size.log10().floor() as i32).clamp(0, 6) as usize;
        format!("{value:.decimals$}")
    } else {
        format!("{value:.2e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantities_are_short() {
        assert_eq!(duration(3.25), "3.2 s");
        assert_eq!(duration(185.0), "3 min 05 s");
        assert_eq!(duration(7800.0), "2 h 10 min");
        assert_eq!(number(0.05312), "0.05312");
        assert_eq!(number(78.24), "78.24");
        assert_eq!(number(1.2e-7), "1.20e-7");
    }
}
