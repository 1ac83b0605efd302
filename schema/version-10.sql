-- Version 10: what springs and ground do in a recording. actuation: int8 (frames, springs), the
-- controller's outputs times 127. contacts: one byte, 0 or 1, for each mass (frames, n_masses).
-- Bits 2 and 3 of evaluations.record ask for them.
ALTER TABLE trajectories ADD COLUMN actuation BLOB;
ALTER TABLE trajectories ADD COLUMN contacts BLOB;
