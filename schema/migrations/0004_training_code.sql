-- Schema 4: which code computed a training's gradients, so that a training that resumed under other
-- code says so.

CREATE TABLE training_code(
  job INTEGER NOT NULL REFERENCES trainings(job),
  from_step INTEGER NOT NULL, -- steps learned before this code
  fingerprint INTEGER REFERENCES fingerprints(id), -- NULL: not recorded
  PRIMARY KEY(job, from_step)
) STRICT, WITHOUT ROWID;

INSERT INTO training_code(job, from_step, fingerprint) SELECT job, 0, NULL FROM trainings WHERE step > 0;
