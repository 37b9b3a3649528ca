//! Gangs: connections between members, what they agree on, and how they sum.

pub(crate) mod endpoint;
pub(crate) mod exchange;
mod frame;
pub(crate) mod handshake;
mod link;
pub(crate) mod member;
pub(crate) mod mesh;
mod pace;
mod seal;
pub(crate) mod tree;

#[cfg(test)]
mod tests;
