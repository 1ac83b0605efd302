/* device.h: what the benches of the CUDA module share: a clock, lines of results, threads, bodies.
 */
#ifndef MORPHO_BENCH_DEVICE_H
#define MORPHO_BENCH_DEVICE_H

#include "compute/device.h"

double now_s(void);
/* Ends the process unless status is MO_OK; device_error: NULL, or what the device says. */
void must(int status, const char *what);
extern const char *(*device_error)(void);
void *must_have(void *memory);

/* Prints what was held, or missed, which is remembered. */
__attribute__((format(printf, 2, 3))) void expect(int held, const char *format, ...);
int missed(void);

/* Sorts; the value below which a share of them lies. */
double quantile(double *values, size_t n, double share);

/* Runs work on so many threads, 1 … 64, and waits for them. */
void on_threads(long n, void *(*work)(void *context), void *context);

/* n bodies of mo_body_stream, from its beginning. */
struct mo_body **random_bodies(const struct mo_lattice *lattice, uint32_t n, uint64_t seed);
void free_bodies(struct mo_body **bodies, uint32_t n);

#endif
