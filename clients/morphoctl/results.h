/* results.h: the results of an evaluation, ranked, and as a table. */
#ifndef MORPHOCTL_RESULTS_H
#define MORPHOCTL_RESULTS_H

#include "commands.h"

struct ranked {
  size_t place;  /* position in the request */
  double score;  /* +infinity if diverged */
  bool is_bound; /* a lower bound, which comes after every score */
};
/* Ranks results, in their order or best first. */
struct ranked *rank_results(const json_t *results, bool by_score);
/* Returns the texts of an array, separated by commas. */
const char *words_of(const json_t *list);
/* Returns the columns of an object with measures (nullable), each after a "|". A server may send
 * any names, so names that are not measures get no column. */
const char *measure_columns(const json_t *measures);
/* Prints the results of a finished evaluation as a table. designs: nullable, used for names. */
void print_results(const struct ctl *ctl, const json_t *evaluation, const struct designs *designs,
                   bool by_score, size_t top);

#endif
