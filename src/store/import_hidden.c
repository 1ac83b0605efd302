/* import_hidden.c: the jobs of an import: hidden until its end, then shown together, or deleted. */
#include <stdio.h>

#include "store/import_state.h"
#include "store/runs.h"

int mo_import_hide(struct mo_store *store, int64_t id)
{
#define OF_JOB                                                                                     \
  " WHERE (kind,label,experiment,submitted_by)=(SELECT kind,coalesce(label,''),"                   \
  "coalesce(experiment,''),coalesce(submitted_by,'') FROM jobs WHERE id=?1)"
  static const char sql[] = "UPDATE usage SET jobs=jobs-1" OF_JOB;
  static const char empty_sql[] = "DELETE FROM usage" OF_JOB " AND jobs=0";
#undef OF_JOB
  struct mo_connection *writer = &store->writer;
  const int error = mo_sql_do(writer, sql, mo_int(id));
  return error == MO_OK ? mo_sql_do(writer, empty_sql, mo_int(id)) : error;
}

/* Announces the first hidden job after *id. MO_ERR_NOT_FOUND: there is none. */
static int announce_next(struct mo_store *store, int64_t *id)
{
  static const char sql[] = "SELECT j.id,j.kind,i.store,i.source FROM jobs j"
                            " JOIN imports i ON i.job=j.id WHERE j.state=6 AND j.epoch<0"
                            " AND j.id>?1 ORDER BY j.id LIMIT 1";
  char more[96] = "";
  sqlite3_stmt *row;
  const int error = mo_sql_row(&store->writer, &row, sql, mo_int(*id));
  if (error != MO_OK)
    return error;
  *id = sqlite3_column_int64(row, 0);
  const enum mo_job_kind kind = (enum mo_job_kind)sqlite3_column_int(row, 1);
  if (kind == MO_JOB_CAMPAIGN)
    snprintf(more, sizeof(more), ",\"store\":\"%016llx\",\"campaign\":\"%lld\"",
             (unsigned long long)sqlite3_column_int64(row, 2), sqlite3_column_int64(row, 3));
  return mo_run_announce(store, *id, kind,
                         kind == MO_JOB_CAMPAIGN ? "campaign.imported" : "job.finished",
                         MO_JOB_SUCCEEDED, more);
}

int mo_import_show(struct mo_store *store, void *unused)
{
  static const char usage_sql[] =
      "INSERT INTO usage(kind,label,experiment,submitted_by,jobs,worker_us,device_us)"
      " SELECT kind,coalesce(label,''),coalesce(experiment,''),coalesce(submitted_by,''),count(*),"
      "0,0 FROM jobs WHERE state=6 AND epoch<0 GROUP BY 1,2,3,4"
      " ON CONFLICT DO UPDATE SET jobs=jobs+excluded.jobs";
  static const char sql[] = "UPDATE jobs SET state=-1-epoch,epoch=0 WHERE state=6 AND epoch<0";
  int64_t id = 0;
  int error;
  (void)unused;
  while ((error = announce_next(store, &id)) == MO_OK)
    ;
  if (error == MO_ERR_NOT_FOUND)
    error = mo_sql_do(&store->writer, usage_sql);
  return error == MO_OK ? mo_sql_do(&store->writer, sql) : error;
}

int mo_import_forget(struct mo_store *store, void *unused)
{
  static const char imports_sql[] =
      "DELETE FROM imports WHERE job IN (SELECT id FROM jobs WHERE state=6)";
  static const char sql[] = "UPDATE jobs SET epoch=0 WHERE state=6 AND epoch<0";
  (void)unused;
  const int error = mo_sql_do(&store->writer, imports_sql);
  return error == MO_OK ? mo_sql_do(&store->writer, sql) : error;
}
