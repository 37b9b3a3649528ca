-- Owner: registry.
-- The coordinator that leads. Every transaction of its writer extends `until` under its epoch, by the clock of this server.

CREATE TABLE IF NOT EXISTS leader (
    one             BIGINT      PRIMARY KEY CHECK (one = 1),
    epoch           BIGINT      NOT NULL,
    until           TIMESTAMPTZ NOT NULL,
    -- Name of the process for messages, and the address at which it answers, once it does.
    name            TEXT        NOT NULL,
    address         TEXT,
    -- Its session of this server, which a stand-by may end. A process id is given anew; both columns together are not.
    pid             INTEGER,
    backend_started TIMESTAMPTZ
) WITH (fillfactor = 50);

INSERT INTO leader (one, epoch, until, name) VALUES (1, 0, '-infinity', '') ON CONFLICT DO NOTHING;

-- The key of the server, which a stand-by continues with. Backups leave it out.
CREATE TABLE IF NOT EXISTS server_keys (
    one BIGINT PRIMARY KEY CHECK (one = 1),
    key TEXT   NOT NULL
);
