-- Version 10: who submitted a job, what springs and ground do in a recording, and
-- how much recordings take.

-- The name of the token that the submission came with; NULL: it came without one.
ALTER TABLE jobs ADD COLUMN submitted_by TEXT;

-- Indexes of lists, as those by label: one for each combination of filters.
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

-- actuation: int8 (frames, springs), the controller's outputs times 127. contacts: one byte, 0 or
-- 1, for each mass (frames, n_masses). Bits 2 and 3 of evaluations.record ask for them.
ALTER TABLE trajectories ADD COLUMN actuation BLOB;
ALTER TABLE trajectories ADD COLUMN contacts BLOB;

-- Bytes of the arrays in `trajectories`, and when they were removed (0: they were not). `meta` has
-- the sum of the bytes.
ALTER TABLE evaluations ADD COLUMN recorded_bytes INTEGER NOT NULL DEFAULT 0;
ALTER TABLE evaluations ADD COLUMN recordings_removed_us INTEGER NOT NULL DEFAULT 0;
UPDATE evaluations SET recorded_bytes=(
  SELECT coalesce(sum(coalesce(length(com),0)+coalesce(length(masses),0)),0)
  FROM trajectories t WHERE t.job=evaluations.job) WHERE record<>0;
INSERT INTO meta(key,value)
  SELECT 'recorded bytes',coalesce(sum(recorded_bytes),0) FROM evaluations;
-- The oldest recordings, without a look at other evaluations.
CREATE INDEX evaluations_recorded ON evaluations(job) WHERE recorded_bytes>0;
