//! Published weights: torch or safetensors files, the networks in them, and the unused rest of a file.
//!
//! The file is not trusted. No code of a pickle is executed, and an archive that would grow beyond its own length is
//! not unpacked. No network is created before all of its tensors were found in the file with their shapes. Sizes are
//! derived from shapes, and names and shapes of a network need no memory
//! ([`Init::shapes`](models::networks::Init::shapes)).
//!
//! Files of one network differ in the prefix of its names. In torch files it is the key of a dict (`state_dict`,
//! `vq_model`) and the module's name inside the saved class (`vae.`, `vqvae.`). Our own exports have the part's role as
//! prefix. Each network lists the prefixes in use, and a name that all variants have.

mod file;
mod network;
pub mod sizes;

pub use file::Checkpoint;
pub use network::{Found, Place, Taken};
