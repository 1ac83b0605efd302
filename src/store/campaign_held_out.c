/* campaign_held_out.c: results of re-evaluated generations. */
#include "store/campaign_rows.h"

static int from_row(sqlite3_stmt *row, void *any)
{
  struct mo_re_evaluated *result = any;
  *result = (struct mo_re_evaluated){.number = mo_column_u32(row, 0),
                                     .generation = mo_column_u32(row, 1),
                                     .worlds = mo_column_u32(row, 2),
                                     .diverged = mo_column_u32(row, 3),
                                     .mean = mo_column_number(row, 4),
                                     .standard_error = mo_column_number(row, 5)};
  return MO_OK;
}

int mo_campaign_held_out_row(struct mo_connection *writer, int64_t id,
                             const struct mo_re_evaluated *result)
{
  static const char sql[] =
      "INSERT INTO campaign_held_out(job,generation,number,worlds,diverged,mean,standard_error)"
      " VALUES(?1,?2,?3,?4,?5,?6,?7)";
  return mo_sql_do(writer, sql, mo_int(id), mo_int(result->generation), mo_int(result->number),
                   mo_int(result->worlds), mo_int(result->diverged), mo_real(result->mean),
                   mo_real(result->standard_error));
}

int64_t mo_store_campaign_held_out(struct mo_store *store, int64_t id, uint32_t generation,
                                   struct mo_re_evaluated rows[MO_ELITE_MAX])
{
  static const char sql[] =
      "SELECT number,generation,worlds,diverged,mean,standard_error FROM campaign_held_out"
      " WHERE job=?1 AND generation=?2 ORDER BY number LIMIT ?3";
  return mo_read_page(store, sql, MO_VALUES(mo_int(id), mo_int(generation), mo_int(MO_ELITE_MAX)),
                      from_row, rows, sizeof(*rows));
}

int mo_store_campaign_re_evaluated(struct mo_store *store, int64_t id, int64_t generation,
                                   int64_t *ret)
{
  static const char sql[] = "SELECT generation FROM campaign_held_out WHERE job=?1 AND"
                            " generation<=?2 ORDER BY generation DESC LIMIT 1";
  return mo_read_integers(store, sql, MO_VALUES(mo_int(id), mo_int(generation)), 1, ret);
}
