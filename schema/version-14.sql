-- Version 14: evaluations whose designs are stored in groups, after the submission.

-- random_seed: its designs are n_designs random bodies of this seed, from number random_first on
-- (NULL: they were listed). n_waiting: so many, the last ones, are not in job_designs yet. It
-- starts when none waits.
ALTER TABLE evaluations ADD COLUMN random_seed INTEGER;
ALTER TABLE evaluations ADD COLUMN random_first INTEGER NOT NULL DEFAULT 0;
ALTER TABLE evaluations ADD COLUMN n_waiting INTEGER NOT NULL DEFAULT 0;
CREATE INDEX evaluations_waiting ON evaluations(job) WHERE n_waiting>0;

-- Listed designs that wait, in groups: `bits` are genotypes as they were given, not placed, one
-- after the other, from design `first` of the evaluation on.
CREATE TABLE waiting_designs(
  job INTEGER NOT NULL REFERENCES jobs(id),
  first INTEGER NOT NULL,
  bits BLOB NOT NULL,
  checksum INTEGER NOT NULL,
  PRIMARY KEY(job, first)
) STRICT, WITHOUT ROWID;
