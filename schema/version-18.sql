-- Version 18: evaluations can ask for measures of their rollouts.

-- The measures that an evaluation asks for, as bits (enum mo_measure); 0: none.
ALTER TABLE evaluations ADD COLUMN measures INTEGER NOT NULL DEFAULT 0;

-- The measures of a genotype's rollouts under a condition, whose losses may be in other rows.
-- packed: a 32-bit head, the values, environment by environment, and a 64-bit checksum of the row
-- and its condition (src/store/measures.c). The bits do not depend on the block, so all rows agree.
CREATE TABLE measures(
  genotype INTEGER NOT NULL REFERENCES genotypes(id),
  condition INTEGER NOT NULL REFERENCES conditions(id),
  computed_us INTEGER NOT NULL,
  packed BLOB NOT NULL CHECK(length(packed) >= 16),
  PRIMARY KEY(genotype, condition)
) STRICT, WITHOUT ROWID;
