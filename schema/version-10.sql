-- Version 10: who submitted a job, and what springs and ground do in a recording.

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

-- actuation: int8 (frames, springs), the
-- controller's outputs times 127. contacts: one byte, 0 or 1, for each mass (frames, n_masses).
-- Bits 2 and 3 of evaluations.record ask for them.
ALTER TABLE trajectories ADD COLUMN actuation BLOB;
ALTER TABLE trajectories ADD COLUMN contacts BLOB;
