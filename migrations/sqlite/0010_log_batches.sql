-- Owner: registry.
-- Log lines, one row for each batch, and counters of each run's limited amounts.

DROP TABLE IF EXISTS logs;

-- A stream of lines: one worker in one attempt of a task.
CREATE TABLE IF NOT EXISTS log_streams (
    id      INTEGER PRIMARY KEY,
    run     TEXT    NOT NULL,
    stage   TEXT    NOT NULL,
    task    TEXT    NOT NULL,
    attempt INTEGER NOT NULL,
    worker  TEXT    NOT NULL,
    UNIQUE (task, attempt, worker)
) STRICT;

CREATE INDEX IF NOT EXISTS log_streams_of_stage ON log_streams (run, stage);

-- The line at place N of `lines` has the number `line` + N within its stream, and `id` + N among all lines.
CREATE TABLE IF NOT EXISTS log_batches (
    id     INTEGER PRIMARY KEY,
    stream INTEGER NOT NULL REFERENCES log_streams (id),
    line   INTEGER NOT NULL,
    count  INTEGER NOT NULL,
    at_ms  INTEGER NOT NULL,
    lines  TEXT    NOT NULL CHECK (json_valid(lines))
) STRICT;

CREATE INDEX IF NOT EXISTS log_batches_of_stream ON log_batches (stream, line);
CREATE INDEX IF NOT EXISTS log_batches_in_order ON log_batches (stream, id);

-- The number of the next line. It only grows, so a reader that continues misses no line.
CREATE TABLE IF NOT EXISTS log_numbers (next INTEGER NOT NULL) STRICT;
INSERT INTO log_numbers (next) SELECT 1 WHERE NOT EXISTS (SELECT 1 FROM log_numbers);

CREATE TABLE IF NOT EXISTS usage (
    run       TEXT    PRIMARY KEY,
    log_bytes INTEGER NOT NULL DEFAULT 0,
    "values"  INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;
