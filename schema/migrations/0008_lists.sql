-- Schema 8: indexes of lists, so that reading a page visits only the rows that it shows.

CREATE INDEX jobs_of_kind ON jobs(kind, id);
CREATE INDEX jobs_of_kind_by_state ON jobs(kind, state, id);
-- One label can be on nearly all jobs or on few, so each combination of filters has its own index.
CREATE INDEX jobs_by_label ON jobs(label, id) WHERE label IS NOT NULL;
CREATE INDEX jobs_by_label_and_state ON jobs(label, state, id) WHERE label IS NOT NULL;
CREATE INDEX jobs_by_label_and_kind ON jobs(label, kind, id) WHERE label IS NOT NULL;
CREATE INDEX jobs_by_label_kind_and_state ON jobs(label, kind, state, id) WHERE label IS NOT NULL;
