/* stream.c: the distinct bodies of a pretraining run; `morpho-bench stream [bodies]`. Draws as a
 * training run does, without held-out forms, and reports the time and the memory of the set of seen
 * bodies. */
#include "bench.h"

#include <morpho/learning.h>
#include <stdlib.h>

#define REPORTS 10

int bench_stream(int argc, char **argv)
{
  const long n = argc > 1 ? strtol(argv[1], NULL, 10) : 10500000;
  const long threads = argc > 2 ? strtol(argv[2], NULL, 10) : 1;
  if (n < REPORTS || n > 1000000000 || threads < 1 || threads > 64) {
    fprintf(stderr,
            "morpho-bench stream [bodies [threads]]: between %d and 1000000000 bodies, 10500000 by "
            "default; up to 64 threads that draw ahead, 1 by default\n",
            REPORTS);
    return EXIT_FAILURE;
  }
  struct mo_body_stream *stream = NULL;
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, 1, &stream), "body stream");
  bench_check(mo_body_stream_set_threads(stream, (uint32_t)threads), "threads");
  printf("%12s %14s %10s %16s\n", "bodies", "draws", "s", "process, MiB");
  const double start = bench_now_s();
  long held_out = 0;
  for (long i = 0, next = n / REPORTS; i < n;) {
    uint64_t body[MO_DEFAULT_WORDS], form[MO_DEFAULT_WORDS];
    bench_check(mo_body_stream_next(stream, body, form), "body stream");
    if (mo_held_out_form(form)) {
      held_out++;
      continue;
    }
    if (++i == next || i == n) {
      printf("%12ld %14llu %10.1f %16.1f\n", i, (unsigned long long)mo_body_stream_draws(stream),
             bench_now_s() - start, bench_peak_mib());
      next += n / REPORTS;
    }
  }
  printf("%ld more were held out (%.2f %%)\n", held_out,
         100.0 * (double)held_out / (double)(n + held_out));
  mo_body_stream_free(stream);
  return EXIT_SUCCESS;
}
