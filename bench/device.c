/* device.c: shared by the benchmarks of the CUDA module. */
#include "device.h"

#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { THREADS_MAX = 64 };

const char *(*device_error)(void);
static int any_missed;

double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

void must(int status, const char *what)
{
  if (status >= 0)
    return;
  fprintf(stderr, "%s: %s (%s)\n", what, mo_error_text(status),
          device_error != NULL ? device_error() : "no device");
  exit(1);
}

void *must_have(void *memory)
{
  must(memory != NULL ? MO_OK : MO_ERR_NO_MEMORY, "memory");
  return memory;
}

void expect(int held, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  printf("%s: ", held ? "ok" : "MISSED");
  vprintf(format, arguments);
  printf("\n");
  va_end(arguments);
  any_missed |= !held;
}

int missed(void)
{
  return any_missed;
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

double quantile(double *values, size_t n, double share)
{
  qsort(values, n, sizeof(*values), ascending);
  return values[(size_t)((double)(n - 1) * share)];
}

void on_threads(long n, void *(*work)(void *context), void *context)
{
  pthread_t threads[THREADS_MAX];
  n = n < 1 ? 1 : n > THREADS_MAX ? THREADS_MAX : n;
  for (long i = 0; i < n; i++)
    must(pthread_create(&threads[i], NULL, work, context) == 0 ? MO_OK : MO_ERR_NO_MEMORY,
         "thread");
  for (long i = 0; i < n; i++)
    pthread_join(threads[i], NULL);
}

struct mo_body **random_bodies(const struct mo_lattice *lattice, uint32_t n, uint64_t seed)
{
  struct mo_body_stream *stream = NULL;
  struct mo_body **bodies = must_have(calloc(n, sizeof(*bodies)));
  must(mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &stream), "bodies");
  for (uint32_t i = 0; i < n; i++) {
    uint64_t bits[MO_DEFAULT_WORDS];
    must(mo_body_stream_next(stream, bits, NULL), "stream");
    must(mo_body_create(lattice, bits, &bodies[i]), "body");
  }
  mo_body_stream_free(stream);
  return bodies;
}

void free_bodies(struct mo_body **bodies, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++)
    mo_body_free(bodies[i]);
  free(bodies);
}
