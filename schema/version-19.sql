-- Version 19: evaluations can request an accuracy.

-- The tolerance of the estimated errors of an evaluation's scores; 0: none.
ALTER TABLE evaluations ADD COLUMN tolerance REAL NOT NULL DEFAULT 0;
