-- Schema 6: devices. What computes a job is chosen once, so that the job resumes with the same
-- bits: 0 processor, 1 devices.

ALTER TABLE jobs ADD COLUMN back_end INTEGER NOT NULL DEFAULT 0;
