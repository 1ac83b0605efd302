-- Schema 3: weights. A job's part of the cores is its weight over the sum of the weights of those that run.

ALTER TABLE jobs ADD COLUMN weight REAL NOT NULL DEFAULT 1;
