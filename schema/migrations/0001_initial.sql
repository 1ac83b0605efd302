-- Schema 1. Applied in one transaction, which also sets user_version.
--
-- Numbers whose bits matter are BLOBs of 8-byte little-endian doubles, because REAL turns NaN into
-- NULL and −0 into 0. Times are microseconds since 1970 UTC. Hashes are the 32 bytes of a SHA-256.
-- Genotypes are bit strings with voxel 0 in the top bit of byte 0.

CREATE TABLE meta(
  key TEXT PRIMARY KEY NOT NULL,
  value INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

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

-- `data`: 66 doubles: light x, y, then the heights. `sha256` is the hash of `data`.
CREATE TABLE environments(
  id INTEGER PRIMARY KEY,
  sha256 BLOB NOT NULL UNIQUE CHECK(length(sha256) = 32),
  data BLOB NOT NULL CHECK(length(data) = 528)
) STRICT;

CREATE TABLE environment_sets(
  id INTEGER PRIMARY KEY,
  name TEXT NOT NULL UNIQUE,
  n INTEGER NOT NULL
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

-- One rollout. Rows are never changed or deleted.
CREATE TABLE scores(
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  controller INTEGER NOT NULL REFERENCES controllers(id),
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment INTEGER NOT NULL REFERENCES environments(id),
  loss BLOB NOT NULL CHECK(length(loss) = 8),
  diverged_step INTEGER NOT NULL,
  fingerprint INTEGER NOT NULL REFERENCES fingerprints(id),
  computed_us INTEGER NOT NULL,
  PRIMARY KEY(genotype, controller, physics, environment)
) STRICT, WITHOUT ROWID;

-- The mean loss of a genotype over a whole named set; +infinity when a rollout diverged. `score` is
-- for sorting; `bits` is exact.
CREATE TABLE set_scores(
  controller INTEGER NOT NULL REFERENCES controllers(id),
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER NOT NULL REFERENCES environment_sets(id),
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  score REAL NOT NULL,
  bits BLOB NOT NULL CHECK(length(bits) = 8),
  PRIMARY KEY(controller, physics, environment_set, genotype)
) STRICT, WITHOUT ROWID;
CREATE INDEX set_scores_best ON set_scores(controller, physics, environment_set, score, genotype);

-- kind: 0 evaluation. state: 0 queued, 1 running, 2 paused, 3 succeeded, 4 failed, 5 cancelled.
-- priority: 0 batch, 1 interactive. epoch: the opening of the store whose process runs the job;
-- updates from other epochs are refused.
CREATE TABLE jobs(
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  kind INTEGER NOT NULL,
  state INTEGER NOT NULL,
  priority INTEGER NOT NULL,
  version INTEGER NOT NULL,
  epoch INTEGER NOT NULL,
  attempts INTEGER NOT NULL,
  label TEXT,
  created_us INTEGER NOT NULL,
  started_us INTEGER NOT NULL,
  finished_us INTEGER NOT NULL,
  error INTEGER NOT NULL,
  error_text TEXT
) STRICT;
CREATE INDEX jobs_by_state ON jobs(state, id);
CREATE INDEX jobs_queued ON jobs(priority, id) WHERE state = 0;

CREATE TABLE evaluations(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  controller INTEGER NOT NULL REFERENCES controllers(id),
  controller_name TEXT NOT NULL,
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER REFERENCES environment_sets(id),
  n_designs INTEGER NOT NULL,
  n_environments INTEGER NOT NULL,
  verify INTEGER NOT NULL,
  record INTEGER NOT NULL, -- bit 0: center of mass, bit 1: masses
  record_stride INTEGER NOT NULL,
  done INTEGER NOT NULL,
  cached INTEGER NOT NULL,
  diverged INTEGER NOT NULL
) STRICT;

CREATE TABLE evaluation_designs(
  job INTEGER NOT NULL REFERENCES evaluations(job),
  position INTEGER NOT NULL,
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

CREATE TABLE evaluation_environments(
  job INTEGER NOT NULL REFERENCES evaluations(job),
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
  PRIMARY KEY(job, position, environment)
) STRICT, WITHOUT ROWID;

-- com: doubles (frames, 3). masses: float32 (frames, n_masses, 3). Little-endian.
CREATE TABLE trajectories(
  id INTEGER PRIMARY KEY,
  job INTEGER NOT NULL REFERENCES evaluations(job),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL, -- position
  stride INTEGER NOT NULL,
  frames INTEGER NOT NULL,
  n_masses INTEGER NOT NULL,
  com BLOB,
  masses BLOB,
  UNIQUE(job, position, environment)
) STRICT;

CREATE TABLE idempotency_keys(
  key TEXT PRIMARY KEY NOT NULL,
  body_sha256 BLOB NOT NULL CHECK(length(body_sha256) = 32),
  job INTEGER NOT NULL REFERENCES jobs(id),
  created_us INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
CREATE INDEX idempotency_keys_age ON idempotency_keys(created_us);

CREATE TABLE events(
  sequence INTEGER PRIMARY KEY AUTOINCREMENT,
  time_us INTEGER NOT NULL,
  job INTEGER NOT NULL, -- 0: none
  type TEXT NOT NULL,
  data TEXT NOT NULL
) STRICT;
CREATE INDEX events_of_job ON events(job, sequence);
