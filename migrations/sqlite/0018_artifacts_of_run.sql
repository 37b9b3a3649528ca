-- Owner: registry.
-- The bytes of a run's artifacts count against the limit of its group, and are read at each submission of a limited group.

CREATE INDEX IF NOT EXISTS artifacts_of_run ON artifacts (run, stage);
