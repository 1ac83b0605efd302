/* bench.h: shared by the benchmarks. A benchmark is a process, and never frees what it creates. */
#ifndef MORPHO_BENCH_H
#define MORPHO_BENCH_H

#include <morpho/compute.h>

#include <stdbool.h>
#include <stdio.h>

struct bench_options {
  uint32_t bodies; /* 0 = the default of the benchmark */
  uint64_t seed;
  uint32_t workers; /* 0 = one per processor */
  enum mo_isa isa;
  bool quick;
  const char *controller; /* path */
  const char *designs;    /* of `penetration`: path; NULL: random bodies */
  /* Of `rollout`, `gradient` and `score-error`. dt_s 0: the default step; control_period_s 0: new
   * outputs in every step. */
  double dt_s, control_period_s;
  enum mo_integrator integrator; /* of the same */
  bool vary; /* each world of `rollout` and `gradient` has constants of its own */
};

/* The physics of the options: 4 seconds. */
struct mo_physics bench_physics(const struct bench_options *options);
/* Returns how often a rollout computes the controller's outputs. */
uint32_t bench_passes(const struct mo_physics *physics);

int bench_rollout(const struct bench_options *options);
int bench_accuracy(const struct bench_options *options);
int bench_gradient(const struct bench_options *options);
int bench_score_error(const struct bench_options *options);
int bench_penetration(const struct bench_options *options);
int bench_risers(const struct bench_options *options);
int bench_gradient_accuracy(const struct bench_options *options);
int bench_gradient_order(const struct bench_options *options);
int bench_stability(const struct bench_options *options);
int bench_atlas(int argc, char **argv);
int bench_space(int argc, char **argv);
int bench_store(int argc, char **argv);
int bench_stream(int argc, char **argv);
int bench_evolution(int argc, char **argv);
int bench_fleet_model(int argc, char **argv);

/* Everything that rollouts need. Creating it ends the program with a message if anything is
 * missing. */
struct bench_scene {
  struct mo_lattice *lattice;
  struct mo_controller *controller;
  struct mo_controller *random; /* of the same sensor, weights of the seed */
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  const struct mo_environment *list[MO_BLOCK_LANES]; /* the paper test set, repeated */
  uint32_t n_bodies;
  struct mo_body **bodies;         /* distinct random bodies of the seed's stream */
  struct mo_environment *training; /* of the seed's first step, one for each body */
  struct mo_robot *robots;         /* (n_bodies) each body in its environment of these */
};
void bench_scene_create(struct bench_scene *scene, const struct bench_options *options,
                        uint32_t n_bodies);
/* A box of nx × ny × nz voxels in the middle of the default workspace. */
struct mo_body *bench_box(const struct bench_scene *scene, int nx, int ny, int nz);

/* Matrix products on one core: the reference for the speeds of `rollout` and `gradient`. */
struct bench_sgemm {
  float *a, *b, *c;
};
/* Restarts the program if OpenBLAS chose kernels that do not suit this processor. Call it before
 * anything else. */
void bench_sgemm_choose(char **argv);
void bench_sgemm_create(struct bench_sgemm *sgemm);
/* Best rate of OpenBLAS on this thread over square sizes from 256 to 1024, FLOP per second. */
double bench_sgemm_best(const struct bench_sgemm *sgemm);
/* Returns the FLOP of one step of the controller, restricted to the body's masses and springs. */
double bench_controller_flop(const struct mo_body *body);

/* Returns the index of a word. Ends the program if it is not in the list, which ends with NULL. */
int bench_word(const char *const *words, const char *word);
enum mo_isa bench_isa(const char *name);

/* Parses milliseconds above 0 and returns seconds; ends the program on anything else. */
double bench_ms(const char *text);
/* Returns a whole number. Ends the program if the text is not one from `least` to `most`. */
uint64_t bench_number(const char *text, uint64_t least, uint64_t most);

/* Returns n elements, all zeros, to be freed. Ends the program if memory is short. */
void *bench_zeros(size_t n, size_t size);
/* Starts workers; 0: one per processor. Ends the program if this fails. */
struct mo_compute *bench_compute(uint32_t workers, enum mo_isa isa);
double bench_peak_mib(void); /* largest resident memory of this process so far; 0: unknown */

double bench_now_s(void);
double
bench_thread_s(void); /* processor time of this thread: other work on the machine does not count */
double bench_median(double *values, size_t n);             /* sorts */
double bench_quantile(double *values, size_t n, double q); /* sorts; nearest rank */
void bench_check(int status, const char *what);            /* ends the program unless MO_OK */

#endif
