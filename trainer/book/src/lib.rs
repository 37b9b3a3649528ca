//! The book in `docs/book` as files of this binary.
//!
//! The build script renders its chapters to documents without scripts, so their content policy is stricter than the page's.
//! Their addresses are those of mdBook: `clusters.md` is `clusters.html`.

use std::sync::LazyLock;

use page::File;

/// Content policy of the book: no script runs, and styles and pictures are the server's own.
pub const CONTENT_POLICY: &str =
    "default-src 'none'; style-src 'self'; img-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The chapter that is shown at the book's own address.
pub const FIRST: &str = "introduction.html";

// The build script writes this file, which defines `RENDERED`.
include!(concat!(env!("OUT_DIR"), "/rendered.rs"));

static FILES: LazyLock<Vec<File>> =
    LazyLock::new(|| RENDERED.iter().map(|(name, bytes)| File::new(name, bytes.to_vec())).collect());

/// A file of the book by its path below `/book/`.
#[must_use]
pub fn find(name: &str) -> Option<&'static File> {
    FILES.iter().find(|file| file.name == name)
}

/// All files: documents, their style, pictures, and the chapters' text for language models.
pub fn files() -> impl Iterator<Item = &'static File> {
    FILES.iter()
}
