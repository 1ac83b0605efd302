-- Version 23: jobs that build atlases (kind 3).

-- The file is atlases/<name>.atlas, and ends with .part until the job has succeeded. orientations:
-- 0 canonical, 1 images. bodies_total: 0 until the job has started. rollouts_done: of bodies_done.
-- physics: with the precision and sensor of the scores.
CREATE TABLE atlases(
  job INTEGER PRIMARY KEY REFERENCES jobs(id),
  name TEXT NOT NULL,
  voxels INTEGER NOT NULL,
  orientations INTEGER NOT NULL,
  controller INTEGER NOT NULL REFERENCES controllers(id),
  controller_name TEXT NOT NULL,
  physics INTEGER NOT NULL REFERENCES physics(id),
  environment_set INTEGER REFERENCES environment_sets(id),
  n_environments INTEGER NOT NULL,
  bodies_total INTEGER NOT NULL DEFAULT 0,
  bodies_done INTEGER NOT NULL DEFAULT 0,
  rollouts_done INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE INDEX atlases_by_name ON atlases(name);
