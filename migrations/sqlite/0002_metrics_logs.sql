-- Owner: registry.
-- Values by step, and log lines. The unique keys store a batch once, even if it is sent twice.

CREATE TABLE IF NOT EXISTS series (
    id      INTEGER PRIMARY KEY,
    run     TEXT    NOT NULL,
    stage   TEXT    NOT NULL,
    task    TEXT    NOT NULL,
    attempt INTEGER NOT NULL,
    key     TEXT    NOT NULL,
    UNIQUE (task, attempt, key)
) STRICT;

CREATE INDEX IF NOT EXISTS series_of_stage ON series (run, stage, key);

-- `value` is null for NaN.
CREATE TABLE IF NOT EXISTS metrics (
    series INTEGER NOT NULL REFERENCES series (id),
    step   INTEGER NOT NULL,
    value  REAL,
    PRIMARY KEY (series, step)
) STRICT, WITHOUT ROWID;

CREATE TABLE IF NOT EXISTS logs (
    id      INTEGER PRIMARY KEY AUTOINCREMENT,
    run     TEXT    NOT NULL,
    stage   TEXT    NOT NULL,
    task    TEXT    NOT NULL,
    attempt INTEGER NOT NULL,
    worker  TEXT    NOT NULL,
    line    INTEGER NOT NULL,
    at_ms   INTEGER NOT NULL,
    text    TEXT    NOT NULL,
    UNIQUE (task, attempt, worker, line)
) STRICT;

CREATE INDEX IF NOT EXISTS logs_of_stage ON logs (run, stage, id);
