-- Owner: registry.
-- The digests that the manifest in a blob names, so that a collection need not read it. Null if the blob is no manifest,
-- if it names many digests, or if no row has named it since this migration. A later build that finds more digests in a
-- manifest must clear this column.

ALTER TABLE blobs ADD COLUMN IF NOT EXISTS refers TEXT;
