-- Version 16: evaluations can estimate the errors of their scores.

-- Displaced starts from which the errors of an evaluation's scores are estimated; 0: they are not.
ALTER TABLE evaluations ADD COLUMN n_displaced INTEGER NOT NULL DEFAULT 0;

-- A job that ends deletes its list. Jobs that ended before did not. 3: succeeded; after it the
-- other ways to end.
DELETE FROM waiting_designs WHERE job IN (SELECT id FROM jobs WHERE state>=3);
