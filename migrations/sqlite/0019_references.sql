-- Owner: registry.
-- Blobs with the digests that the manifest in each names, so that a collection need not read it. Blobs that were known
-- before count as unknown until a row names them again.

DROP TABLE IF EXISTS blobs;

CREATE TABLE IF NOT EXISTS blobs (
    digest      TEXT    PRIMARY KEY,
    bytes       INTEGER NOT NULL,
    -- Time at which the blob was last found stored, in milliseconds since 1970.
    verified_ms INTEGER NOT NULL,
    -- Null if the blob is no manifest or names many digests. A later build that finds more digests in a manifest must
    -- clear this column.
    refers      TEXT    CHECK (refers IS NULL OR json_valid(refers))
) STRICT, WITHOUT ROWID;
