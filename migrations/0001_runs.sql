-- Owner: registry (written by the coordinator through `registry::Write`).
-- The coordinator's journal, the runs it tells of, and the fence of every task.

CREATE TABLE IF NOT EXISTS journal (
    seq   INTEGER PRIMARY KEY AUTOINCREMENT,
    at_ms INTEGER NOT NULL,
    event TEXT    NOT NULL CHECK (json_valid(event))
) STRICT;

CREATE TRIGGER IF NOT EXISTS journal_is_never_edited BEFORE UPDATE ON journal
BEGIN SELECT RAISE(ABORT, 'the journal is append-only'); END;

CREATE TRIGGER IF NOT EXISTS journal_is_never_cut BEFORE DELETE ON journal
BEGIN SELECT RAISE(ABORT, 'the journal is append-only'); END;

CREATE TABLE IF NOT EXISTS runs (
    run             TEXT    PRIMARY KEY,
    pipeline        TEXT    NOT NULL CHECK (json_valid(pipeline)),
    source          TEXT    NOT NULL,
    state           TEXT    NOT NULL,
    idempotency_key TEXT    UNIQUE,
    created_ms      INTEGER NOT NULL,
    updated_ms      INTEGER NOT NULL
) STRICT;

-- A write that carries a grant is stored only while the grant's fence equals this one.
CREATE TABLE IF NOT EXISTS fences (
    task  TEXT    PRIMARY KEY,
    fence INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TRIGGER IF NOT EXISTS fences_only_grow BEFORE UPDATE ON fences WHEN new.fence <= old.fence
BEGIN SELECT RAISE(ABORT, 'a fence only grows'); END;
