-- Owner: registry.
-- Blobs that are known to be stored. A row is written with the first row that names the blob, and deleted before the blob is.

CREATE TABLE IF NOT EXISTS blobs (
    digest      TEXT    PRIMARY KEY,
    bytes       INTEGER NOT NULL,
    -- Time at which the blob was last found stored, in milliseconds since 1970.
    verified_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
