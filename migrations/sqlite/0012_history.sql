-- Owner: registry (written by the coordinator through `registry::Write`).
-- What happened to runs, stages and workers, for time lines of the past. Rows go by age alone.

CREATE TABLE IF NOT EXISTS history (
    id      INTEGER PRIMARY KEY AUTOINCREMENT,
    at_ms   INTEGER NOT NULL,
    kind    TEXT    NOT NULL,
    run     TEXT,
    stage   TEXT,
    task    TEXT,
    attempt INTEGER,
    step    INTEGER,
    worker  TEXT,
    model   TEXT,
    actor   TEXT,
    why     TEXT
) STRICT;

CREATE INDEX IF NOT EXISTS history_of_run ON history (run, id);
CREATE INDEX IF NOT EXISTS history_of_worker ON history (worker, id);
CREATE INDEX IF NOT EXISTS history_by_time ON history (at_ms);

CREATE TRIGGER IF NOT EXISTS history_is_never_edited BEFORE UPDATE ON history
BEGIN SELECT RAISE(ABORT, 'history is never edited'); END;

-- When work on a stage began and when its newest attempt at a value ended; kept as long as the stage.
CREATE TABLE IF NOT EXISTS stage_times (
    run        TEXT    NOT NULL,
    stage      TEXT    NOT NULL,
    started_ms INTEGER NOT NULL,
    ended_ms   INTEGER,
    PRIMARY KEY (run, stage)
) STRICT, WITHOUT ROWID;
