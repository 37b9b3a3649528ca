//! Leaderboards as text for terminals, and as Markdown and LaTeX rows for papers and pages.

use clap::ValueEnum;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::column::{COLUMNS, Column, PAPER_COLUMNS};
use super::{Better, Comparison, Leaderboard, Measure, Row, Verdict};
use crate::table::table;

/// Format of a table.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Style {
    /// Plain text for a terminal
    #[default]
    Text,
    /// A table in GitHub's Markdown
    Markdown,
    /// Rows of a `tabular`, with a comment that names the columns
    Latex,
}

impl Leaderboard {
    /// Returns the columns with a value in our rows. Next to published rows all columns of the papers are included.
    fn columns(&self) -> Vec<&'static Column> {
        let has = |column: &Column| self.rows.iter().any(|row| !row.published && row.measures.contains_key(column.key));
        let paper = self.rows.iter().any(|row| row.published);
        COLUMNS
            .iter()
            .enumerate()
            .filter(|(i, column)| has(column) || (paper && *i < PAPER_COLUMNS))
            .map(|(_, c)| c)
            .collect()
    }

    /// Formats the table.
    pub fn render(&self, style: Style) -> String {
        let columns = self.columns();
        let heads: Vec<String> = columns.iter().map(|c| format!("{}{}", c.head, arrow(c.better))).collect();
        let best: Vec<Option<f64>> = columns.iter().map(|c| self.best(c)).collect();
        let cells = |row: &Row, mark: fn(&str) -> String, plus_minus: &str| -> Vec<String> {
            let cell = |(column, best): (&&Column, &Option<f64>)| match row.measures.get(column.key) {
                None => "-".to_owned(),
                Some(m) if !row.published && Some(m.value) == *best => mark(&number(*m, plus_minus)),
                Some(m) => number(*m, plus_minus),
            };
            columns.iter().zip(&best).map(cell).collect()
        };
        match style {
            Style::Text => {
                let head = std::iter::once(self.title.clone()).chain(heads);
                let mut table = table(head);
                for row in &self.rows {
                    table.add_row(std::iter::once(label(row)).chain(cells(row, |cell| format!("{cell} *"), " ± ")));
                }
                let mut text = format!("{}\n\n* best of ours; ± half the 95 % interval\n", table.trim_fmt());
                if self.rows.iter().any(|row| row.published) {
                    text += "[PAPER]: value from the paper, on the full test split with the published evaluator; \
                        compare only values of the same evaluator\n";
                }
                text
            }
            Style::Markdown => {
                let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
                let mut text = line(std::iter::once("model".to_owned()).chain(heads).collect());
                text += &line(std::iter::repeat_n("---".to_owned(), columns.len() + 1).collect());
                for row in &self.rows {
                    text += &line(
                        std::iter::once(label(row)).chain(cells(row, |cell| format!("**{cell}**"), "±")).collect(),
                    );
                }
                text
            }
            Style::Latex => {
                let mut text = format!("% model & {} \\\\\n", heads.join(" & "));
                for row in &self.rows {
                    let cells = cells(row, |cell| format!("\\mathbf{{{cell}}}"), "^{\\pm").into_iter();
                    let cells = cells.map(|cell| if cell == "-" { cell } else { format!("${}$", close(&cell)) });
                    let all: Vec<String> = std::iter::once(escape(&label(row))).chain(cells).collect();
                    text += &format!("{} \\\\\n", all.join(" & "));
                }
                text
            }
        }
    }

    fn best(&self, column: &Column) -> Option<f64> {
        let values = self.rows.iter().filter(|row| !row.published).filter_map(|row| row.measures.get(column.key));
        let values = values.map(|m| m.value).filter(|value| value.is_finite());
        match column.better {
            Better::Lower => values.min_by(f64::total_cmp),
            Better::Higher => values.max_by(f64::total_cmp),
            Better::NearReal | Better::Neither => None,
        }
    }
}

/// The label of a row; a published one names its paper.
fn label(row: &Row) -> String {
    if row.published { format!("{} [{}]", row.label, row.source) } else { row.label.clone() }
}

impl Comparison {
    /// Formats the table.
    pub(crate) fn render(&self, style: Style) -> String {
        let cell = |measure: Option<Measure>| measure.map_or_else(|| "-".into(), |m| number(m, " ± "));
        let verdict = |verdict: Option<Verdict>| match verdict {
            None => "-".to_owned(),
            Some(Verdict::Left) => format!("{} is better", self.left),
            Some(Verdict::Right) => format!("{} is better", self.right),
            Some(Verdict::Differ) => "differ beyond noise".into(),
            Some(Verdict::Noise) => "within noise".into(),
            Some(Verdict::Unknown) => "noise not measured".into(),
        };
        let heads = ["metric".to_owned(), self.left.clone(), self.right.clone(), "difference".into(), "verdict".into()];
        let lines = self
            .metrics
            .iter()
            .map(|d| [d.metric.clone(), cell(d.left), cell(d.right), cell(d.difference), verdict(d.verdict)]);
        match style {
            Style::Text => {
                let mut table = table(heads);
                table.add_rows(lines);
                format!("{}\n", table.trim_fmt())
            }
            Style::Markdown => {
                let mut text = format!("| {} |\n|{}\n", heads.join(" | "), " --- |".repeat(heads.len()));
                lines.for_each(|line| text += &format!("| {} |\n", line.join(" | ")));
                text
            }
            Style::Latex => {
                let mut text = format!("% {} \\\\\n", heads.join(" & "));
                lines.for_each(|line| text += &format!("{} \\\\\n", line.map(|cell| escape(&cell)).join(" & ")));
                text
            }
        }
    }
}

fn arrow(better: Better) -> &'static str {
    match better {
        Better::Lower => " ↓",
        Better::Higher => " ↑",
        Better::NearReal => " →",
        Better::Neither => "",
    }
}

/// Formats a value with its interval, as in tables.
pub(crate) fn in_words(measure: Measure) -> String {
    number(measure, " ± ")
}

/// Formats with enough decimals for the interval, and with three without one, as papers print.
fn number(measure: Measure, plus_minus: &str) -> String {
    let decimals = match measure.half {
        Some(half) if half > 0.0 && half < 5e-4 => 4,
        _ if measure.value != 0.0 && measure.value.abs() < 5e-3 => 4,
        _ => 3,
    };
    let value = format!("{:.decimals$}", measure.value);
    measure.half.map_or_else(|| value.clone(), |half| format!("{value}{plus_minus}{half:.decimals$}"))
}

/// Closes the exponent that `number` opened.
fn close(cell: &str) -> String {
    if !cell.contains("^{\\pm") {
        return cell.to_owned();
    }
    match cell.strip_suffix('}').filter(|_| cell.starts_with("\\mathbf{")) {
        Some(inner) => format!("{inner}}}}}"),
        None => format!("{cell}}}"),
    }
}

fn escape(text: &str) -> String {
    text.replace('_', "\\_").replace('%', "\\%").replace('±', "$\\pm$").replace('&', "\\&")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn leaderboard() -> Leaderboard {
        let row = |label: &str, published, fid: (f64, Option<f64>)| Row {
            label: label.into(),
            source: "MotionPCM".into(),
            published,
            measures: BTreeMap::from([("fid".to_owned(), Measure { value: fid.0, half: fid.1 })]),
        };
        let rows = vec![
            row("m_1:1", false, (0.0441, Some(0.003))),
            row("m_1:2", false, (0.05, None)),
            row("Paper", true, (0.03, None)),
        ];
        Leaderboard { title: "t".into(), rows }
    }

    #[test]
    fn rows_can_be_pasted() {
        assert_eq!(
            leaderboard().render(Style::Markdown).lines().nth(2),
            Some("| m_1:1 | - | - | - | - | **0.044±0.003** | - | - | - |")
        );
        let latex = leaderboard().render(Style::Latex);
        assert_eq!(
            latex.lines().nth(1),
            Some("m\\_1:1 & - & - & - & - & $\\mathbf{0.044^{\\pm0.003}}$ & - & - & - \\\\")
        );
        assert_eq!(latex.lines().nth(3), Some("Paper [MotionPCM] & - & - & - & - & $0.030$ & - & - & - \\\\"));
        let text = leaderboard().render(Style::Text);
        assert!(text.contains("0.044 ± 0.003 *") && text.contains("compare only values"), "{text}");
    }
}
