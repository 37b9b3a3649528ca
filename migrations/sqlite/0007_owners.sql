-- Owner: registry.
-- The group of tokens that owns a run or model: `@PROJECT`, or a token's name. The store's user owns those without a row.

CREATE TABLE IF NOT EXISTS run_owners (
    run   TEXT PRIMARY KEY,
    owner TEXT NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX IF NOT EXISTS runs_of_owner ON run_owners (owner);

CREATE TABLE IF NOT EXISTS model_owners (
    model TEXT PRIMARY KEY,
    owner TEXT NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TRIGGER IF NOT EXISTS models_keep_their_owner BEFORE UPDATE ON model_owners
BEGIN SELECT RAISE(ABORT, 'a model keeps its owner'); END;
