//! Tables for terminals.

use comfy_table::{ContentArrangement, Row, Table, presets};
use terminal_size::{Width, terminal_size_of};

/// Returns a table with only a heading. It has no lines and is at most as wide as the terminal that stdout is.
pub(crate) fn table(head: impl Into<Row>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Dynamic).set_header(head);
    if let Some((Width(width), _)) = terminal_size_of(std::io::stdout()) {
        table.set_width(width);
    }
    table
}
