-- Version 15: nobody is in quarantine any more. New databases do not have the table.

DROP TABLE IF EXISTS outcasts;

-- Controllers state how often they compute their outputs. 0: in every step, as all did before.
ALTER TABLE controllers ADD COLUMN control_period_s REAL NOT NULL DEFAULT 0;
