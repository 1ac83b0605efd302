/* sgemm.c: how fast one core multiplies matrices with OpenBLAS.
 *
 * OpenBLAS recognizes processors by their numbers. A processor that is newer than the library gets
 * the kernels of the oldest one, which are five times as slow. An environment variable may also
 * select kernels that compute the same bits on all machines but are half as fast. Compared with
 * these, any speed would look good. The instruction set of the processor determines which kernels
 * to use instead. */
#include "bench.h"

#include <cblas.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { SGEMM_MAX = 1024 };

double bench_controller_flop(const struct mo_body *body)
{
  return 2.0 * ((body->n_masses + MO_CPG_INPUTS) * (double)MO_HIDDEN + 2.0 * MO_HIDDEN * MO_HIDDEN +
                (double)MO_HIDDEN * body->n_springs);
}

/* Returns whether OpenBLAS chose kernels that use all of the instruction set. */
static bool is_fast(enum mo_isa isa)
{
  static const char *const avx512[] = {"SkylakeX", "Cooperlake", "SapphireRapids"};
  static const char *const avx2[] = {"Haswell", "Zen"};
  const char *const name = openblas_get_corename();
  bool known = false;
  for (size_t k = 0; k < sizeof(avx512) / sizeof(avx512[0]); k++)
    known |= strcmp(name, avx512[k]) == 0;
  for (size_t k = 0; isa == MO_ISA_AVX2 && k < sizeof(avx2) / sizeof(avx2[0]); k++)
    known |= strcmp(name, avx2[k]) == 0;
  return known;
}

void bench_sgemm_choose(char **argv)
{
  static const char name[] = "OPENBLAS_CORETYPE"; /* read when the library is loaded */
  const enum mo_isa isa = mo_isa_best();
  if (isa == MO_ISA_BASELINE || is_fast(isa))
    return;
  const char *const wanted = isa == MO_ISA_AVX512 ? "SkylakeX" : "Haswell", *const now =
                                                                                getenv(name);
  if (now != NULL && strcmp(now, wanted) == 0) {
    fprintf(
        stderr,
        "morpho-bench: OpenBLAS has no fast kernels for this processor: its rate means little\n");
    return;
  }
  if (setenv(name, wanted, 1) == 0)
    execv("/proc/self/exe", argv);
  perror("morpho-bench: OpenBLAS keeps its slow kernels");
}

void bench_sgemm_create(struct bench_sgemm *sgemm)
{
  float **matrices[] = {&sgemm->a, &sgemm->b, &sgemm->c};
  for (int m = 0; m < 3; m++) {
    *matrices[m] = aligned_alloc(64, sizeof(float) * SGEMM_MAX * SGEMM_MAX);
    bench_check(*matrices[m] == NULL ? MO_ERR_NO_MEMORY : MO_OK, "matrices");
    for (size_t i = 0; i < (size_t)SGEMM_MAX * SGEMM_MAX; i++)
      (*matrices[m])[i] = (float)((i * 2654435761u >> 16) % 17) / 16.0f - 0.5f;
  }
  openblas_set_num_threads(1);
}

double bench_sgemm_best(const struct bench_sgemm *sgemm)
{
  static const int sizes[] = {256, 384, 512, 768, 1024};
  double best = 0;
  for (size_t s = 0; s < sizeof(sizes) / sizeof(sizes[0]); s++) {
    const int n = sizes[s];
    for (int repeat = 0; repeat < (n <= 512 ? 8 : 3); repeat++) {
      const double start = bench_thread_s();
      cblas_sgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, n, n, n, 1.0f, sgemm->a, n, sgemm->b,
                  n, 0.0f, sgemm->c, n);
      const double rate = 2.0 * n * n * n / (bench_thread_s() - start);
      best = rate > best ? rate : best;
    }
  }
  return best;
}
