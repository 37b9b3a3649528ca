//! Gangs: connections between members, agreement on states, and sums of gradients.

mod connect;
pub(crate) mod endpoint;
pub(crate) mod exchange;
mod frame;
mod handover;
pub(crate) mod handshake;
mod link;
pub(crate) mod member;
mod memory;
pub(crate) mod mesh;
mod pace;
mod peer;
pub(crate) mod rendezvous;
mod seal;
mod successor;
pub(crate) mod tree;

#[cfg(test)]
mod tests;
