-- Owner: registry.
-- Forgotten runs. Rows that other runs or models still need are deleted with a later run.

CREATE TABLE IF NOT EXISTS forgotten (
    run   TEXT    PRIMARY KEY,
    at_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
