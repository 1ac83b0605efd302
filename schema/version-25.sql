-- Version 25: measures in atlases; campaigns score their best designs again, in fresh worlds;
-- designs know their certificates; training runs that finetune each of their designs alone.

-- measures: of each body in the file, as bits (include/morpho/measure.h); 0: none.
ALTER TABLE atlases ADD COLUMN measures INTEGER NOT NULL DEFAULT 0;

-- Results of a re-evaluated generation (src/store/re_evaluation.h). mean, standard_error: NULL if a
-- rollout diverged. Its summary is in campaign_generations, to which opening a database adds the
-- columns that are missing (src/store/rows.c).
CREATE TABLE campaign_held_out(
  job INTEGER NOT NULL REFERENCES campaigns(job),
  generation INTEGER NOT NULL,
  number INTEGER NOT NULL,
  worlds INTEGER NOT NULL,
  diverged INTEGER NOT NULL,
  mean REAL,
  standard_error REAL,
  PRIMARY KEY(job, generation, number)
) STRICT, WITHOUT ROWID;
CREATE UNIQUE INDEX campaign_held_out_by_design ON campaign_held_out(job, number, generation);

-- The designs of certificates that have succeeded. verdict: enum mo_verdict_class; NULL: a version
-- before this one computed the certificate.
CREATE TABLE certificate_verdicts(
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  job INTEGER NOT NULL REFERENCES certificates(job),
  controller INTEGER NOT NULL REFERENCES controllers(id),
  verdict INTEGER,
  PRIMARY KEY(genotype, job)
) STRICT, WITHOUT ROWID;
CREATE INDEX certificate_verdicts_of_job ON certificate_verdicts(job);
INSERT OR IGNORE INTO certificate_verdicts(genotype, job, controller, verdict)
  SELECT d.genotype, k.job, k.controller, NULL FROM certificates k
  JOIN jobs j ON j.id = k.job AND j.state = 3 JOIN job_designs d ON d.job = k.job;

-- One row per design that has learned. position: of the design in job_designs. zero_shot,
-- finetuned: its scores in the held-out environments before and after; NULL: a rollout diverged.
-- *_diverged: how many did. controller: the SHA-256 of the file that it learned, which is stored
-- only if `kept` is 1, under the name <name>-<position>.
CREATE TABLE training_bodies(
  job INTEGER NOT NULL REFERENCES trainings(job),
  position INTEGER NOT NULL,
  zero_shot REAL,
  zero_shot_diverged INTEGER NOT NULL,
  finetuned REAL,
  finetuned_diverged INTEGER NOT NULL,
  controller BLOB NOT NULL CHECK(length(controller) = 32),
  kept INTEGER NOT NULL,
  stored_us INTEGER NOT NULL,
  PRIMARY KEY(job, position)
) STRICT, WITHOUT ROWID;
