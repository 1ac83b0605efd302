-- Version 22: measures have an origin, so that wrong ones can be found and replaced.

-- The host or worker that computed them; NULL: a version before this one, which did not record it.
-- The row's checksum includes it.
ALTER TABLE measures ADD COLUMN origin INTEGER REFERENCES origins(id);
