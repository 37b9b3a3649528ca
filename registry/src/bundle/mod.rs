//! A bundle: one version of a model in one file, `*.tar.zst`, for use on another machine.
//!
//! ```text
//! bundle.json      first: description (`Head`), as JSON
//! manifest.json    second: the model's manifest, whose digest is the version's artifact
//! card.md          for readers: description, measurements, usage
//! ROLE/...         every file of the manifest under its name there, the parts' manifests included
//! ```
//!
//! The archive is plain POSIX (`ustar`) and has only regular files and no extensions, so a name has at most 255 bytes.
//! `tar --zstd -xf` unpacks it. Owners and times are zero, so one version always gives the same bytes. Compression is
//! zstd with a window of at most 2^[`WINDOW_LOG`] bytes. Statistics of the data, the text encoder and the sampler's
//! settings are part of the manifests.
//!
//! The reader trusts nothing in a bundle. The manifest must have the digest in the head, every file the length and
//! digest in the manifest, and the parts must form the model. Any other content is refused, and no more bytes are
//! unpacked than announced. `format` grows when an older build would misread a newer bundle; additional keys do not
//! raise it.

mod card;
mod format;
mod import;
mod read;
mod write;

pub use card::card;
pub use format::{Bundle, BundleError, FILES, FORMAT, Head, MANIFESTS_BYTES, SUFFIX, TEXT_BYTES, WINDOW_LOG};
pub use import::ImportError;
pub(crate) use import::origin;
pub use read::{Sink, read};
pub use write::{WriteError, Writer};
