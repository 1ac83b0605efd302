-- Version 12: the orientations of designs that a request named by an id alone.

-- robot: the notation of the orientation that was taken (ID@K); NULL: the request gave one.
-- orientation: how it was chosen (enum mo_orientation in src/store/design_notes.h).
ALTER TABLE design_notes ADD COLUMN robot TEXT;
ALTER TABLE design_notes ADD COLUMN orientation INTEGER NOT NULL DEFAULT 0;
