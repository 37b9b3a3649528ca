//! All output of the command. stdout is data, stderr is messages.
//!
//! All text passes through [`printable`], because much of it comes from files and from other machines. A closed output
//! is no failure of the command: the text is dropped, and the exit code stays.

use std::io::{IsTerminal, Write};

use clap::ValueEnum;
use comfy_table::{ContentArrangement, Table, presets};
use protocol::printable;
use protocol::units::grouped;
use serde::Serialize;

use crate::report::problem::Problem;

/// Format of an answer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Output {
    /// A table for people.
    #[default]
    Table,
    /// One JSON object on stdout for programs; errors are one object on stderr.
    Json,
}

/// Prints data on stdout.
pub(crate) fn out(text: &str) {
    // A closed pipe (`| head`) is no failure of the command.
    let _ = writeln!(std::io::stdout().lock(), "{}", printable(text));
}

/// Prints our own bytes unchanged, such as a script for a shell.
pub(crate) fn raw(bytes: &[u8]) {
    let _ = std::io::stdout().lock().write_all(bytes);
}

/// Prints one line of a stream. Ends the process quietly if the output is closed.
pub(crate) fn line(text: &str) {
    if writeln!(std::io::stdout().lock(), "{}", printable(text)).is_err() {
        std::process::exit(0);
    }
}

/// Prints a message.
pub(crate) fn note(text: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{}", printable(text));
}

/// Prints one JSON object on stdout.
pub(crate) fn json(value: &impl Serialize) {
    match serde_json::to_string_pretty(value) {
        Ok(text) => out(&text),
        Err(error) => note(&format!("error: cannot serialise the answer: {error}")),
    }
}

/// Prints an error on stderr.
pub(crate) fn problem(problem: &Problem, output: Output) {
    let chain: Vec<String> = problem.error.chain().map(ToString::to_string).collect();
    // Skip a cause whose text its effect already contains.
    let mut message = chain[0].clone();
    for cause in &chain[1..] {
        if !message.contains(cause.as_str()) {
            message.push_str(": ");
            message.push_str(cause);
        }
    }
    let message = plain(&message);
    if output == Output::Json {
        let page = problem.code().map(|code| format!("troubleshooting.html#{code}"));
        let value = serde_json::json!({
            "error": {"code": problem.exit, "message": message, "hint": problem.hint, "page": page},
        });
        note(&value.to_string());
        return;
    }
    note(&format!("error: {message}"));
    let hint = problem.hint.iter().map(|hint| format!("hint: {hint}"));
    let more = problem.code().into_iter().map(|code| format!("more: trainer explain {code}"));
    let lines: Vec<String> = hint.chain(more).collect();
    if !lines.is_empty() {
        note(&format!("\n{}", lines.join("\n")));
    }
}

/// Removes the number from an error of the operating system, and rephrases the frequent ones.
fn plain(message: &str) -> String {
    let known = [
        ("No such file or directory (os error 2)", "there is no such file"),
        ("Is a directory (os error 21)", "is a folder; expected a file"),
        ("Not a directory (os error 20)", "a part of its path is a file; expected a folder"),
        ("Permission denied (os error 13)", "permission denied"),
        ("Connection refused (os error 111)", "connection refused; nothing listens there"),
    ];
    known.iter().fold(message.to_owned(), |text, (theirs, ours)| text.replace(theirs, ours))
}

/// Formats columns under headings, without lines between them.
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

/// Returns true if stderr can show progress bars.
pub(crate) fn on_terminal() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// Formats a duration: `41 s`, `3 min 05 s`, `2 h 10 min`.
pub(crate) fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..10 => format!("{seconds:.1} s"),
        10..60 => format!("{whole} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

/// Formats a rate with three significant digits: `0.0531`, `23.1`, `7,110,000`.
pub(crate) fn rounded(value: f64) -> String {
    if value <= 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let unit = 10_f64.powi(value.log10().floor() as i32 - 2);
    let value = (value / unit).round() * unit;
    let digits = value.log10().floor() as i32;
    if digits >= 2 {
        return grouped(value.round() as u64);
    }
    let decimals = (2 - digits).clamp(0, 9) as usize;
    format!("{value:.decimals$}")
}

/// Formats a value: `0.0531`, `78.2`, `1.2e-7`; a count as a whole number, `1,204`.
pub(crate) fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 || !value.is_finite() {
        format!("{value}")
    } else if value.fract() == 0.0 && size < 1e15 {
        let sign = if value < 0.0 { "-" } else { "" };
        format!("{sign}{}", grouped(size as u64))
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
    fn errors_of_the_system_have_no_numbers() {
        let error = std::fs::read("/nowhere/at/all").unwrap_err();
        assert_eq!(plain(&format!("cannot read `x`: {error}")), "cannot read `x`: there is no such file");
        let error = std::fs::read("/").unwrap_err();
        assert_eq!(plain(&format!("`/`: {error}")), "`/`: is a folder; expected a file");
    }

    #[test]
    fn quantities_are_short() {
        assert_eq!(duration(3.25), "3.2 s");
        assert_eq!(duration(185.0), "3 min 05 s");
        assert_eq!(duration(7800.0), "2 h 10 min");
        assert_eq!(number(0.05312), "0.05312");
        assert_eq!(number(78.24), "78.24");
        assert_eq!(number(1.2e-7), "1.20e-7");
        assert_eq!((number(270.0), number(-1204.0)), ("270".to_owned(), "-1,204".to_owned()), "counts are whole");
        let rates = [7_110_229.749, 238.46, 99.96, 23.14, 0.083_34].map(rounded);
        assert_eq!(rates, ["7,110,000", "238", "100", "23.1", "0.0833"]);
    }
}
