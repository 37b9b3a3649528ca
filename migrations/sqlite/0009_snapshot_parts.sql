-- Owner: registry (written by the coordinator through `registry::Write`).
-- A snapshot in parts: a run, an execution, a worker. Only parts that changed since the previous snapshot are written.

-- The current state of a part is its newest row up to the newest snapshot; `state` is null if the part was deleted.
CREATE TABLE IF NOT EXISTS snapshot_parts (
    part  TEXT    NOT NULL,
    seq   INTEGER NOT NULL,
    state TEXT    CHECK (state IS NULL OR json_valid(state)),
    PRIMARY KEY (part, seq)
) STRICT, WITHOUT ROWID;

CREATE INDEX IF NOT EXISTS snapshot_parts_by_seq ON snapshot_parts (seq);
