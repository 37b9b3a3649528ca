-- Owner: registry.
-- Blobs that held tasks have stored and that no row names yet. A row is written before its blob is stored, and deleted once
-- the task is no longer held.

CREATE TABLE IF NOT EXISTS held_blobs (
    task   TEXT NOT NULL,
    digest TEXT NOT NULL,
    PRIMARY KEY (task, digest)
) STRICT, WITHOUT ROWID;
