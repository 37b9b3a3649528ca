-- Owner: registry.
-- A short row for each run, for lists of many. Triggers keep it in step with `runs`, from which all of it follows.

CREATE TABLE IF NOT EXISTS run_list (
    -- Grows with each submission.
    number     INTEGER PRIMARY KEY,
    run        TEXT    NOT NULL UNIQUE,
    pipeline   TEXT    NOT NULL,
    -- The group that owns the run, and the name of the token that submitted it; the name is known once the run has ended.
    owner      TEXT    NOT NULL DEFAULT '',
    token      TEXT    NOT NULL DEFAULT '',
    state      TEXT    NOT NULL,
    created_ms INTEGER NOT NULL,
    changed_ms INTEGER NOT NULL,
    done       INTEGER NOT NULL,
    stages     INTEGER NOT NULL,
    wall_s     REAL    NOT NULL,
    note       TEXT    NOT NULL
) STRICT;

-- An index for each set of filters, in the order of submissions and of changes. A list reads no row that it does not show.
CREATE INDEX IF NOT EXISTS run_list_by_state ON run_list (state);
CREATE INDEX IF NOT EXISTS run_list_of_pipeline ON run_list (pipeline, state);
CREATE INDEX IF NOT EXISTS run_list_of_owner ON run_list (owner, state);
CREATE INDEX IF NOT EXISTS run_list_of_both ON run_list (owner, pipeline, state);
CREATE INDEX IF NOT EXISTS run_list_changed ON run_list (state, changed_ms);
CREATE INDEX IF NOT EXISTS run_list_of_pipeline_changed ON run_list (pipeline, state, changed_ms);
CREATE INDEX IF NOT EXISTS run_list_of_owner_changed ON run_list (owner, state, changed_ms);
CREATE INDEX IF NOT EXISTS run_list_of_both_changed ON run_list (owner, pipeline, state, changed_ms);

-- The words of each row by three characters; `rowid` is the row's number.
CREATE VIRTUAL TABLE IF NOT EXISTS run_words USING fts5 (
    words, content = '', contentless_delete = 1, tokenize = 'trigram', detail = 'none'
);

-- The state and progress of a run: by its row, and once it has ended by its view.
CREATE VIEW IF NOT EXISTS run_standings AS
SELECT run, state, created_ms, updated_ms AS changed_ms,
    coalesce(json_extract(pipeline, '$.name'), '') AS pipeline,
    coalesce(json_extract(view, '$.owner.name'), '') AS token,
    (SELECT count(*) FROM json_each(view, '$.stages')
        WHERE value ->> 'of' IS NULL AND value ->> 'state' IN ('ran', 'cached', 'resumed')) AS done,
    (SELECT count(*) FROM json_each(view, '$.stages')
        WHERE value ->> 'of' IS NULL AND NOT (value ->> 'state' IS 'skipped' AND value ->> 'message' IS 'not asked for')) AS stages,
    (SELECT total(value ->> 'wall_s') FROM json_each(view, '$.stages') WHERE value ->> 'of' IS NULL) AS wall_s,
    coalesce(json_extract(view, '$.note'),
        (SELECT (value ->> 'name') || ': ' || (value ->> 'message') FROM json_each(view, '$.stages') WHERE value ->> 'state' = 'failed' LIMIT 1),
        '') AS note
FROM runs;

CREATE TRIGGER IF NOT EXISTS runs_are_listed AFTER INSERT ON runs BEGIN
    INSERT INTO run_list (run, pipeline, token, state, created_ms, changed_ms, done, stages, wall_s, note)
    SELECT run, pipeline, token, state, created_ms, changed_ms, done, stages, wall_s, note FROM run_standings WHERE run = new.run;
END;

CREATE TRIGGER IF NOT EXISTS runs_are_listed_as_they_stand AFTER UPDATE OF pipeline, state, view ON runs BEGIN
    UPDATE run_list SET (pipeline, token, state, changed_ms, done, stages, wall_s, note) =
        (SELECT pipeline, token, state, changed_ms, done, stages, wall_s, note FROM run_standings WHERE run = new.run)
    WHERE run = new.run;
END;

CREATE TRIGGER IF NOT EXISTS forgotten_runs_are_not_listed AFTER DELETE ON runs BEGIN
    DELETE FROM run_list WHERE run = old.run;
END;

CREATE TRIGGER IF NOT EXISTS owned_runs_are_listed_so AFTER INSERT ON run_owners BEGIN
    UPDATE run_list SET owner = new.owner WHERE run = new.run;
END;

CREATE TRIGGER IF NOT EXISTS listed_runs_have_words AFTER INSERT ON run_list BEGIN
    INSERT INTO run_words (rowid, words)
    VALUES (new.number, new.run || ' ' || new.pipeline || ' ' || new.owner || ' ' || new.token || ' ' || new.note);
END;

CREATE TRIGGER IF NOT EXISTS listed_runs_have_these_words AFTER UPDATE OF pipeline, owner, token, note ON run_list
WHEN (old.pipeline, old.owner, old.token, old.note) IS NOT (new.pipeline, new.owner, new.token, new.note) BEGIN
    INSERT OR REPLACE INTO run_words (rowid, words)
    VALUES (new.number, new.run || ' ' || new.pipeline || ' ' || new.owner || ' ' || new.token || ' ' || new.note);
END;

CREATE TRIGGER IF NOT EXISTS unlisted_runs_have_no_words AFTER DELETE ON run_list BEGIN
    DELETE FROM run_words WHERE rowid = old.number;
END;

-- Runs that are there already.
INSERT INTO run_list (run, pipeline, owner, token, state, created_ms, changed_ms, done, stages, wall_s, note)
SELECT s.run, s.pipeline, coalesce(o.owner, ''), s.token, s.state, s.created_ms, s.changed_ms, s.done, s.stages, s.wall_s, s.note
FROM run_standings s JOIN runs r ON r.run = s.run LEFT JOIN run_owners o ON o.run = s.run
WHERE NOT EXISTS (SELECT 1 FROM run_list) ORDER BY r.rowid;
