-- The schema of a new database: version 14. Versions 1 to 8 were those of morphod 0.1, 9 to 13 of
-- programs that were not released; their state folders are refused. A later version adds a file
-- here (src/store/open.c applies them in order, in one transaction that also sets user_version).
--
-- Numbers whose bits matter are BLOBs of 8-byte little-endian doubles, because REAL turns NaN into
-- NULL and −0 into 0. Times are microseconds since 1970 UTC. Hashes are the 32 bytes of a SHA-256.
-- Genotypes are bit strings with voxel 0 in the top bit of byte 0.

CREATE TABLE meta(
  key TEXT PRIMARY KEY NOT NULL,
  value INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
INSERT INTO meta(key,value) VALUES('recorded bytes',0); -- the sum of evaluations.recorded_bytes

-- A design: all orientations of one body. `form` is canonical.
CREATE TABLE designs(
  id INTEGER PRIMARY KEY,
  form BLOB NOT NULL UNIQUE CHECK(length(form) = 18),
  first_seen_us INTEGER NOT NULL
) STRICT;

-- An oriented genotype, placed in the workspace. This is what rollouts score.
CREATE TABLE genotypes(
  id INTEGER PRIMARY KEY,
  bits BLOB NOT NULL UNIQUE CHECK(length(bits) = 18),
  design INTEGER NOT NULL REFERENCES designs(id)
) STRICT;
CREATE INDEX genotypes_of_design ON genotypes(design);

-- Weights, by content. The file controllers/<sha256>.safetensors is written before its row.
CREATE TABLE controllers(
  id INTEGER PRIMARY KEY,
  sha256 BLOB NOT NULL UNIQUE CHECK(length(sha256) = 32),
  size INTEGER NOT NULL,
  sensor INTEGER NOT NULL,
  nx INTEGER NOT NULL,
  ny INTEGER NOT NULL,
  nz INTEGER NOT NULL,
  n_parameters INTEGER NOT NULL,
  metadata TEXT NOT NULL,
  stored_us INTEGER NOT NULL
) STRICT;

CREATE TABLE controller_names(
  name TEXT PRIMARY KEY NOT NULL,
  controller INTEGER NOT NULL REFERENCES controllers(id),
  version INTEGER NOT NULL,
  stored_us INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

-- `data`: 66 doubles: light x, y, then the heights; from version 17 on, the task may follow.
-- `sha256` is the hash of `data`.
CREATE TABLE environments(
  id INTEGER PRIMARY KEY,
  sha256 BLOB NOT NULL UNIQUE CHECK(length(sha256) = 32),
  data BLOB NOT NULL CHECK(length(data) = 528)
) STRICT;

CREATE TABLE environment_sets(
  id INTEGER PRIMARY KEY,
  name TEXT NOT NULL UNIQUE,
  n INTEGER NOT NULL CHECK(n BETWEEN 1 AND 64)
) STRICT;

CREATE TABLE environment_set_members(
  environment_set INTEGER NOT NULL REFERENCES environment_sets(id),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL REFERENCES environments(id),
  PRIMARY KEY(environment_set, position)
) STRICT, WITHOUT ROWID;
CREATE INDEX environment_sets_of ON environment_set_members(environment);

-- `encoding`: the hashed bytes (src/store/hash.c): all physics values, precision, sensor.
CREATE TABLE physics(
  id INTEGER PRIMARY KEY,
  sha256 BLOB NOT NULL UNIQUE CHECK(length(sha256) = 32),
  encoding BLOB NOT NULL
) STRICT;

-- What the bits of a score depend on besides its key: back end, instruction set, version of the
-- code.
CREATE TABLE fingerprints(
  id INTEGER PRIMARY KEY,
  text TEXT NOT NULL UNIQUE
) STRICT;

-- Who computed a score: the host.
CREATE TABLE origins(
  id INTEGER PRIMARY KEY,
  text TEXT NOT NULL UNIQUE
) STRICT;

-- What a loss depends on besides the genotype: weights, physics, class (fingerprint), and a block
-- of up to 16 environments that one call computed. `environments`: the ids of the block's
-- environments, 8 bytes each, little-endian; condition_environments has the same as rows.
CREATE TABLE conditions(
  id INTEGER PRIMARY KEY,
  controller INTEGER NOT NULL REFERENCES controllers(id),
  physics INTEGER NOT NULL REFERENCES physics(id),
  fingerprint INTEGER NOT NULL REFERENCES fingerprints(id),
  environments BLOB NOT NULL
    CHECK(length(environments) BETWEEN 8 AND 128 AND length(environments) % 8 = 0),
  UNIQUE(controller, physics, fingerprint, environments)
) STRICT;

CREATE TABLE condition_environments(
  condition INTEGER NOT NULL REFERENCES conditions(id),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL REFERENCES environments(id),
  PRIMARY KEY(condition, position)
) STRICT, WITHOUT ROWID;

-- The losses of a genotype under a condition. Rows are never deleted, and only changed where losses
-- of another origin are found wrong (src/store/origins.c). losses: doubles; if any rollout diverged
-- the 32-bit steps; a 64-bit checksum of the row and its condition (src/store/scores.c). Where two
-- rows hold the same environment, the one computed first counts.
CREATE TABLE scores(
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  condition INTEGER NOT NULL REFERENCES conditions(id),
  origin INTEGER NOT NULL REFERENCES origins(id),
  computed_us INTEGER NOT NULL,
  losses BLOB NOT NULL CHECK(length(losses) BETWEEN 16 AND 200),
  PRIMARY KEY(genotype, condition)
) STRICT, WITHOUT ROWID;

-- What a mean loss over a named set depends on besides the genotype.
CREATE TABLE rankings(
  id INTEGER PRIMARY KEY,
  controller INTEGER NOT NULL REFERENCES controllers(id),
  physics INTEGER NOT NULL REFERENCES physics(id),
  fingerprint INTEGER NOT NULL REFERENCES fingerprints(id),
  environment_set INTEGER NOT NULL REFERENCES environment_sets(id),
  UNIQUE(controller, physics, fingerprint, environment_set)
) STRICT;

-- The mean loss of a genotype over a whole named set; +infinity when a rollout diverged. REAL keeps
-- every bit of it but the sign of 0. `checksum`: of ranking, genotype and score.
CREATE TABLE set_scores(
  ranking INTEGER NOT NULL REFERENCES rankings(id),
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  score REAL NOT NULL,
  checksum INTEGER NOT NULL,
  PRIMARY KEY(ranking, genotype)
) STRICT, WITHOUT ROWID;
CREATE INDEX set_scores_best ON set_scores(ranking, score, genotype);

-- kind: 0 evaluation, 1 training, 2 campaign; the job's row in the table of its kind has the same
-- id. state: 0 queued, 1 running, 2 paused, 3 succeeded, 4 failed, 5 cancelled.
-- priority: 0 batch, 1 interactive. weight: the job's share of the cores is its weight over the sum
-- of the weights of all running jobs. back_end: what computes the job, chosen once, so that it
-- resumes with the same bits: 0 processor, 1 devices. epoch: the opening of the store whose process
-- runs the job; updates from other epochs are refused. submitted_by: the name of the token that the
-- submission came with; NULL: it came without one. experiment: what the job belongs to. worker_s,
-- device_s: seconds that workers and devices have computed for it, up to its last event. State 6:
-- being deleted, in steps of bounded size; for readers the job is gone. Or, with an epoch below 0,
-- being imported, in such steps, too: for readers it is not there yet.
CREATE TABLE jobs(
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  kind INTEGER NOT NULL,
  state INTEGER NOT NULL,
  priority INTEGER NOT NULL,
  weight REAL NOT NULL,
  back_end INTEGER NOT NULL,
  version INTEGER NOT NULL,
  epoch INTEGER NOT NULL,
  attempts INTEGER NOT NULL,
  label TEXT,
  created_us INTEGER NOT NULL,
  started_us INTEGER NOT NULL,
  finished_us INTEGER NOT NULL,
  error INTEGER NOT NULL,
  error_text TEXT,
  submitted_by TEXT,
  experiment TEXT,
  note TEXT,
  archived_us INTEGER NOT NULL DEFAULT 0, -- 0: it is not
  worker_s REAL NOT NULL DEFAULT 0,
  device_s REAL NOT NULL DEFAULT 0
) STRICT;
CREATE INDEX jobs_by_state ON jobs(state, id);
CREATE INDEX jobs_queued ON jobs(priority, id) WHERE state = 0;
-- Indexes of lists, so that reading a page visits only the rows that it shows.
CREATE INDEX jobs_of_kind ON jobs(kind, id);
CREATE INDEX jobs_of_kind_by_state ON jobs(kind, state, id);
-- One label can be on nearly all jobs or on few, so each combination of filters has its own index.
CREATE INDEX jobs_by_label ON jobs(label, id) WHERE label IS NOT NULL;
CREATE INDEX jobs_by_label_and_state ON jobs(label, state, id) WHERE label IS NOT NULL;
CREATE INDEX jobs_by_label_and_kind ON jobs(label, kind, id) WHERE label IS NOT NULL;
CREATE INDEX jobs_by_label_kind_and_state ON jobs(label, kind, state, id) WHERE label IS NOT NULL;
-- The same of one user.
CREATE INDEX jobs_of_user ON jobs(submitted_by, id) WHERE submitted_by IS NOT NULL;
CREATE INDEX jobs_of_user_by_state ON jobs(submitted_by, state, id)
  WHERE submitted_by IS NOT NULL;
CREATE INDEX jobs_of_user_by_kind ON jobs(submitted_by, kind, id) WHERE submitted_by IS NOT NULL;
CREATE INDEX jobs_of_user_by_kind_and_state ON jobs(submitted_by, kind, state, id)
  WHERE submitted_by IS NOT NULL;
CREATE INDEX jobs_of_user_by_label ON jobs(submitted_by, label, id)
  WHERE submitted_by IS NOT NULL AND label IS NOT NULL;
CREATE INDEX jobs_of_user_by_label_and_state ON jobs(submitted_by, label, state, id)
  WHERE submitted_by IS NOT NULL AND label IS NOT NULL;
CREATE INDEX jobs_of_user_by_label_and_kind ON jobs(submitted_by, label, kind, id)
  WHERE submitted_by IS NOT NULL AND label IS NOT NULL;
CREATE INDEX jobs_of_user_by_label_kind_and_state ON jobs(submitted_by, label, kind, state, id)
  WHERE submitted_by IS NOT NULL AND label IS NOT NULL;
CREATE INDEX jobs_by_experiment ON jobs(experiment, id) WHERE experiment IS NOT NULL;
CREATE INDEX jobs_archived ON jobs(id) WHERE archived_us>0;
-- The oldest that a rule of retention may delete.
CREATE INDEX jobs_by_end ON jobs(kind, finished_us)
  WHERE state>=3 AND state<6 AND archived_us=0 AND note IS NULL;

-- What jobs have used is summed as they use it, so that nobody reads all jobs. Jobs of these words,
-- deleted ones too, and what they have used, in whole microseconds: sums of integers are exact,
-- however often a part is taken away and added again. The words are '' where a job has none.
-- Triggers keep the table.
CREATE TABLE usage(
  kind INTEGER NOT NULL,
  label TEXT NOT NULL,
  experiment TEXT NOT NULL,
  submitted_by TEXT NOT NULL,
  jobs INTEGER NOT NULL,
  worker_us INTEGER NOT NULL,
  device_us INTEGER NOT NULL,
  PRIMARY KEY(kind, label, experiment, submitted_by)
) STRICT, WITHOUT ROWID;

CREATE TRIGGER usage_of_new AFTER INSERT ON jobs BEGIN
  INSERT INTO usage(kind, label, experiment, submitted_by, jobs, worker_us, device_us)
    VALUES(new.kind, coalesce(new.label, ''), coalesce(new.experiment, ''),
      coalesce(new.submitted_by, ''), 1, CAST(round(new.worker_s * 1e6) AS INTEGER),
      CAST(round(new.device_s * 1e6) AS INTEGER))
    ON CONFLICT DO UPDATE SET jobs = jobs + 1, worker_us = worker_us + excluded.worker_us,
      device_us = device_us + excluded.device_us;
END;

-- A deleted job (state 6) counts on as it was.
CREATE TRIGGER usage_of_changed AFTER UPDATE OF label, experiment, worker_s, device_s ON jobs
WHEN old.state <> 6 BEGIN
  UPDATE usage SET jobs = jobs - 1,
    worker_us = worker_us - CAST(round(old.worker_s * 1e6) AS INTEGER),
    device_us = device_us - CAST(round(old.device_s * 1e6) AS INTEGER)
    WHERE kind = old.kind AND label = coalesce(old.label, '')
      AND experiment = coalesce(old.experiment, '')
      AND submitted_by = coalesce(old.submitted_by, '');
  INSERT INTO usage(kind, label, experiment, submitted_by, jobs, worker_us, device_us)
    VALUES(new.kind, coalesce(new.label, ''), coalesce(new.experiment, ''),
      coalesce(new.submitted_by, ''), 1, CAST(round(new.worker_s * 1e6) AS INTEGER),
      CAST(round(new.device_s * 1e6) AS INTEGER))
    ON CONFLICT DO UPDATE SET jobs = jobs + 1, worker_us = worker_us + excluded.worker_us,
      device_us = device_us + excluded.device_us;
  DELETE FROM usage WHERE kind = old.kind AND label = coalesce(old.label, '')
    AND experiment = coalesce(old.experiment, '')
    AND submitted_by = coalesce(old.submitted_by, '') AND jobs = 0;
END;

-- recorded_bytes: of its arrays in `trajectories`. recordings_removed_us: when they were removed
-- (0: they were not). n_skipped: how many of its n_designs were skipped. best: how many of the best
-- designs get whole scores; 0: all. cut: rollouts of the others that were not computed; `done` has
-- them, too. random_seed: its designs are n_designs random bodies of this seed, from number
-- random_first on (NULL: they were listed). n_waiting: so many, the last ones, are not in
-- job_designs yet; it starts when none waits.
CREATE TABLE evaluations(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  controller INTEGER NOT NULL REFERENCES controllers(id),
  controller_name TEXT NOT NULL,
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER REFERENCES environment_sets(id),
  n_designs INTEGER NOT NULL,
  n_environments INTEGER NOT NULL,
  verify INTEGER NOT NULL,
  record INTEGER NOT NULL, -- bit 0: center of mass, 1: masses, 2: actuation, 3: contacts
  record_stride INTEGER NOT NULL,
  done INTEGER NOT NULL,
  cached INTEGER NOT NULL,
  diverged INTEGER NOT NULL,
  fingerprint INTEGER REFERENCES fingerprints(id), -- its class; NULL: not started
  workers INTEGER REFERENCES fingerprints(id), -- the class of bodies that devices leave to workers
  recorded_bytes INTEGER NOT NULL DEFAULT 0,
  recordings_removed_us INTEGER NOT NULL DEFAULT 0,
  n_skipped INTEGER NOT NULL DEFAULT 0,
  best INTEGER NOT NULL DEFAULT 0,
  cut INTEGER NOT NULL DEFAULT 0,
  random_seed INTEGER,
  random_first INTEGER NOT NULL DEFAULT 0,
  n_waiting INTEGER NOT NULL DEFAULT 0
) STRICT;
-- The oldest recordings, without a look at other evaluations.
CREATE INDEX evaluations_recorded ON evaluations(job) WHERE recorded_bytes>0;
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

-- The designs of an evaluation or a training, in order. Of a campaign (the first of its group) the
-- initial ones: the listed ones (campaigns.n_listed), then those of initial_campaign's population,
-- best first. An evaluation has no row at a position that was skipped. counted: of a design that
-- cannot be among the best, the environments whose losses count, as bits; NULL: all. Losses that
-- are stored later do not change what the evaluation says.
CREATE TABLE job_designs(
  job INTEGER NOT NULL REFERENCES jobs(id),
  position INTEGER NOT NULL,
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  counted INTEGER,
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

-- Designs of a request that were skipped or repaired, or named by an id alone. position: of the
-- design in the request (for a campaign, the first of its group: in the list of its initial
-- designs; for a study: in its newest batch). robot: the notation of the orientation that was taken
-- for an id alone (ID@K); NULL: the request gave one. orientation: how it was chosen (enum
-- mo_orientation in src/store/design_notes.h).
CREATE TABLE design_notes(
  job INTEGER NOT NULL REFERENCES jobs(id),
  position INTEGER NOT NULL,
  dropped INTEGER NOT NULL, -- voxels that the repair removed
  pointer TEXT,             -- place and text of the fault; NULL: it was not skipped
  detail TEXT,
  robot TEXT,
  orientation INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

-- The environments of an evaluation or of a campaign (the first of its group), in order.
CREATE TABLE job_environments(
  job INTEGER NOT NULL REFERENCES jobs(id),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL REFERENCES environments(id),
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

-- The loss that a verify job computed, and the one stored before (NULL: none); 8-byte doubles.
CREATE TABLE recomputed(
  job INTEGER NOT NULL REFERENCES evaluations(job),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL, -- position
  loss BLOB NOT NULL CHECK(length(loss) = 8),
  diverged_step INTEGER NOT NULL,
  stored BLOB CHECK(length(stored) = 8),
  checksum INTEGER NOT NULL, -- of the row
  PRIMARY KEY(job, position, environment)
) STRICT, WITHOUT ROWID;

-- com: doubles (frames, 3). masses: float32 (frames, n_masses, 3). Little-endian. actuation: int8
-- (frames, springs), the controller's outputs times 127. contacts: one byte, 0 or 1, for each mass
-- (frames, n_masses). path_m: the way of the center of mass from frame to frame, in meters; NULL:
-- com was not recorded, or is not finite.
CREATE TABLE trajectories(
  id INTEGER PRIMARY KEY,
  job INTEGER NOT NULL REFERENCES evaluations(job),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL, -- position
  stride INTEGER NOT NULL,
  frames INTEGER NOT NULL,
  n_masses INTEGER NOT NULL,
  diverged_step INTEGER NOT NULL,
  com BLOB,
  masses BLOB,
  actuation BLOB,
  contacts BLOB,
  path_m REAL,
  UNIQUE(job, position, environment)
) STRICT;
-- Read without the recordings beside it.
CREATE INDEX trajectories_path ON trajectories(job, position, path_m);

CREATE TABLE idempotency_keys(
  key TEXT PRIMARY KEY NOT NULL,
  body_sha256 BLOB NOT NULL CHECK(length(body_sha256) = 32),
  job INTEGER NOT NULL REFERENCES jobs(id),
  created_us INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
CREATE INDEX idempotency_keys_age ON idempotency_keys(created_us);
CREATE INDEX idempotency_keys_of_job ON idempotency_keys(job);

CREATE TABLE events(
  sequence INTEGER PRIMARY KEY AUTOINCREMENT,
  time_us INTEGER NOT NULL,
  job INTEGER NOT NULL, -- 0: none
  type TEXT NOT NULL,
  data TEXT NOT NULL
) STRICT;
CREATE INDEX events_of_job ON events(job, sequence);

-- The class of GPUs that the service had last, or, where it had none, its workers: fingerprints of
-- scores and gradients.
CREATE TABLE device_class(
  id INTEGER PRIMARY KEY CHECK(id = 1),
  scores TEXT NOT NULL,
  gradients TEXT NOT NULL
) STRICT;

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

-- ---- trainings and campaigns ----

-- What both have. `settings`: a JSON object with every bit of every setting (src/store/fields.c).
-- json_valid() may not check it: a schema that is not trusted may not call it in SQLite 3.40.
CREATE TABLE runs(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  settings TEXT NOT NULL CHECK(settings GLOB '{*}'),
  name TEXT NOT NULL, -- of the resulting controller; '': <kind>-<job>
  controller INTEGER REFERENCES controllers(id), -- that it starts from; NULL: random weights
  controller_name TEXT NOT NULL, -- as requested; '': by hash, or none
  result INTEGER REFERENCES controllers(id)
) STRICT;
CREATE INDEX runs_of_controller ON runs(controller) WHERE controller IS NOT NULL;

-- The file trainings/<job>/<step>.checkpoint or campaigns/<job>/<generation>-<step>.checkpoint is
-- written before its row.
CREATE TABLE checkpoints(
  job INTEGER NOT NULL REFERENCES runs(job),
  generation INTEGER NOT NULL, -- 0 in a training
  step INTEGER NOT NULL,
  sha256 BLOB NOT NULL CHECK(length(sha256) = 32),
  size INTEGER NOT NULL,
  stored_us INTEGER NOT NULL,
  PRIMARY KEY(job, generation, step)
) STRICT, WITHOUT ROWID;

-- ---- trainings ----

-- The tables of rows of numbers (training_steps, training_validations, campaign_generations,
-- campaign_steps) are made from the lists of their columns: src/store/columns.c, rows.c.
CREATE TABLE trainings(
  job INTEGER PRIMARY KEY REFERENCES runs(job),
  n_designs INTEGER NOT NULL,
  population INTEGER NOT NULL, -- the job whose designs are used; 0: none
  step INTEGER NOT NULL -- newest row of training_steps
) STRICT;
CREATE INDEX trainings_of_population ON trainings(population) WHERE population<>0;

-- Which code computed a training's gradients, so that a training that resumed under other code says
-- so.
CREATE TABLE training_code(
  job INTEGER NOT NULL REFERENCES trainings(job),
  from_step INTEGER NOT NULL, -- steps learned before this code
  fingerprint INTEGER NOT NULL REFERENCES fingerprints(id),
  PRIMARY KEY(job, from_step)
) STRICT, WITHOUT ROWID;

-- ---- campaigns ----

-- `generations` replaces that of the settings, because extensions change it. Replicates are
-- campaigns of one group, which has the id of its first campaign; initial designs and environments
-- are stored only with that one. Designs are numbered 0, 1, … in order of birth. race_pays: 1: the
-- children of the next generation race, because that saved time in the last one, or would have.
CREATE TABLE campaigns(
  job INTEGER PRIMARY KEY REFERENCES runs(job),
  generations INTEGER NOT NULL,
  preset TEXT NOT NULL, -- as requested; '': none
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER REFERENCES environment_sets(id),
  n_environments INTEGER NOT NULL,
  n_listed INTEGER NOT NULL,
  initial_campaign INTEGER NOT NULL, -- 0: none
  replicates_of INTEGER NOT NULL, -- the first of the group
  replicate INTEGER NOT NULL,
  replicates INTEGER NOT NULL,
  generation INTEGER NOT NULL, -- newest committed; -1: none
  n_designs INTEGER NOT NULL, -- ever born
  best_score REAL, -- of the newest population; NULL: none
  diversity_max REAL NOT NULL,
  ended INTEGER NOT NULL, -- 0 open, 1 completed, 2 exhausted
  scored_generation INTEGER NOT NULL, -- the generation of campaign_losses
  scored INTEGER NOT NULL, -- rows in campaign_losses
  race_pays INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE INDEX campaigns_of_group ON campaigns(replicates_of, job);
CREATE INDEX campaigns_of_initial ON campaigns(initial_campaign) WHERE initial_campaign<>0;

-- operator: 0 random, 1 listed, 2 inherited, 3 mutation, 4 crossover. parents: numbers; NULL: none.
-- died: the first generation whose population lacks the design; NULL: it lives. size: springs +
-- 2^16 masses + 2^26 voxels + 2^36 footprint. measures: doubles, in the order of the study's
-- measures; NaN: not given; NULL: none. is_cut: a child that cannot survive is scored in some of
-- its environments only: losses of campaign_losses are then NaN where they were not computed, and
-- the score of the design is a lower bound.
CREATE TABLE campaign_designs(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  number INTEGER NOT NULL,
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  operator INTEGER NOT NULL,
  parent INTEGER,
  other_parent INTEGER,
  born INTEGER NOT NULL,
  died INTEGER,
  score BLOB NOT NULL CHECK(length(score) = 8), -- its last score
  size INTEGER NOT NULL,
  measures BLOB,
  is_cut INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY(job, number)
) STRICT, WITHOUT ROWID;
CREATE INDEX campaigns_of_genotype ON campaign_designs(genotype, job);

-- births: 9 bytes per child: operator, parents as 32-bit numbers (2^32 − 1: none). population: 12
-- bytes per design, best first: 32-bit number, score. Little-endian. A table of its own keeps the
-- rows above small, and lets a phylogeny be read in one pass.
CREATE TABLE campaign_populations(
  id INTEGER PRIMARY KEY,
  job INTEGER NOT NULL REFERENCES campaigns(job),
  generation INTEGER NOT NULL,
  births BLOB NOT NULL,
  population BLOB NOT NULL,
  UNIQUE(job, generation)
) STRICT;

-- Losses of the current generation; deleted when it commits. losses: as in `scores`; the top bit of
-- a step says that workers computed a loss of a campaign that devices compute. origins: who
-- computed each loss: rows of `origins`, 8 bytes each, little-endian; 0: this host. NULL: this host
-- computed all.
CREATE TABLE campaign_losses(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  place INTEGER NOT NULL,
  losses BLOB NOT NULL,
  origins BLOB,
  PRIMARY KEY(job, place)
) STRICT, WITHOUT ROWID;

-- ---- studies ----

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
