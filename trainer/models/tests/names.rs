//! Published tensor names, pinned.
