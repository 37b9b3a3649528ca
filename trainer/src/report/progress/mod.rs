//! Shows the progress of a run. On a terminal, each running stage has a bar and each ended stage a line. Otherwise each
//! change has a line, and each running stage has one a minute.

mod curve;
mod display;
mod line;

pub(crate) use self::display::Progress;
