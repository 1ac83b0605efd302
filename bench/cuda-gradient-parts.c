/* cuda-gradient-parts.c: the scenes, references and calls of cuda-gradient.c. */
#include "cuda-gradient.h"

#include "device.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct mo_device *device;

/* ---- scenes ---- */

void make_scene(struct scene *s, uint32_t n)
{
  *s = (struct scene){.n = n,
                      .environments = must_have(calloc(n, sizeof(*s->environments))),
                      .robots = must_have(calloc(n, sizeof(*s->robots)))};
  must(mo_lattice_create(MO_DEFAULT_WORKSPACE, &s->lattice), "lattice");
  s->bodies = random_bodies(s->lattice, n, 1);
  for (uint32_t i = 0; i < n; i++) {
    mo_environment_training(1, 0, i, &s->environments[i]);
    s->robots[i] = (struct mo_robot){s->bodies[i], &s->environments[i]};
  }
}

void drop_scene(struct scene *s)
{
  free_bodies(s->bodies, s->n);
  free(s->environments);
  free(s->robots);
  mo_lattice_free(s->lattice);
}

const char *after_rule(const char *weights)
{
  const char *const colon = strchr(weights, ':');
  return colon != NULL && strncmp(weights, "restart", 7) == 0 ? colon + 1 : weights;
}

struct mo_gradient_options options_of(const char *weights)
{
  struct mo_gradient_options options = mo_default_gradient_options();
  if (after_rule(weights) != weights)
    options.adjoint_rule = MO_ADJOINT_RESTART;
  if (strncmp(weights, "restart=", 8) == 0)
    options.restart_weight = strtod(weights + 8, NULL);
  return options;
}

struct mo_controller *weights_of(const char *weights)
{
  const char *const name = after_rule(weights);
  struct mo_controller *controller = NULL;
  struct mo_message message = {""};
  char *end;
  const unsigned long long seed = strtoull(name, &end, 10);
  if (*end != 0) {
    must(mo_controller_read(name, &controller, &message), name);
    return controller;
  }
  must(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller),
       "controller");
  mo_controller_randomize(controller, seed);
  return controller;
}

struct mo_physics physics_of(uint32_t n_steps, uint32_t control_steps)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.n_steps = n_steps;
  physics.scheme.control_period_s = control_steps * physics.scheme.dt_s;
  return physics;
}

/* ---- the reference ---- */

static void *reference_work(void *context)
{
  struct reference *r = context;
  for (;;) {
    const uint32_t block = __atomic_fetch_add(&r->next, 1, __ATOMIC_RELAXED);
    if (block >= BLOCKS)
      return NULL;
    for (uint32_t i = block; i < r->n; i += BLOCKS)
      must(mo_gradient_reference(r->scene->bodies[i], r->controller, &r->scene->environments[i],
                                 &r->physics, &r->options, &r->outcomes[i], r->sums[block],
                                 &r->counts[block]),
           "reference");
  }
}

void compute_reference(struct reference *r, long workers)
{
  r->options.weight = 1.0 / r->n;
  for (int i = 0; i < BLOCKS; i++)
    r->sums[i] = must_have(calloc(r->controller->n_parameters, sizeof(double)));
  on_threads(workers, reference_work, r);
  for (int i = 1; i < BLOCKS; i++) {
    mo_gradient_counts_add(&r->counts[0], &r->counts[i]);
    for (size_t k = 0; k < r->controller->n_parameters; k++)
      r->sums[0][k] += r->sums[i][k];
  }
}

void drop_reference(struct reference *r)
{
  for (int i = 0; i < BLOCKS; i++)
    free(r->sums[i]);
}

/* ---- the device ---- */

/* Returns a hash of the result: versions that compute the same bits have the same hash. */
static uint64_t hash_of(const float *values, size_t n)
{
  uint64_t hash = UINT64_C(14695981039346656037);
  for (size_t i = 0; i < n; i++) {
    uint32_t bits;
    memcpy(&bits, &values[i], sizeof(bits));
    hash = (hash ^ bits) * UINT64_C(1099511628211);
  }
  return hash;
}

void run_with(struct result *r, const struct mo_controller *controller, const struct scene *s,
              uint32_t first, uint32_t n, const struct mo_physics *physics,
              const struct mo_gradient_options *options, uint64_t memory_bytes)
{
  const uint32_t shards = (n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD;
  *r = (struct result){
      .call = {.controller = controller,
               .robots = s->robots + first,
               .n = n,
               .physics = *physics,
               .options = *options,
               .d_parameters = must_have(malloc(shards * controller->n_parameters * sizeof(float))),
               .outcomes = must_have(calloc(n, sizeof(struct mo_outcome)))}};
  r->call.options.weight = 1.0 / n;
  memset(r->call.d_parameters, 0,
         shards * controller->n_parameters * sizeof(float)); /* like a caller's, which it keeps */
  const double start = now_s();
  must(mo_cuda_gradient_run(device, &r->call, memory_bytes), "gradient");
  r->total_s = now_s() - start;
  const struct mo_cuda_gradient_profile *p = mo_cuda_gradient_times(device);
  printf("%u robots, %u steps: %.3f s, device %.4f (forward %.4f, back %.4f, products %.4f, sums "
         "%.4f), host %.3f (layout %.3f, upload %.3f); %.1f GB, %u groups, %u in halves, %u "
         "passes, %u backward passes; bits %016llx\n",
         n, physics->scheme.n_steps, r->total_s, r->call.device_s, p->forward_s, p->back_s,
         p->products_s, p->collect_s, r->call.host_s, p->plan_s, p->upload_s,
         (double)p->device_bytes * 1e-9, p->groups, p->halved, p->passes, p->walks,
         (unsigned long long)hash_of(r->call.d_parameters, shards * controller->n_parameters));
}

void run_steps(struct result *r, const struct mo_controller *controller, const struct scene *s,
               uint32_t first, uint32_t n, uint32_t n_steps, uint64_t memory_bytes)
{
  struct mo_physics physics = mo_paper_physics();
  const struct mo_gradient_options options = mo_default_gradient_options();
  physics.scheme.n_steps = n_steps;
  run_with(r, controller, s, first, n, &physics, &options, memory_bytes);
}

void drop_result(struct result *r)
{
  free(r->call.d_parameters);
  free(r->call.outcomes);
}

void print_counts(const char *name, const struct mo_gradient_counts *c)
{
  printf(
      "  %s: %llu steps, clipped %llu in %llu robots, zeroed %llu, diverged %llu, largest m %.3g\n",
      name, (unsigned long long)c->steps, (unsigned long long)c->clipped_steps,
      (unsigned long long)c->clipped_robots, (unsigned long long)c->zeroed_robots,
      (unsigned long long)c->diverged_robots, c->largest);
}

struct likeness likeness_of(const float *gradient, const double *reference, size_t n)
{
  double product = 0, own = 0, other = 0, apart = 0;
  for (size_t k = 0; k < n; k++) {
    const double x = gradient[k], y = reference[k];
    product += x * y;
    own += x * x;
    other += y * y;
    apart += (x - y) * (x - y);
  }
  return (struct likeness){product / sqrt(own * other), sqrt(apart / other), sqrt(own),
                           sqrt(other)};
}
