-- Owner: registry.
-- Outputs of stages. Uploaded blobs count from the commit of the row that names them.

CREATE TABLE IF NOT EXISTS checkpoints (
    id       INTEGER PRIMARY KEY AUTOINCREMENT,
    task     TEXT    NOT NULL,
    attempt  INTEGER NOT NULL,
    step     INTEGER NOT NULL,
    manifest TEXT    NOT NULL,
    metrics  TEXT    NOT NULL CHECK (json_valid(metrics)),
    at_ms    INTEGER NOT NULL,
    UNIQUE (task, step, manifest)
) STRICT;

CREATE TABLE IF NOT EXISTS shards (
    task   TEXT    PRIMARY KEY,
    run    TEXT    NOT NULL,
    output TEXT    NOT NULL,
    at_ms  INTEGER NOT NULL
) STRICT;

CREATE TABLE IF NOT EXISTS stage_results (
    key     TEXT    PRIMARY KEY,
    run     TEXT    NOT NULL,
    stage   TEXT    NOT NULL,
    kind    TEXT    NOT NULL,
    outputs TEXT    NOT NULL CHECK (json_valid(outputs)),
    metrics TEXT    NOT NULL CHECK (json_valid(metrics)),
    inputs  TEXT    NOT NULL CHECK (json_valid(inputs)),
    wall_s  REAL    NOT NULL,
    at_ms   INTEGER NOT NULL
) STRICT;

CREATE INDEX IF NOT EXISTS stage_results_of_run ON stage_results (run, stage);

CREATE TABLE IF NOT EXISTS artifacts (
    digest TEXT    PRIMARY KEY,
    kind   TEXT    NOT NULL,
    bytes  INTEGER NOT NULL,
    run    TEXT,
    stage  TEXT,
    key    TEXT,
    at_ms  INTEGER NOT NULL
) STRICT;

-- `child` was made from `parent`, which the field `role` named.
CREATE TABLE IF NOT EXISTS edges (
    parent TEXT NOT NULL,
    child  TEXT NOT NULL,
    role   TEXT NOT NULL,
    PRIMARY KEY (child, parent, role)
) STRICT, WITHOUT ROWID;

CREATE INDEX IF NOT EXISTS edges_by_parent ON edges (parent);

CREATE TABLE IF NOT EXISTS pins (
    digest TEXT    PRIMARY KEY,
    reason TEXT    NOT NULL,
    at_ms  INTEGER NOT NULL
) STRICT;
