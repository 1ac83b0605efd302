-- Schema 3: weights. A job's share of the cores is its weight over the sum of the weights of all
-- running jobs.

ALTER TABLE jobs ADD COLUMN weight REAL NOT NULL DEFAULT 1;
