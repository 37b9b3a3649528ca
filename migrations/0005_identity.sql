-- Owner: registry.
-- Which store this is and how far it has come. One row, written when the store is made.

CREATE TABLE IF NOT EXISTS store (
    one     INTEGER PRIMARY KEY CHECK (one = 1),
    id      TEXT    NOT NULL,
    -- Raised by every opening. A transaction of an older epoch is refused: somebody else has opened the store since.
    epoch   INTEGER NOT NULL,
    -- Committed transactions. The witness file beside the database knows a number that this one has reached.
    commits INTEGER NOT NULL,
    at_ms   INTEGER NOT NULL
) STRICT;

CREATE TRIGGER IF NOT EXISTS store_keeps_its_identity BEFORE UPDATE OF one, id, at_ms ON store
BEGIN SELECT RAISE(ABORT, 'a store keeps its identity'); END;

CREATE TRIGGER IF NOT EXISTS store_only_goes_on BEFORE UPDATE ON store WHEN new.epoch < old.epoch OR new.commits < old.commits
BEGIN SELECT RAISE(ABORT, 'a store only goes on'); END;
