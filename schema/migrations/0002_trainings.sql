-- Schema 2: trainings. jobs.kind 1 is a training; its row here has the id of the job.
--
-- `settings`: struct mo_training_settings as src/store/encode.c writes it: every bit of every
-- setting. Learning curves use REAL, which keeps the bits of all their numbers; NaN (all robots of
-- the step diverged) is NULL.

CREATE TABLE trainings(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  kind INTEGER NOT NULL, -- 0 pretrain, 1 finetune
  settings BLOB NOT NULL,
  name TEXT NOT NULL, -- of the resulting controller; '': training-<job>
  parent INTEGER REFERENCES controllers(id), -- NULL: random weights
  parent_name TEXT NOT NULL, -- as requested; '': by hash, or none
  n_designs INTEGER NOT NULL,
  population INTEGER NOT NULL, -- the job whose designs are used; 0: none
  n_steps INTEGER NOT NULL,
  validate_every_steps INTEGER NOT NULL,
  checkpoint_every_steps INTEGER NOT NULL,
  checkpoint_every_s INTEGER NOT NULL,
  checkpoints_kept INTEGER NOT NULL,
  step INTEGER NOT NULL, -- newest row of training_steps
  result INTEGER REFERENCES controllers(id)
) STRICT;

CREATE TABLE training_designs(
  job INTEGER NOT NULL REFERENCES trainings(job),
  position INTEGER NOT NULL,
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

CREATE TABLE training_steps(
  job INTEGER NOT NULL REFERENCES trainings(job),
  step INTEGER NOT NULL, -- from 1
  mean_loss REAL,
  rate REAL NOT NULL,
  gradient_norm REAL,
  clipped_share REAL NOT NULL,
  clipped_robots_share REAL NOT NULL,
  diverged INTEGER NOT NULL,
  zeroed INTEGER NOT NULL,
  skipped INTEGER NOT NULL,
  bounded INTEGER NOT NULL,
  seconds REAL NOT NULL, -- wall time
  PRIMARY KEY(job, step)
) STRICT, WITHOUT ROWID;

CREATE TABLE training_validations(
  job INTEGER NOT NULL REFERENCES trainings(job),
  step INTEGER NOT NULL, -- steps that the weights had learned
  rollouts INTEGER NOT NULL,
  diverged INTEGER NOT NULL,
  mean_score REAL,
  standard_error REAL,
  PRIMARY KEY(job, step)
) STRICT, WITHOUT ROWID;

-- The file trainings/<job>/<step>.checkpoint is written before its row.
CREATE TABLE training_checkpoints(
  job INTEGER NOT NULL REFERENCES trainings(job),
  step INTEGER NOT NULL,
  sha256 BLOB NOT NULL CHECK(length(sha256) = 32),
  size INTEGER NOT NULL,
  stored_us INTEGER NOT NULL,
  PRIMARY KEY(job, step)
) STRICT, WITHOUT ROWID;
