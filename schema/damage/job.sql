-- What keeps the job :job from being read: each statement gives the words of the first row that breaks its rule, and nothing of whole data.
-- Asked, in this order, when a reading has failed (src/store/damage.c).

-- ---- the rows that there must be ----

WITH needed(t, job, n) AS (
  SELECT 'evaluation_designs', job, n_designs FROM evaluations WHERE job = :job
  UNION ALL SELECT 'evaluation_environments', job, n_environments FROM evaluations WHERE job = :job
  UNION ALL SELECT 'training_designs', job, n_designs FROM trainings WHERE job = :job
  UNION ALL SELECT 'campaign_populations', job, generation + 1 FROM campaigns WHERE job = :job
  UNION ALL SELECT 'campaign_designs', job, n_designs FROM campaigns WHERE job = :job
  UNION ALL SELECT 'campaign_environments', replicates_of, n_environments FROM campaigns WHERE job = :job
), stored(t, n, first, last) AS (
  SELECT 'evaluation_designs', count(*), min(position), max(position) FROM evaluation_designs WHERE job = :job
  UNION ALL SELECT 'evaluation_environments', count(*), min(position), max(position) FROM evaluation_environments WHERE job = :job
  UNION ALL SELECT 'training_designs', count(*), min(position), max(position) FROM training_designs WHERE job = :job
  UNION ALL SELECT 'campaign_populations', count(*), min(generation), max(generation) FROM campaign_populations WHERE job = :job
  UNION ALL SELECT 'campaign_designs', count(*), min(number), max(number) FROM campaign_designs WHERE job = :job
  UNION ALL SELECT 'campaign_environments', count(*), min(position), max(position) FROM campaign_environments
    WHERE job = (SELECT replicates_of FROM campaigns WHERE job = :job)
)
SELECT printf('%s of job %d has %d rows, not those from 0 to %d', t, job, stored.n, needed.n - 1)
FROM needed JOIN stored USING (t)
WHERE needed.n > 0 AND (stored.n, first, last) IS NOT (needed.n, 0, needed.n - 1)
LIMIT 1;

SELECT printf('campaigns.n_designs of job %d is %d, campaign_populations.births has %d', c.job, c.n_designs, b.n)
FROM campaigns c JOIN (SELECT sum(length(births)) / 9 AS n FROM campaign_populations WHERE job = :job) b
WHERE c.job = :job AND c.generation >= 0 AND c.n_designs <> b.n;

-- ---- evaluations ----

SELECT printf('scores.loss of genotype %d, controller %d, physics %d and environment %d is no number',
  s.genotype, s.controller, s.physics, s.environment)
FROM evaluations v
CROSS JOIN evaluation_designs x ON x.job = v.job
CROSS JOIN scores s ON s.genotype = x.genotype AND s.controller = v.controller AND s.physics = v.physics
WHERE v.job = :job AND length(s.loss) IS NOT 8
LIMIT 1;

SELECT printf('recomputed.%s of job %d, position %d and environment %d is no number',
  iif(length(loss) IS 8, 'stored', 'loss'), job, position, environment)
FROM recomputed
WHERE job = :job AND (length(loss) IS NOT 8 OR length(stored) <> 8)
LIMIT 1;

SELECT printf('recomputed of job %d has position %d and environment %d, of %d and %d',
  r.job, r.position, r.environment, v.n_designs, v.n_environments)
FROM recomputed r JOIN evaluations v ON v.job = r.job
WHERE r.job = :job AND NOT (r.position BETWEEN 0 AND v.n_designs - 1 AND r.environment BETWEEN 0 AND v.n_environments - 1)
LIMIT 1;

SELECT CASE
    WHEN stride NOT BETWEEN 1 AND 1000000 THEN printf('trajectories.stride of row %d is %d', id, stride)
    WHEN frames NOT BETWEEN 1 AND 1000001 THEN printf('trajectories.frames of row %d is %d', id, frames)
    WHEN n_masses NOT BETWEEN 1 AND 245 THEN printf('trajectories.n_masses of row %d is %d', id, n_masses)
    WHEN length(com) <> frames * 24 THEN printf('trajectories.com of row %d has %d bytes', id, length(com))
    WHEN length(masses) <> frames * n_masses * 12 THEN printf('trajectories.masses of row %d has %d bytes', id, length(masses))
  END AS words
FROM trajectories
WHERE job = :job AND words IS NOT NULL
LIMIT 1;

-- ---- trainings ----

SELECT printf('training_checkpoints.sha256 of job %d and step %d is no hash', job, step)
FROM training_checkpoints
WHERE job = :job AND length(sha256) IS NOT 32
LIMIT 1;

-- ---- campaigns ----

SELECT CASE
    WHEN length(births) % 9 THEN printf('campaign_populations.births of row %d has %d bytes', id, length(births))
    WHEN length(population) % 12 THEN printf('campaign_populations.population of row %d has %d bytes', id, length(population))
  END AS words
FROM campaign_populations
WHERE job = :job AND words IS NOT NULL
LIMIT 1;

SELECT CASE
    WHEN length(l.losses) <> 8 * c.n_environments
    THEN printf('campaign_losses.losses of job %d and place %d has %d bytes', l.job, l.place, length(l.losses))
    WHEN length(l.diverged) <> 4 * c.n_environments
    THEN printf('campaign_losses.diverged of job %d and place %d has %d bytes', l.job, l.place, length(l.diverged))
  END AS words
FROM campaign_losses l JOIN campaigns c ON c.job = l.job
WHERE l.job = :job AND words IS NOT NULL
LIMIT 1;

SELECT printf('campaign_checkpoints.sha256 of job %d, generation %d and step %d is no hash', job, generation, step)
FROM campaign_checkpoints
WHERE job = :job AND length(sha256) IS NOT 32
LIMIT 1;

SELECT printf('campaign_designs.score of job %d and number %d is no number', job, number)
FROM campaign_designs
WHERE job = :job AND length(score) IS NOT 8
LIMIT 1;

-- ---- what rows of every kind refer to ----

WITH used(t, job, environment) AS (
  SELECT 'evaluation_environments', job, environment FROM evaluation_environments WHERE job = :job
  UNION ALL SELECT 'campaign_environments', job, environment FROM campaign_environments
    WHERE job = (SELECT replicates_of FROM campaigns WHERE job = :job)
)
SELECT CASE
    WHEN e.id IS NULL THEN printf('%s.environment of job %d is %d, which environments has not', t, job, environment)
    WHEN length(e.data) IS NOT 528 THEN printf('environments.data of row %d is no environment', e.id)
    WHEN length(e.sha256) IS NOT 32 THEN printf('environments.sha256 of row %d is no hash', e.id)
    ELSE printf('environments.data of row %d has not the hash environments.sha256', e.id)
  END
FROM used LEFT JOIN environments e ON e.id = used.environment
WHERE length(e.data) IS NOT 528 OR e.sha256 IS NOT sha256(e.data)
LIMIT 1;

WITH used(t, job, genotype) AS (
  SELECT 'evaluation_designs', job, genotype FROM evaluation_designs WHERE job = :job
  UNION ALL SELECT 'training_designs', job, genotype FROM training_designs WHERE job = :job
  UNION ALL SELECT 'campaign_initial', job, genotype FROM campaign_initial
    WHERE job = (SELECT replicates_of FROM campaigns WHERE job = :job)
  UNION ALL SELECT 'campaign_designs', job, genotype FROM campaign_designs WHERE job = :job
)
SELECT CASE
    WHEN g.id IS NULL THEN printf('%s.genotype of job %d is %d, which genotypes has not', t, job, genotype)
    WHEN length(g.bits) IS NOT 18 THEN printf('genotypes.bits of row %d is no design', g.id)
    WHEN d.id IS NULL THEN printf('genotypes.design of row %d is %d, which designs has not', g.id, g.design)
    ELSE printf('designs.form of row %d is no design', d.id)
  END
FROM used LEFT JOIN genotypes g ON g.id = used.genotype LEFT JOIN designs d ON d.id = g.design
WHERE length(g.bits) IS NOT 18 OR length(d.form) IS NOT 18
LIMIT 1;
