/* pace.c: see pace.h. */
#include "jobs/pace.h"

#define MARK_US  INT64_C(10000000)
#define LEAST_US INT64_C(500000)
#define LEAST_N  3 /* number of arrivals; one or two are too few for an estimate */

void mo_pace_add(struct mo_pace *pace, int64_t now_us, uint64_t done)
{
  const struct mo_pace_mark mark = {now_us, done};
  if (pace->from.at_us == 0) {
    *pace = (struct mo_pace){.from = mark, .next = mark, .last = mark};
    return;
  }
  if (now_us > pace->last.at_us) {
    pace->n_from++;
    pace->n_next++;
  }
  pace->last = mark;
  if (now_us - pace->next.at_us >= MARK_US && pace->n_next >= LEAST_N) {
    pace->from = pace->next;
    pace->n_from = pace->n_next;
    pace->next = mark;
    pace->n_next = 0;
  }
}

double mo_pace_rate(const struct mo_pace *pace, int64_t now_us)
{
  int64_t passed_us = pace->last.at_us - pace->from.at_us;
  if (passed_us < LEAST_US || pace->n_from < LEAST_N)
    return 0;
  if (now_us - pace->last.at_us > passed_us) /* nothing has arrived for a long time */
    passed_us = now_us - pace->from.at_us;
  return (double)(pace->last.done - pace->from.done) / ((double)passed_us * 1e-6);
}
