-- Version 11: designs of a request that were skipped or repaired; studies.

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
