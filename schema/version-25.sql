-- Version 25: measures in atlases.

-- measures: of each body in the file, as bits (include/morpho/measure.h); 0: none.
ALTER TABLE atlases ADD COLUMN measures INTEGER NOT NULL DEFAULT 0;
