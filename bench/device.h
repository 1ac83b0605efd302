/* device.h: shared by the benchmarks of the CUDA module: a clock, lines of results, threads,
 * bodies. */
#ifndef MORPHO_BENCH_DEVICE_H
#define MORPHO_BENCH_DEVICE_H

#include "compute/device.h"

double now_s(void);
/* Ends the process unless status is MO_OK; device_error: NULL, or the message of the device. */
void must(int status, const char *what);
extern const char *(*device_error)(void);
void *must_have(void *memory);

/* Prints whether a bound was kept or missed. A miss is remembered. */
__attribute__((format(printf, 2, 3))) void expect(int held, const char *format, ...);
int missed(void);

/* Sorts the values and returns the one below which a share of them lies. */
double quantile(double *values, size_t n, double share);

/* Runs work on this many threads, 1 … 64, and waits for them. */
void on_threads(long n, void *(*work)(void *context), void *context);

/* Makes the first n bodies of mo_body_stream. */
struct mo_body **random_bodies(const struct mo_lattice *lattice, uint32_t n, uint64_t seed);
void free_bodies(struct mo_body **bodies, uint32_t n);

#endif
