-- Version 11: designs of a request that were skipped or repaired.

-- position: of the design in the request (for a campaign, the first of its group: in the list of
-- its initial designs). job_designs of an evaluation has no row at a position that was skipped.
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
