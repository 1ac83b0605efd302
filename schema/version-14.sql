-- Version 14: evaluations of random bodies, which are drawn from a seed after the submission.

-- random_seed: its designs are n_designs random bodies of this seed, from number random_first on
-- (NULL: they were listed); the first n_drawn of them are in job_designs. It starts when all are.
ALTER TABLE evaluations ADD COLUMN random_seed INTEGER;
ALTER TABLE evaluations ADD COLUMN random_first INTEGER NOT NULL DEFAULT 0;
ALTER TABLE evaluations ADD COLUMN n_drawn INTEGER NOT NULL DEFAULT 0;
CREATE INDEX evaluations_undrawn ON evaluations(job)
  WHERE random_seed IS NOT NULL AND n_drawn<n_designs;
