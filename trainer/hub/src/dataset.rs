//! Published sets of motion: fetched at a fixed commit, checked file by file against a list that ships.
//!
//! `FOLDER.part` holds an unfinished set: the archive, and the files that were checked. `FOLDER` appears only by the
//! rename that completes it, so a folder with that name is whole. The next command continues an interrupted one.
//! The names of an archive's members decide nothing: a file is written under its name in the list, if it has the size
//! and the digest in the list.

mod error;
mod fetch;
mod known;
mod list;
mod staging;
mod unpack;

pub use error::FetchError;
pub use fetch::{Fetch, Fetched, MakeTables, Progress, Source, Table};
pub use known::{KNOWN, Known, bandai};
pub use list::{Listed, PublicSet};

pub use crate::transfer::Arrived;
