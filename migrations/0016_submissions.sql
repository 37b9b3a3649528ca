-- Owner: registry (written by the coordinator through `registry::Write`).
-- The digest of the body of a run's submission, so that its idempotency key cannot stand for another one.

ALTER TABLE runs ADD COLUMN submission TEXT;
