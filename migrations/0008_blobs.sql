-- Owner: registry.
-- Blobs that are known to be in their place. A row is stored with the first row that names the blob, and goes before the blob does.

CREATE TABLE IF NOT EXISTS blobs (
    digest      TEXT    PRIMARY KEY,
    bytes       INTEGER NOT NULL,
    -- When the blob was last found there, in milliseconds since 1970.
    verified_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
