/* paper_test.c: the paper's test set, a constant of the code with rows of its own, so that scores
 * can refer to it. What a folder has once called by its name keeps that meaning there. */
#include "store/contents.h"
#include "store/internal.h"

#define NAME "paper-test"

static int make(struct mo_store *store, void *arguments)
{
  static const char set_sql[] = "INSERT INTO environment_sets(name,n) VALUES('" NAME "',?1)";
  static const char member_sql[] =
      "INSERT INTO environment_set_members(environment_set,position,environment) VALUES(?1,?2,?3)";
  const struct mo_environment *environments = arguments;
  struct mo_connection *writer = &store->writer;
  int64_t set = 0, size = 0, row = 0;
  int error = mo_environment_set_find(writer, NAME, &set, &size);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  error = mo_sql_insert(writer, &set, set_sql, mo_int(MO_PAPER_TEST_COUNT));
  for (unsigned k = 0; k < MO_PAPER_TEST_COUNT && error == MO_OK; k++) {
    error = mo_environment_row(writer, &environments[k], &row);
    if (error == MO_OK)
      error = mo_sql_do(writer, member_sql, mo_int(set), mo_int(k), mo_int(row));
  }
  return error;
}

int mo_make_paper_test(struct mo_store *store)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  mo_environment_paper_test(environments);
  return mo_write(store, make, environments);
}
