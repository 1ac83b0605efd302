/* labels.c: see labels.h. */
#include "store/labels.h"

#include "base/clock.h"
#include "base/thread.h"
#include "store/runs.h"

/* ---- changes ---- */

struct edit_arguments {
  int64_t id;
  const struct mo_job_edit *edit;
};

static int edit_job(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE jobs SET " MO_NEXT_VERSION ",label=iif(?2,?3,label),"
                            "experiment=iif(?4,?5,experiment),note=iif(?6,?7,note),"
                            "archived_us=iif(?8,iif(?9>0 AND archived_us>0,archived_us,?9),"
                            "archived_us) WHERE id=?1 AND state<>6";
  const struct edit_arguments *call = arguments;
  const struct mo_job_edit *edit = call->edit;
  enum mo_job_state state = MO_JOB_QUEUED;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  int error =
      mo_sql_change(&store->writer, sql, mo_int(call->id), mo_int(edit->has_label),
                    mo_string(edit->label), mo_int(edit->has_experiment),
                    mo_string(edit->experiment), mo_int(edit->has_note), mo_string(edit->note),
                    mo_int(edit->has_archived), mo_int(edit->archived ? mo_clock_wall_us() : 0));
  if (error == MO_OK)
    error = mo_job_state_get(&store->writer, call->id, &state, &kind);
  return error == MO_OK ? mo_run_announce(store, call->id, kind, "job.changed", state, "")
         : error == MO_ERR_CONFLICT ? MO_ERR_NOT_FOUND
                                    : error;
}

int mo_store_edit_job(struct mo_store *store, int64_t id, const struct mo_job_edit *edit)
{
  return mo_write(store, edit_job, &(struct edit_arguments){id, edit});
}

/* ---- usage ---- */

static int take_usage(sqlite3_stmt *row, void *any)
{
  struct mo_usage_row *usage = any;
  mo_column_text(row, 0, usage->name, sizeof(usage->name));
  usage->jobs = (uint64_t)sqlite3_column_int64(row, 1);
  usage->worker_s = sqlite3_column_double(row, 2);
  usage->device_s = sqlite3_column_double(row, 3);
  return MO_OK;
}

int64_t mo_store_usage(struct mo_store *store, enum mo_usage_by by, struct mo_usage_row *rows,
                       size_t limit)
{
#define USAGE(column)                                                                              \
  "SELECT " column ",sum(jobs),sum(worker_us)/1e6,sum(device_us)/1e6 FROM usage GROUP BY 1"        \
  " ORDER BY sum(worker_us)+sum(device_us) DESC,1 LIMIT ?1"
  static const char *const sql[MO_USAGES] = {USAGE("kind"), USAGE("label"), USAGE("experiment"),
                                             USAGE("submitted_by")};
#undef USAGE
  return mo_read_page(store, sql[by], MO_VALUES(mo_int((int64_t)limit)), take_usage, rows,
                      sizeof(*rows));
}

void mo_store_meter(struct mo_store *store,
                    bool (*used)(void *context, int64_t job, double *worker_s, double *device_s),
                    void *context)
{
  MO_GUARD(&store->listeners_mutex);
  store->used = used;
  store->used_context = context;
}
