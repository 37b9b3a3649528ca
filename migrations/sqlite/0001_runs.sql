-- Owner: registry (written by the coordinator through `registry::Write`).
-- The coordinator's decisions, the runs they concern, and the fence of every task.

-- One row holds the facts of one decision. A snapshot replaces all facts up to its number, which are then deleted.
CREATE TABLE IF NOT EXISTS facts (
    seq   INTEGER PRIMARY KEY,
    at_ms INTEGER NOT NULL,
    facts TEXT    NOT NULL CHECK (json_valid(facts))
) STRICT;

CREATE TRIGGER IF NOT EXISTS facts_are_never_edited BEFORE UPDATE ON facts
BEGIN SELECT RAISE(ABORT, 'facts are never edited'); END;

CREATE TRIGGER IF NOT EXISTS facts_go_only_behind_a_snapshot BEFORE DELETE ON facts
WHEN old.seq > (SELECT coalesce(max(seq), 0) FROM snapshots)
BEGIN SELECT RAISE(ABORT, 'facts go only once a snapshot stands for them'); END;

CREATE TABLE IF NOT EXISTS snapshots (
    seq   INTEGER PRIMARY KEY,
    at_ms INTEGER NOT NULL,
    state TEXT    NOT NULL CHECK (json_valid(state))
) STRICT;

CREATE TABLE IF NOT EXISTS runs (
    run             TEXT    PRIMARY KEY,
    pipeline        TEXT    NOT NULL CHECK (json_valid(pipeline)),
    source          TEXT    NOT NULL,
    state           TEXT    NOT NULL,
    idempotency_key TEXT    UNIQUE,
    created_ms      INTEGER NOT NULL,
    updated_ms      INTEGER NOT NULL,
    -- Set at the end of the run: `view` is for clients, `archive` lets the coordinator resume the run.
    view            TEXT    CHECK (json_valid(view)),
    archive         TEXT    CHECK (json_valid(archive))
) STRICT;

-- Unfinished executions that no run in the coordinator's memory needs: attempts, shards, checkpoints.
CREATE TABLE IF NOT EXISTS executions (
    key       TEXT    PRIMARY KEY,
    run       TEXT    NOT NULL,
    stage     TEXT    NOT NULL,
    execution TEXT    NOT NULL CHECK (json_valid(execution)),
    at_ms     INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

-- A write with a grant is stored only if the grant's fence equals this one.
CREATE TABLE IF NOT EXISTS fences (
    task  TEXT    PRIMARY KEY,
    fence INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TRIGGER IF NOT EXISTS fences_only_grow BEFORE UPDATE ON fences WHEN new.fence <= old.fence
BEGIN SELECT RAISE(ABORT, 'a fence only grows'); END;
