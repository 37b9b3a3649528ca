-- Owner: registry.
-- Identity and counters of the store. One row, written when the store is created.

CREATE TABLE IF NOT EXISTS store (
    one     INTEGER PRIMARY KEY CHECK (one = 1),
    id      TEXT    NOT NULL,
    -- Raised by every opening. A transaction of an older epoch is refused, because another process has opened the store since.
    epoch   INTEGER NOT NULL,
    -- Number of committed transactions. The witness file beside the database records a number that this one has reached.
    commits INTEGER NOT NULL,
    at_ms   INTEGER NOT NULL
) STRICT;

CREATE TRIGGER IF NOT EXISTS store_keeps_its_identity BEFORE UPDATE OF one, id, at_ms ON store
BEGIN SELECT RAISE(ABORT, 'a store keeps its identity'); END;

CREATE TRIGGER IF NOT EXISTS store_only_goes_on BEFORE UPDATE ON store WHEN new.epoch < old.epoch OR new.commits < old.commits
BEGIN SELECT RAISE(ABORT, 'a store only goes on'); END;
