-- Schema 5: campaigns. jobs.kind 2 is a campaign; its row here has the id of the job.
--
-- `settings`: struct mo_campaign_settings as src/store/encode.c writes it: every bit of every
-- setting. `generations` replaces its number of generations, which extensions change. Replicates
-- are campaigns of one group, which has the id of its first campaign; initial designs and
-- environments are stored only with that one. Designs are numbered 0, 1, … in order of birth.

CREATE TABLE campaigns(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  settings BLOB NOT NULL,
  generations INTEGER NOT NULL,
  name TEXT NOT NULL, -- of the resulting controller; '': campaign-<job>
  preset TEXT NOT NULL, -- as requested; '': none
  controller INTEGER REFERENCES controllers(id), -- NULL: random weights
  controller_name TEXT NOT NULL, -- as requested; '': by hash, or none
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER REFERENCES environment_sets(id),
  n_environments INTEGER NOT NULL,
  n_listed INTEGER NOT NULL,
  initial_campaign INTEGER NOT NULL, -- 0: none
  replicates_of INTEGER NOT NULL, -- the first of the group
  replicate INTEGER NOT NULL,
  replicates INTEGER NOT NULL,
  checkpoint_every_s INTEGER NOT NULL,
  generation INTEGER NOT NULL, -- newest committed; -1: none
  n_designs INTEGER NOT NULL, -- ever born
  best_score REAL, -- of the newest population; NULL: none
  diversity_max REAL NOT NULL,
  ended INTEGER NOT NULL, -- 0 open, 1 completed, 2 exhausted
  scored_generation INTEGER NOT NULL, -- the generation of campaign_losses
  scored INTEGER NOT NULL, -- rows in campaign_losses
  result INTEGER REFERENCES controllers(id)
) STRICT;
CREATE INDEX campaigns_of_group ON campaigns(replicates_of, job);

CREATE TABLE campaign_environments(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  position INTEGER NOT NULL,
  environment INTEGER NOT NULL REFERENCES environments(id),
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

-- Listed designs first (campaigns.n_listed), then those of initial_campaign's population, best
-- first.
CREATE TABLE campaign_initial(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  position INTEGER NOT NULL,
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;

-- operator: 0 random, 1 listed, 2 inherited, 3 mutation, 4 crossover. parents: numbers; NULL: none.
-- died: the first generation whose population lacks the design; NULL: it lives. size: springs +
-- 2^16 masses + 2^26 voxels + 2^36 footprint.
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
  PRIMARY KEY(job, number)
) STRICT, WITHOUT ROWID;
CREATE INDEX campaigns_of_genotype ON campaign_designs(genotype, job);

-- One row per generation, for lists. REAL keeps the bits of every number but NaN, which is NULL.
CREATE TABLE campaign_generations(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  generation INTEGER NOT NULL,
  born_before INTEGER NOT NULL, -- number of its first child
  n_children INTEGER NOT NULL,
  n INTEGER NOT NULL,
  n_diverged INTEGER NOT NULL,
  mean_score REAL,
  least_score REAL,
  score_5 REAL,
  score_25 REAL,
  median_score REAL,
  score_75 REAL,
  score_95 REAL,
  most_score REAL,
  diversity REAL,
  species INTEGER NOT NULL,
  least_voxels REAL,
  mean_voxels REAL,
  most_voxels REAL,
  least_footprint REAL,
  mean_footprint REAL,
  most_footprint REAL,
  least_masses REAL,
  mean_masses REAL,
  most_masses REAL,
  least_springs REAL,
  mean_springs REAL,
  most_springs REAL,
  mean_parents REAL,
  mean_children REAL,
  mutation_attempts INTEGER NOT NULL,
  crossover_attempts INTEGER NOT NULL,
  mutants INTEGER NOT NULL,
  recombinants INTEGER NOT NULL,
  fallbacks INTEGER NOT NULL,
  exhausted INTEGER NOT NULL,
  survived_mutants INTEGER NOT NULL,
  survived_recombinants INTEGER NOT NULL,
  turnover REAL,
  rollouts INTEGER NOT NULL,
  rollouts_cached INTEGER NOT NULL,
  rollouts_diverged INTEGER NOT NULL,
  learning_steps INTEGER NOT NULL,
  first_loss REAL,
  last_loss REAL,
  collapse INTEGER NOT NULL,
  seconds REAL, -- wall time
  stored_us INTEGER NOT NULL,
  PRIMARY KEY(job, generation)
) STRICT, WITHOUT ROWID;

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

CREATE TABLE campaign_steps(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  generation INTEGER NOT NULL,
  step INTEGER NOT NULL, -- from 1 within the generation
  on_children INTEGER NOT NULL,
  training_step INTEGER NOT NULL,
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
  PRIMARY KEY(job, generation, step)
) STRICT, WITHOUT ROWID;

-- Losses of the current generation; deleted when it commits. losses: doubles; diverged: 32-bit
-- steps; one per environment.
CREATE TABLE campaign_losses(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  place INTEGER NOT NULL,
  losses BLOB NOT NULL,
  diverged BLOB NOT NULL,
  PRIMARY KEY(job, place)
) STRICT, WITHOUT ROWID;

-- The file campaigns/<job>/<generation>-<step>.checkpoint is written before its row.
CREATE TABLE campaign_checkpoints(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  generation INTEGER NOT NULL,
  step INTEGER NOT NULL,
  sha256 BLOB NOT NULL CHECK(length(sha256) = 32),
  size INTEGER NOT NULL,
  stored_us INTEGER NOT NULL,
  PRIMARY KEY(job, generation, step)
) STRICT, WITHOUT ROWID;
