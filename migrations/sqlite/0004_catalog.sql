-- Owner: registry.
-- Models, their versions, the versions' aliases, and the log of every alias's moves.

CREATE TABLE IF NOT EXISTS models (
    model  TEXT    PRIMARY KEY,
    -- The metric that ranks `@best`, and its direction; null until a registration declares them.
    metric TEXT,
    mode   TEXT    CHECK (mode IN ('min', 'max')),
    at_ms  INTEGER NOT NULL
) STRICT;

CREATE TABLE IF NOT EXISTS versions (
    model    TEXT    NOT NULL REFERENCES models (model),
    version  INTEGER NOT NULL CHECK (version >= 1),
    artifact TEXT    NOT NULL,
    metrics  TEXT    NOT NULL CHECK (json_valid(metrics)),
    source   TEXT    NOT NULL CHECK (json_valid(source)),
    at_ms    INTEGER NOT NULL,
    PRIMARY KEY (model, version),
    UNIQUE (model, artifact)
) STRICT;

-- Metrics may be added; the other columns never change.
CREATE TRIGGER IF NOT EXISTS versions_are_never_edited BEFORE UPDATE OF model, version, artifact, source, at_ms ON versions
BEGIN SELECT RAISE(ABORT, 'a model version is never edited'); END;

CREATE TRIGGER IF NOT EXISTS versions_are_never_removed BEFORE DELETE ON versions
BEGIN SELECT RAISE(ABORT, 'a model version is never removed'); END;

CREATE TABLE IF NOT EXISTS aliases (
    model   TEXT    NOT NULL,
    alias   TEXT    NOT NULL,
    version INTEGER NOT NULL,
    at_ms   INTEGER NOT NULL,
    PRIMARY KEY (model, alias),
    FOREIGN KEY (model, version) REFERENCES versions (model, version)
) STRICT;

CREATE TABLE IF NOT EXISTS promotions (
    id           INTEGER PRIMARY KEY AUTOINCREMENT,
    at_ms        INTEGER NOT NULL,
    model        TEXT    NOT NULL,
    alias        TEXT    NOT NULL,
    action       TEXT    NOT NULL CHECK (action IN ('promote', 'rollback')),
    from_version INTEGER,
    to_version   INTEGER NOT NULL,
    actor        TEXT    NOT NULL,
    reason       TEXT    NOT NULL,
    -- The gates as written, each with the numbers that it compared.
    gates        TEXT    NOT NULL CHECK (json_valid(gates)),
    FOREIGN KEY (model, to_version) REFERENCES versions (model, version)
) STRICT;

CREATE INDEX IF NOT EXISTS promotions_of_alias ON promotions (model, alias, id);

CREATE TRIGGER IF NOT EXISTS promotions_are_never_edited BEFORE UPDATE ON promotions
BEGIN SELECT RAISE(ABORT, 'the promotion log is append-only'); END;

CREATE TRIGGER IF NOT EXISTS promotions_are_never_removed BEFORE DELETE ON promotions
BEGIN SELECT RAISE(ABORT, 'the promotion log is append-only'); END;
