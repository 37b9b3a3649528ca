//! Gangs: connections between members, what they agree on, and how they sum.

pub(crate) mod exchange;
pub(crate) mod frame;
pub(crate) mod handshake;
pub(crate) mod mesh;
pub(crate) mod tree;
