//! The page: its files, sessions of browsers, and what a browser shows of runs whose every text is hostile.

mod beside;
mod clips;
mod draw;
mod files;
pub(crate) mod http;
mod in_browser;
mod lines;
mod sessions;
mod tickets;
