-- Version 21: evaluations can score designs in all tasks of a suite.

-- The name of the suite whose sets the job's environments are, set after set; NULL: none.
ALTER TABLE evaluations ADD COLUMN suite TEXT;
