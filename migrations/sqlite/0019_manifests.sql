-- Owner: registry.
-- The digests that the manifest of a named artifact names, so that a collection need not read it. Artifacts that were
-- named before have no row, and neither have those with many digests.
--
-- Rows are deleted with the manifest's blob. A build that finds more digests in a manifest must delete all of them.

CREATE TABLE IF NOT EXISTS manifests (
    digest TEXT PRIMARY KEY,
    refers TEXT NOT NULL CHECK (json_valid(refers))
) STRICT, WITHOUT ROWID;
