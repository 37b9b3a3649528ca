//! Everything that runs on this machine without a server: reading of pipeline files, plans, runs and their worker
//! processes, verification.

pub(crate) mod advice;
pub(crate) mod cost;
pub(crate) mod fleet;
pub(crate) mod hub_names;
pub(crate) mod missing;
pub(crate) mod out_of_memory;
pub(crate) mod pack;
pub(crate) mod pictures;
pub(crate) mod pipeline_file;
pub(crate) mod plan;
pub(crate) mod run;
pub(crate) mod verify;
