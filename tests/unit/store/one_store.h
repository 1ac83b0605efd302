/* one_store.h: for programs whose cases each have a store of their own, with the weights "default":
 * it is made before the case and removed after it. */
#ifndef MORPHO_TESTS_STORE_ONE_STORE_H
#define MORPHO_TESTS_STORE_ONE_STORE_H

#include "../check.h"
#include "fixture.h"

static struct fixture fixture;

static inline void with_a_store(void (*run)(void))
{
  CHECK_INT(fixture_start(&fixture), MO_OK);
  if (check_failures == 0)
    run();
  fixture_end(&fixture);
}

/* Draws n bodies into the fixture, and asks for their evaluation. */
static inline struct mo_submission draw_evaluation(uint64_t seed, uint32_t n)
{
  free(fixture.forms);
  free(fixture.genotypes);
  CHECK_INT(fixture_bodies(seed, n, &fixture.forms, &fixture.genotypes), MO_OK);
  return fixture_submission(fixture.forms, fixture.genotypes, n);
}

/* Returns the id of the job, or an error. */
static inline int64_t submit_evaluation(const struct mo_submission *submission)
{
  bool replayed;
  int64_t id = 0;
  const int error = mo_store_submit(fixture.store, submission, &id, &replayed);
  return error == MO_OK ? id : error;
}

#endif
