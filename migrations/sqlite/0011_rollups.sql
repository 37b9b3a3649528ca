-- Owner: registry.
-- Times of values, and roll-ups of them: what 64 and 4,096 consecutive values of a series come to.

-- A try of a task that has recorded values. `resumed`: the step of the checkpoint that it continued from, if there was one.
CREATE TABLE IF NOT EXISTS recorders (
    id      INTEGER PRIMARY KEY,
    run     TEXT    NOT NULL,
    stage   TEXT    NOT NULL,
    task    TEXT    NOT NULL,
    attempt INTEGER NOT NULL,
    resumed INTEGER,
    UNIQUE (task, attempt)
) STRICT;

CREATE INDEX IF NOT EXISTS recorders_of_stage ON recorders (run, stage);

-- When a batch of values came in, by the largest step in it. Values of earlier steps came before.
CREATE TABLE IF NOT EXISTS recorded (
    recorder INTEGER NOT NULL REFERENCES recorders (id),
    step     INTEGER NOT NULL,
    at_ms    INTEGER NOT NULL,
    PRIMARY KEY (recorder, step)
) STRICT, WITHOUT ROWID;

-- A row is all values of its series after the row before, up to `last_step`. `low`, `high` and `sum` are of finite values, `odd` counts
-- the others; `last` is null where the last value is not finite. The newest values of a series are in no row yet.
CREATE TABLE IF NOT EXISTS rollups (
    series     INTEGER NOT NULL REFERENCES series (id),
    level      INTEGER NOT NULL,
    last_step  INTEGER NOT NULL,
    first_step INTEGER NOT NULL,
    count      INTEGER NOT NULL,
    odd        INTEGER NOT NULL,
    low        REAL,
    high       REAL,
    sum        REAL    NOT NULL,
    last       REAL,
    PRIMARY KEY (series, level, last_step)
) STRICT, WITHOUT ROWID;

-- Values that are there already. Their time is that of the run's last change, for nothing else is known of it.
INSERT INTO recorders (run, stage, task, attempt) SELECT DISTINCT run, stage, task, attempt FROM series WHERE true ON CONFLICT DO NOTHING;
INSERT INTO recorded (recorder, step, at_ms)
SELECT r.id, max(m.step), coalesce((SELECT updated_ms FROM runs WHERE runs.run = r.run), 0)
FROM recorders r JOIN series s ON s.task = r.task AND s.attempt = r.attempt JOIN metrics m ON m.series = s.id
WHERE NOT EXISTS (SELECT 1 FROM recorded WHERE recorder = r.id) GROUP BY r.id;
INSERT INTO rollups (series, level, last_step, first_step, count, odd, low, high, sum, last)
SELECT series, level, max(step), min(step), count(*), sum(finite IS NULL), min(finite), max(finite), coalesce(sum(finite), 0.0),
    max(CASE WHEN place % size = size - 1 THEN finite END)
FROM (SELECT series, step, CASE WHEN abs(value) < 9e999 THEN value END AS finite,
        row_number() OVER (PARTITION BY series ORDER BY step) - 1 AS place FROM metrics)
    JOIN (SELECT 1 AS level, 64 AS size UNION ALL SELECT 2, 4096)
WHERE NOT EXISTS (SELECT 1 FROM rollups) GROUP BY series, level, place / size HAVING count(*) = size;
