//! Gangs: connections between members, agreement on states, and sums of gradients.

pub(crate) mod endpoint;
pub(crate) mod exchange;
mod frame;
pub(crate) mod handshake;
mod link;
pub(crate) mod member;
mod memory;
pub(crate) mod mesh;
mod pace;
pub(crate) mod rendezvous;
mod seal;
pub(crate) mod tree;

#[cfg(test)]
mod tests;
