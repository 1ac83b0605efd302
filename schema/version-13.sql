-- Version 13: what jobs have used is summed as they use it, so that nobody reads all jobs.

-- Jobs of these words, deleted ones too, and what they have used, in whole microseconds: sums of
-- integers are exact, however often a part is taken away and added again. The words are '' where a
-- job has none. Triggers keep the table.
CREATE TABLE usage(
  kind INTEGER NOT NULL,
  label TEXT NOT NULL,
  experiment TEXT NOT NULL,
  submitted_by TEXT NOT NULL,
  jobs INTEGER NOT NULL,
  worker_us INTEGER NOT NULL,
  device_us INTEGER NOT NULL,
  PRIMARY KEY(kind, label, experiment, submitted_by)
) STRICT, WITHOUT ROWID;
INSERT INTO usage(kind, label, experiment, submitted_by, jobs, worker_us, device_us)
  SELECT kind, label, experiment, submitted_by, sum(n), sum(w), sum(d) FROM (
    SELECT kind, coalesce(label, '') label, coalesce(experiment, '') experiment,
      coalesce(submitted_by, '') submitted_by, 1 n, CAST(round(worker_s * 1e6) AS INTEGER) w,
      CAST(round(device_s * 1e6) AS INTEGER) d FROM jobs WHERE state <> 6
    UNION ALL SELECT kind, label, experiment, submitted_by, jobs,
      CAST(round(worker_s * 1e6) AS INTEGER), CAST(round(device_s * 1e6) AS INTEGER)
      FROM past_usage)
  GROUP BY kind, label, experiment, submitted_by;
DROP TABLE past_usage;

CREATE TRIGGER usage_of_new AFTER INSERT ON jobs BEGIN
  INSERT INTO usage(kind, label, experiment, submitted_by, jobs, worker_us, device_us)
    VALUES(new.kind, coalesce(new.label, ''), coalesce(new.experiment, ''),
      coalesce(new.submitted_by, ''), 1, CAST(round(new.worker_s * 1e6) AS INTEGER),
      CAST(round(new.device_s * 1e6) AS INTEGER))
    ON CONFLICT DO UPDATE SET jobs = jobs + 1, worker_us = worker_us + excluded.worker_us,
      device_us = device_us + excluded.device_us;
END;

-- A deleted job (state 6) counts on as it was.
CREATE TRIGGER usage_of_changed AFTER UPDATE OF label, experiment, worker_s, device_s ON jobs
WHEN old.state <> 6 BEGIN
  UPDATE usage SET jobs = jobs - 1,
    worker_us = worker_us - CAST(round(old.worker_s * 1e6) AS INTEGER),
    device_us = device_us - CAST(round(old.device_s * 1e6) AS INTEGER)
    WHERE kind = old.kind AND label = coalesce(old.label, '')
      AND experiment = coalesce(old.experiment, '')
      AND submitted_by = coalesce(old.submitted_by, '');
  INSERT INTO usage(kind, label, experiment, submitted_by, jobs, worker_us, device_us)
    VALUES(new.kind, coalesce(new.label, ''), coalesce(new.experiment, ''),
      coalesce(new.submitted_by, ''), 1, CAST(round(new.worker_s * 1e6) AS INTEGER),
      CAST(round(new.device_s * 1e6) AS INTEGER))
    ON CONFLICT DO UPDATE SET jobs = jobs + 1, worker_us = worker_us + excluded.worker_us,
      device_us = device_us + excluded.device_us;
  DELETE FROM usage WHERE kind = old.kind AND label = coalesce(old.label, '')
    AND experiment = coalesce(old.experiment, '')
    AND submitted_by = coalesce(old.submitted_by, '') AND jobs = 0;
END;
