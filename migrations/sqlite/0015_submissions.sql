-- Owner: registry (written by the coordinator through `registry::Write`).
-- The digest of the body of a run's submission, so that its idempotency key cannot stand for another one.

CREATE TABLE IF NOT EXISTS submissions (
    run    TEXT PRIMARY KEY,
    digest TEXT NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TRIGGER IF NOT EXISTS forgotten_runs_have_no_submission AFTER DELETE ON runs BEGIN
    DELETE FROM submissions WHERE run = old.run;
END;
