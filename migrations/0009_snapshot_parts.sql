-- Owner: registry (written by the coordinator through `registry::Write`).
-- A snapshot in parts: a run, an execution, a worker. Only what has changed since the snapshot before is written.

-- A part counts as the newest row of it up to the newest snapshot has it; `state` is null where it is there no more.
CREATE TABLE IF NOT EXISTS snapshot_parts (
    part  TEXT    NOT NULL,
    seq   INTEGER NOT NULL,
    state TEXT    CHECK (state IS NULL OR json_valid(state)),
    PRIMARY KEY (part, seq)
) STRICT, WITHOUT ROWID;

CREATE INDEX IF NOT EXISTS snapshot_parts_by_seq ON snapshot_parts (seq);
