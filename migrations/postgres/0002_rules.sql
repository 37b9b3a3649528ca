-- Owner: registry.
-- The rules that triggers of `migrations/sqlite` hold: rows that are never edited, counters that only grow, and the list of runs.

-- Refuses a change. The trigger's argument says why.
CREATE OR REPLACE FUNCTION stride_refuse() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    RAISE EXCEPTION '%', TG_ARGV[0];
END $$;

CREATE OR REPLACE TRIGGER facts_are_never_edited BEFORE UPDATE ON facts
FOR EACH ROW EXECUTE FUNCTION stride_refuse('facts are never edited');

CREATE OR REPLACE FUNCTION stride_facts_go() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF old.seq > (SELECT coalesce(max(seq), 0) FROM snapshots) THEN
        RAISE EXCEPTION 'facts go only once a snapshot stands for them';
    END IF;
    RETURN old;
END $$;

CREATE OR REPLACE TRIGGER facts_go_only_behind_a_snapshot BEFORE DELETE ON facts
FOR EACH ROW EXECUTE FUNCTION stride_facts_go();

CREATE OR REPLACE TRIGGER fences_only_grow BEFORE UPDATE ON fences
FOR EACH ROW WHEN (new.fence <= old.fence) EXECUTE FUNCTION stride_refuse('a fence only grows');

-- Metrics may be added; the other columns never change.
CREATE OR REPLACE TRIGGER versions_are_never_edited BEFORE UPDATE OF model, version, artifact, source, at_ms ON versions
FOR EACH ROW EXECUTE FUNCTION stride_refuse('a model version is never edited');

CREATE OR REPLACE TRIGGER versions_are_never_removed BEFORE DELETE ON versions
FOR EACH ROW EXECUTE FUNCTION stride_refuse('a model version is never removed');

CREATE OR REPLACE TRIGGER promotions_are_never_edited BEFORE UPDATE ON promotions
FOR EACH ROW EXECUTE FUNCTION stride_refuse('the promotion log is append-only');

CREATE OR REPLACE TRIGGER promotions_are_never_removed BEFORE DELETE ON promotions
FOR EACH ROW EXECUTE FUNCTION stride_refuse('the promotion log is append-only');

CREATE OR REPLACE TRIGGER store_keeps_its_identity BEFORE UPDATE OF one, id, at_ms ON store
FOR EACH ROW EXECUTE FUNCTION stride_refuse('a store keeps its identity');

CREATE OR REPLACE TRIGGER store_only_goes_on BEFORE UPDATE ON store
FOR EACH ROW WHEN (new.epoch < old.epoch OR new.commits < old.commits) EXECUTE FUNCTION stride_refuse('a store only goes on');

CREATE OR REPLACE TRIGGER models_keep_their_owner BEFORE UPDATE ON model_owners
FOR EACH ROW EXECUTE FUNCTION stride_refuse('a model keeps its owner');

CREATE OR REPLACE TRIGGER history_is_never_edited BEFORE UPDATE ON history
FOR EACH ROW EXECUTE FUNCTION stride_refuse('history is never edited');

INSERT INTO log_numbers (next) SELECT 1 WHERE NOT EXISTS (SELECT 1 FROM log_numbers);

-- The newest row of the history ever added, for a reader that continues. The sequence of `history` is ahead of what is committed.
CREATE TABLE IF NOT EXISTS history_numbers (newest BIGINT NOT NULL) WITH (fillfactor = 50);
INSERT INTO history_numbers (newest) SELECT 0 WHERE NOT EXISTS (SELECT 1 FROM history_numbers);

CREATE OR REPLACE FUNCTION stride_history_grows() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    UPDATE history_numbers SET newest = greatest(newest, (SELECT max(id) FROM added));
    RETURN NULL;
END $$;

CREATE OR REPLACE TRIGGER history_is_numbered AFTER INSERT ON history REFERENCING NEW TABLE AS added
FOR EACH STATEMENT EXECUTE FUNCTION stride_history_grows();

-- The entries of the list `stages` of a JSON document; none if there is no such list.
CREATE OR REPLACE FUNCTION stride_stages(document TEXT) RETURNS TABLE (value JSON) LANGUAGE sql IMMUTABLE AS $$
    SELECT json_array_elements(CASE WHEN json_typeof(document::json -> 'stages') = 'array' THEN document::json -> 'stages' END)
$$;

-- Lower-case letters of every script where the server has ICU, and of ASCII elsewhere.
DO $$
DECLARE folding TEXT := 'C';
BEGIN
    IF EXISTS (SELECT 1 FROM pg_collation WHERE collname = 'und-x-icu') THEN
        folding := 'und-x-icu';
    END IF;
    EXECUTE format('CREATE OR REPLACE FUNCTION stride_lower(words TEXT) RETURNS TEXT LANGUAGE sql IMMUTABLE AS '
        '%L', format('SELECT lower(words COLLATE %I)', folding));
END $$;

-- The state and progress of a run: by its row, and once it has ended by its view.
CREATE OR REPLACE VIEW run_standings AS
SELECT run, state, created_ms, updated_ms AS changed_ms,
    coalesce(pipeline::json ->> 'name', '') AS pipeline,
    coalesce(view::json -> 'owner' ->> 'name', '') AS token,
    (SELECT count(*) FROM stride_stages(view)
        WHERE value ->> 'of' IS NULL AND value ->> 'state' IN ('ran', 'cached', 'resumed')) AS done,
    (SELECT count(*) FROM stride_stages(view) WHERE value ->> 'of' IS NULL
        AND NOT (coalesce(value ->> 'state', '') = 'skipped' AND coalesce(value ->> 'message', '') = 'not asked for')) AS stages,
    (SELECT coalesce(sum((value ->> 'wall_s')::double precision), 0) FROM stride_stages(view) WHERE value ->> 'of' IS NULL) AS wall_s,
    coalesce(view::json ->> 'note',
        (SELECT (value ->> 'name') || ': ' || (value ->> 'message') FROM stride_stages(view) WHERE value ->> 'state' = 'failed' LIMIT 1),
        '') AS note
FROM runs;

CREATE OR REPLACE FUNCTION stride_list_run() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO run_list (run, pipeline, token, state, created_ms, changed_ms, done, stages, wall_s, note)
    SELECT run, pipeline, token, state, created_ms, changed_ms, done, stages, wall_s, note FROM run_standings WHERE run = new.run
    ON CONFLICT (run) DO UPDATE SET pipeline = excluded.pipeline, token = excluded.token, state = excluded.state,
        changed_ms = excluded.changed_ms, done = excluded.done, stages = excluded.stages, wall_s = excluded.wall_s, note = excluded.note;
    RETURN NULL;
END $$;

CREATE OR REPLACE TRIGGER runs_are_listed AFTER INSERT OR UPDATE OF pipeline, state, view ON runs
FOR EACH ROW EXECUTE FUNCTION stride_list_run();

CREATE OR REPLACE FUNCTION stride_unlist_run() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    DELETE FROM run_list WHERE run = old.run;
    DELETE FROM submissions WHERE run = old.run;
    RETURN NULL;
END $$;

CREATE OR REPLACE TRIGGER forgotten_runs_are_not_listed AFTER DELETE ON runs
FOR EACH ROW EXECUTE FUNCTION stride_unlist_run();

CREATE OR REPLACE FUNCTION stride_list_owner() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    UPDATE run_list SET owner = new.owner WHERE run = new.run;
    RETURN NULL;
END $$;

CREATE OR REPLACE TRIGGER owned_runs_are_listed_so AFTER INSERT ON run_owners
FOR EACH ROW EXECUTE FUNCTION stride_list_owner();
