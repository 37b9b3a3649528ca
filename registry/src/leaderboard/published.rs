//! Rows of the papers, from `published.tsv`, which names their sources.

use std::collections::BTreeMap;

use super::row::{Measure, Row};

const TABLE: &str = include_str!("published.tsv");

/// Returns the published rows of a data format (`humanml3d`, `kit`).
pub(super) fn rows(format: &str) -> Vec<Row> {
    let mut lines =
        TABLE.lines().filter(|line| !line.starts_with('#')).map(|line| line.split('\t').collect::<Vec<_>>());
    let head = lines.next().unwrap_or_default();
    let of_format = lines.filter(|cells| cells.first() == Some(&format));
    let row = |cells: Vec<&str>| Row {
        label: cells[1].to_owned(),
        source: cells[2].to_owned(),
        published: true,
        measures: head
            .iter()
            .zip(&cells)
            .skip(3)
            .filter_map(|(key, cell)| Some(((*key).to_owned(), measure(cell)?)))
            .collect::<BTreeMap<_, _>>(),
    };
    of_format.map(row).collect()
}

/// Parses `.504±.002` or `.504`; `None` for an empty cell.
fn measure(cell: &str) -> Option<Measure> {
    let (value, half) = cell.split_once('±').map_or((cell, None), |(value, half)| (value, half.parse().ok()));
    Some(Measure { value: value.parse().ok()?, half })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn every_cell_is_read() {
        let mut lines = TABLE.lines().filter(|line| !line.starts_with('#'));
        let columns = lines.next().unwrap().split('\t').count();
        for line in lines {
            let cells: Vec<&str> = line.split('\t').collect();
            assert_eq!(cells.len(), columns, "{line}");
            assert!(cells[3..].iter().all(|cell| cell.is_empty() || measure(cell).is_some()), "{line}");
            assert!(
                cells[3..].iter().all(|cell| !cell.contains('±') || measure(cell).unwrap().half.is_some()),
                "{line}"
            );
        }
        assert_eq!(
            rows("humanml3d").len() + rows("kit").len(),
            TABLE.lines().filter(|l| !l.starts_with('#')).count() - 1
        );
    }
}
