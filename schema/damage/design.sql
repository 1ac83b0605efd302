-- What keeps the design of the form :form from being read: as in job.sql.

SELECT printf('designs.first_seen_us of row %d is %d', id, first_seen_us)
FROM designs
WHERE form = :form AND first_seen_us NOT BETWEEN 1 AND 253402300799999999;

SELECT printf('genotypes.bits of row %d is no design', id)
FROM genotypes
WHERE design = (SELECT id FROM designs WHERE form = :form) AND length(bits) IS NOT 18
LIMIT 1;

SELECT CASE
    WHEN length(s.loss) IS NOT 8
    THEN printf('scores.loss of genotype %d, controller %d, physics %d and environment %d is no number',
      s.genotype, s.controller, s.physics, s.environment)
    WHEN length(c.sha256) IS NOT 32 THEN printf('controllers.sha256 of row %d is no hash', s.controller)
    WHEN length(p.sha256) IS NOT 32 THEN printf('physics.sha256 of row %d is no hash', s.physics)
    WHEN length(p.encoding) IS NOT 93 OR substr(p.encoding, 1, 1) <> x'01'
    THEN printf('physics.encoding of row %d cannot be decoded', s.physics)
    WHEN length(e.sha256) IS NOT 32 THEN printf('environments.sha256 of row %d is no hash', s.environment)
  END AS words
FROM genotypes g
CROSS JOIN scores s ON s.genotype = g.id
LEFT JOIN controllers c ON c.id = s.controller
LEFT JOIN physics p ON p.id = s.physics
LEFT JOIN environments e ON e.id = s.environment
WHERE g.design = (SELECT id FROM designs WHERE form = :form) AND words IS NOT NULL
LIMIT 1;

SELECT CASE
    WHEN s.n NOT BETWEEN 1 AND 64 THEN printf('environment_sets.n of row %d is %d', s.id, s.n)
    ELSE printf('environment_set_members.position of set %d is %d', s.id, m.position)
  END
FROM environment_sets s LEFT JOIN environment_set_members m ON m.environment_set = s.id
WHERE :form IS NOT NULL AND (s.n NOT BETWEEN 1 AND 64 OR m.position NOT BETWEEN 0 AND s.n - 1)
LIMIT 1;

SELECT printf('environment_set_members.environment_set of position %d is %d, which environment_sets has not', position, environment_set)
FROM environment_set_members
WHERE :form IS NOT NULL AND environment_set NOT IN (SELECT id FROM environment_sets)
LIMIT 1;

SELECT printf('campaign_designs.score of job %d and number %d is no number', x.job, x.number)
FROM genotypes g CROSS JOIN campaign_designs x ON x.genotype = g.id
WHERE g.design = (SELECT id FROM designs WHERE form = :form) AND length(x.score) IS NOT 8
LIMIT 1;
