-- Schema 6: devices. Where a job is computed is chosen once, so that it goes on with the same bits: 0 processor, 1 devices.

ALTER TABLE jobs ADD COLUMN back_end INTEGER NOT NULL DEFAULT 0;
