-- Owner: registry (written by the coordinator after each message).
-- The last row of the history that each webhook has received, so that a restart neither skips nor repeats one.

CREATE TABLE IF NOT EXISTS webhooks (
    name      TEXT    PRIMARY KEY,
    delivered INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
