-- Version 24: certificates of designs (kind 4).

-- settings: JSON (src/certificate/settings.c). population: the job whose best designs are the
-- job's designs; 0: they are listed. taken: what the campaign `population` provided, as bits: 1 the
-- controller, 2 the environments, 4 the physics. n_trials, n_rollouts: in all. rollouts_done: those
-- in certificate_losses. fingerprint, fingerprint64: the classes of the losses of float32 and
-- float64; NULL: the job has not started.
CREATE TABLE certificates(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  settings TEXT NOT NULL,
  n_designs INTEGER NOT NULL,
  population INTEGER NOT NULL,
  taken INTEGER NOT NULL,
  controller INTEGER NOT NULL REFERENCES controllers(id),
  controller_name TEXT NOT NULL,
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER REFERENCES environment_sets(id),
  n_environments INTEGER NOT NULL,
  n_trials INTEGER NOT NULL,
  n_rollouts INTEGER NOT NULL,
  trials_done INTEGER NOT NULL DEFAULT 0,
  rollouts_done INTEGER NOT NULL DEFAULT 0,
  fingerprint INTEGER REFERENCES fingerprints(id),
  fingerprint64 INTEGER REFERENCES fingerprints(id)
) STRICT;
CREATE INDEX certificates_of_population ON certificates(population) WHERE population<>0;

-- Losses of a trial, in the order in which they are computed (src/store/certificates.h). place: the
-- number of the first of them. losses: float32; +infinity: diverged; then a checksum. measures:
-- packed as in the table measures; NULL: the trial has none.
CREATE TABLE certificate_losses(
  job INTEGER NOT NULL REFERENCES certificates(job),
  trial INTEGER NOT NULL,
  place INTEGER NOT NULL,
  losses BLOB NOT NULL,
  measures BLOB,
  PRIMARY KEY(job, trial, place)
) STRICT, WITHOUT ROWID;
