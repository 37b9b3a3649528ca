-- Owner: registry.
-- Runs that were forgotten. What others still need of them goes with a later one.

CREATE TABLE IF NOT EXISTS forgotten (
    run   TEXT    PRIMARY KEY,
    at_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
