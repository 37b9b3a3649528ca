-- Owner: registry.
-- Roll-ups of 512 values become level 2; those of 4,096 become level 3. A curve of a million values is then read from 2,000 rows.

UPDATE rollups SET level = 3 WHERE level = 2;
INSERT INTO rollups (series, level, last_step, first_step, count, odd, low, high, sum, last)
SELECT series, 2, max(last_step), min(first_step), CAST(sum(count) AS BIGINT), CAST(sum(odd) AS BIGINT), min(low), max(high), sum(sum),
    max(CASE WHEN place % 8 = 7 THEN last END)
FROM (SELECT *, row_number() OVER (PARTITION BY series ORDER BY last_step) - 1 AS place FROM rollups WHERE level = 1) AS of_64
GROUP BY series, place / 8 HAVING count(*) = 8;
