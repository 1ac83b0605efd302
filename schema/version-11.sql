-- Version 11: designs of a request that were skipped or repaired; studies; experiments, notes,
-- archived and deleted jobs, and what jobs have used; campaigns that came in bundles; quarantine.

-- position: of the design in the request (for a campaign, the first of its group: in the list of
-- its initial designs; for a study: in its newest batch). job_designs of an evaluation has no row
-- at a position that was skipped.
CREATE TABLE design_notes(
  job INTEGER NOT NULL REFERENCES jobs(id),
  position INTEGER NOT NULL,
  dropped INTEGER NOT NULL, -- voxels that the repair removed
  pointer TEXT,             -- place and text of the fault; NULL: it was not skipped
  detail TEXT,
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

-- How many of its n_designs were skipped.
ALTER TABLE evaluations ADD COLUMN n_skipped INTEGER NOT NULL DEFAULT 0;

-- best: how many of the best designs get whole scores; 0: all. cut: rollouts of the others that
-- were not computed; `done` has them, too.
ALTER TABLE evaluations ADD COLUMN best INTEGER NOT NULL DEFAULT 0;
ALTER TABLE evaluations ADD COLUMN cut INTEGER NOT NULL DEFAULT 0;
-- Of a design that cannot be among the best: the environments whose losses count, as bits. NULL:
-- all. Losses that are stored later do not change what the evaluation says.
ALTER TABLE job_designs ADD COLUMN counted INTEGER;

-- The way of the center of mass from frame to frame, in meters; NULL: com was not recorded, or is
-- not finite. The index is read without the recordings beside it.
ALTER TABLE trajectories ADD COLUMN path_m REAL;
CREATE INDEX trajectories_path ON trajectories(job, position, path_m);

-- A study: a campaign whose children somebody else makes, batch by batch; a batch is a generation.
-- batch: the newest that was told (-1: none); it is pending until that generation is committed.
-- sha256: of its request. children: its children, and a checksum (src/store/studies.c). survivors:
-- 32-bit numbers of those of the population that live on; NULL: the settings select.
CREATE TABLE studies(
  job INTEGER PRIMARY KEY REFERENCES campaigns(job),
  batch INTEGER NOT NULL,
  sha256 BLOB NOT NULL CHECK(length(sha256) = 32),
  children BLOB NOT NULL,
  survivors BLOB
) STRICT;

-- A study's own words, in the order of their first use. kind: 0 operators (the first one is
-- operator 5 of campaign_designs), 1 measures.
CREATE TABLE study_words(
  job INTEGER NOT NULL REFERENCES studies(job),
  kind INTEGER NOT NULL,
  place INTEGER NOT NULL,
  word TEXT NOT NULL,
  PRIMARY KEY(job, kind, place)
) STRICT, WITHOUT ROWID;

-- Doubles, in the order of the study's measures; NaN: not given. NULL: none.
ALTER TABLE campaign_designs ADD COLUMN measures BLOB;

-- experiment: what the job belongs to. worker_s, device_s: seconds that workers and devices have
-- computed for it, up to its last event. State 6: being deleted, in steps of bounded size; for
-- readers the job is gone.
ALTER TABLE jobs ADD COLUMN experiment TEXT;
ALTER TABLE jobs ADD COLUMN note TEXT;
ALTER TABLE jobs ADD COLUMN archived_us INTEGER NOT NULL DEFAULT 0; -- 0: it is not
ALTER TABLE jobs ADD COLUMN worker_s REAL NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN device_s REAL NOT NULL DEFAULT 0;
CREATE INDEX jobs_by_experiment ON jobs(experiment, id) WHERE experiment IS NOT NULL;
CREATE INDEX jobs_archived ON jobs(id) WHERE archived_us>0;
-- The oldest that a rule of retention may delete.
CREATE INDEX jobs_by_end ON jobs(kind, finished_us)
  WHERE state>=3 AND state<6 AND archived_us=0 AND note IS NULL;

-- What deleted jobs have used. '': none.
CREATE TABLE past_usage(
  kind INTEGER NOT NULL,
  label TEXT NOT NULL,
  experiment TEXT NOT NULL,
  submitted_by TEXT NOT NULL,
  jobs INTEGER NOT NULL,
  worker_s REAL NOT NULL,
  device_s REAL NOT NULL,
  PRIMARY KEY(kind, label, experiment, submitted_by)
) STRICT, WITHOUT ROWID;

-- The class of GPUs that the service had last, or, where it had none, its workers: fingerprints of
-- scores and gradients.
CREATE TABLE device_class(
  id INTEGER PRIMARY KEY CHECK(id = 1),
  scores TEXT NOT NULL,
  gradients TEXT NOT NULL
) STRICT;

-- Who refers to a job, or was bred from its controller.
CREATE INDEX idempotency_keys_of_job ON idempotency_keys(job);
CREATE INDEX trainings_of_population ON trainings(population) WHERE population<>0;
CREATE INDEX campaigns_of_initial ON campaigns(initial_campaign) WHERE initial_campaign<>0;
CREATE INDEX runs_of_controller ON runs(controller) WHERE controller IS NOT NULL;

-- Where an imported campaign, or evaluation with recordings, came from: the id of its store, and
-- its own there. digest: so that it does not enter twice, the SHA-256 of a campaign's history as
-- the bundle had it (docs/bundles.md), or of where an evaluation ran.
CREATE TABLE imports(
  job INTEGER PRIMARY KEY REFERENCES jobs(id) ON DELETE CASCADE,
  store INTEGER NOT NULL,
  source INTEGER NOT NULL,
  digest BLOB NOT NULL UNIQUE CHECK(length(digest) = 32),
  imported_us INTEGER NOT NULL
) STRICT;

-- Who computed each loss: rows of `origins`, 8 bytes each, little-endian; 0: this host. NULL: this
-- host computed all.
ALTER TABLE campaign_losses ADD COLUMN origins BLOB;

-- A child that cannot survive is scored in some of its environments only: losses of campaign_losses
-- are then NaN where they were not computed, and the score of the design is a lower bound.
ALTER TABLE campaign_designs ADD COLUMN is_cut INTEGER NOT NULL DEFAULT 0;

-- Workers of other machines that may not join, by their token ('': none) and their own name, until
-- somebody releases the name.
CREATE TABLE outcasts(
  user TEXT NOT NULL,
  name TEXT NOT NULL,
  host TEXT NOT NULL,
  why TEXT NOT NULL,
  since_us INTEGER NOT NULL,
  PRIMARY KEY(user, name)
) STRICT, WITHOUT ROWID;

-- 1: the children of the next generation race, because that saved time in the last one, or would
-- have.
ALTER TABLE campaigns ADD COLUMN race_pays INTEGER NOT NULL DEFAULT 0;
