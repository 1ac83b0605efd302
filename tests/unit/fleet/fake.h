/* fake.h: a source of blocks, and workers, for tests of the fleet: a queue in memory, a clock that
 * tests advance, and rollouts whose losses are a hash of their inputs. */
#ifndef MORPHO_TESTS_FLEET_FAKE_H
#define MORPHO_TESTS_FLEET_FAKE_H

#include <jansson.h>
#include <unistd.h>

#include "../make.h"

#include "fleet/state.h"

enum { ROWS = 16, GENOTYPES = 64, ENVIRONMENTS = 64 };
enum fake_state { FAKE_WAITS, FAKE_TAKEN, FAKE_DONE };

struct fake_block {
  struct mo_block block;
  uint64_t genotype[MO_DEFAULT_WORDS];
  enum fake_state state;
  int cancel, status; /* status: as in the delivery */
  int64_t origin;
  TAILQ_ENTRY(fake_block) next;
};

struct fake_taken {
  struct mo_taken shown;
  bool is_out;
  struct mo_block *blocks[];
};

/* A source. Every inconsistency in it is a failed check. */
struct fake {
  const struct mo_measuring *measuring; /* of all blocks; NULL: none */
  struct mo_lattice *lattice;
  struct mo_controller *controller;      /* nullable */
  const struct mo_gradient_batch *shard; /* handed out repeatedly instead of blocks; nullable */
  struct mo_environment environments[ENVIRONMENTS];
  uint64_t genotypes[GENOTYPES][MO_DEFAULT_WORDS];
  TAILQ_HEAD(, fake_block) queue;
  uint32_t n_waiting, n_taken, n_done, n_wrong, n_cancelled, n_failed, n_kept, n_origins, n_wakes,
      n_events, wanted;
  uint64_t rows_done;
  bool frees_done;     /* frees blocks when they are delivered; otherwise the test owns them */
  uint64_t woken[256]; /* the latest */
  char event[64], data[512]; /* the latest */
  int origin_error;
  struct mo_fleet *fleet;
  uint64_t now_ns;
};

static const char fake_class[] = "cpu fake float32 kernels-1",
                  fake_gradients[] = "cpu fake gradient-1";

static inline void fake_hash(uint64_t *h, const void *bytes, size_t n)
{
  hash(h, bytes, n);
}

/* Returns the loss of a body in an environment. One in 16 diverges. */
static inline void fake_rollout(const uint64_t genotype[MO_DEFAULT_WORDS],
                                const struct mo_environment *environment, double *loss,
                                uint32_t *diverged_step)
{
  uint64_t h = FNV_START;
  fake_hash(&h, genotype, 8);
  fake_hash(&h, environment->light_xy_m, 8);
  h ^= h >> 31;
  *diverged_step = h % 16 == 0 ? 1 + (uint32_t)(h >> 8 & 255) : 0;
  *loss = h % 16 == 0 ? INFINITY : (double)(h >> 12) * 0x1p-50;
}

/* ---- the source ---- */

/* Returns NULL if out of memory. */
static inline struct fake_taken *fake_taken_of(uint32_t n)
{
  struct fake_taken *taken = calloc(1, sizeof(*taken) + n * sizeof(struct mo_block *));
  if (taken == NULL)
    return NULL;
  taken->is_out = true;
  taken->shown.blocks = taken->blocks;
  return taken;
}

static inline struct mo_taken *fake_take_shard(struct fake *fake)
{
  struct fake_taken *taken = fake_taken_of(0);
  if (taken == NULL)
    return NULL;
  taken->shown.n_blocks = 1;
  taken->shown.n_rows = fake->shard->n;
  taken->shown.shard = fake->shard;
  taken->shown.controller = fake->controller;
  taken->shown.identity = fake->controller;
  fake->n_taken++;
  return &taken->shown;
}

static inline struct mo_taken *fake_take(struct mo_compute *context, enum mo_back_end back_end,
                                         uint64_t steps)
{
  struct fake *fake = (struct fake *)context;
  struct fake_block *block = TAILQ_FIRST(&fake->queue);
  if (fake->shard != NULL && back_end == MO_ON_CPU)
    return fake_take_shard(fake);
  struct fake_taken *taken =
      block != NULL && back_end == MO_ON_CPU ? fake_taken_of(fake->n_waiting) : NULL;
  if (taken == NULL)
    return NULL;
  taken->shown.controller = fake->controller;
  taken->shown.identity = (const void *)fake->controller;
  for (uint64_t rest = steps; block != NULL; block = TAILQ_FIRST(&fake->queue)) {
    const uint64_t cost =
        (uint64_t)block->block.n_environments * block->block.physics.scheme.n_steps;
    if (taken->shown.n_blocks > 0 && cost > rest)
      break;
    rest -= cost < rest ? cost : rest;
    CHECK(block->state == FAKE_WAITS);
    block->state = FAKE_TAKEN;
    TAILQ_REMOVE(&fake->queue, block, next);
    taken->blocks[taken->shown.n_blocks++] = &block->block;
    taken->shown.n_rows += block->block.n_environments;
    fake->n_waiting--;
    fake->n_taken++;
  }
  return &taken->shown;
}

static inline void fake_put_back(struct mo_compute *context, struct mo_taken *shown)
{
  struct fake *fake = (struct fake *)context;
  struct fake_taken *taken = (struct fake_taken *)shown;
  CHECK(taken->is_out);
  taken->is_out = false;
  if (shown->shard != NULL)
    fake->n_taken--;
  for (uint32_t i = shown->shard != NULL ? 0 : shown->n_blocks; i-- > 0;) {
    struct fake_block *block = (struct fake_block *)taken->blocks[i];
    CHECK(block->state == FAKE_TAKEN);
    block->state = FAKE_WAITS;
    TAILQ_INSERT_HEAD(&fake->queue, block, next);
    fake->n_waiting++;
    fake->n_taken--;
  }
  free(taken);
}

static inline struct mo_taken *fake_split(struct mo_compute *context, struct mo_taken *shown)
{
  struct fake_taken *first = (struct fake_taken *)shown;
  const uint32_t n = shown->n_blocks, n_first = n / 2;
  (void)context;
  struct fake_taken *second = n > 1 ? fake_taken_of(n) : NULL;
  if (second == NULL)
    return NULL;
  second->shown.controller = shown->controller;
  second->shown.identity = shown->identity;
  for (uint32_t i = n_first; i < n; i++) {
    second->blocks[second->shown.n_blocks++] = first->blocks[i];
    second->shown.n_rows += first->blocks[i]->n_environments;
  }
  shown->n_blocks = n_first;
  shown->n_rows -= second->shown.n_rows;
  return &second->shown;
}

static inline bool fake_is_cancelled(const struct mo_taken *shown)
{
  if (shown->shard != NULL)
    return false;
  for (uint32_t i = 0; i < shown->n_blocks; i++)
    if (!((const struct fake_block *)shown->blocks[i])->cancel)
      return false;
  return true;
}

static inline void fake_deliver(struct mo_compute *context, struct mo_taken *shown,
                                const struct mo_remote_result *result)
{
  struct fake *fake = (struct fake *)context;
  struct fake_taken *taken = (struct fake_taken *)shown;
  uint32_t row = 0;
  CHECK(taken->is_out);
  taken->is_out = false;
  if (shown->shard != NULL) {
    CHECK(result->status == MO_OK && result->counts.robots == shown->shard->n);
    fake->n_taken--;
    fake->n_done++;
    fake->n_wrong += result->d_parameters[0] != 0;
  }
  for (uint32_t i = 0; shown->shard == NULL && i < shown->n_blocks; i++) {
    struct fake_block *block = (struct fake_block *)taken->blocks[i];
    CHECK(block->state == FAKE_TAKEN);
    block->state = FAKE_DONE;
    block->status = result->status;
    block->origin = result->origin;
    fake->n_taken--;
    fake->n_done++;
    fake->n_cancelled += result->status == MO_ERR_CANCELLED;
    fake->n_failed += result->status == MO_ERR_EXHAUSTED;
    fake->n_kept += result->status == MO_ERR_UNSUPPORTED;
    for (uint32_t k = 0; k < block->block.n_environments && result->status == MO_OK; k++, row++) {
      double loss;
      uint32_t diverged_step;
      fake_rollout(block->genotype, block->block.environments[k], &loss, &diverged_step);
      fake->n_wrong += memcmp(&loss, &result->losses[row], sizeof(loss)) != 0 ||
                       diverged_step != result->diverged[row] ||
                       (result->measures != NULL) != (block->block.measuring != NULL);
      fake->rows_done++;
    }
    if (fake->frees_done)
      free(block);
  }
  free(taken);
}

/* Finishes the blocks as if the source had computed them. */
static inline void fake_keep(struct mo_compute *context, struct mo_taken *shown)
{
  fake_deliver(context, shown, &(struct mo_remote_result){.status = MO_ERR_UNSUPPORTED});
}

static inline void fake_want(struct mo_compute *context, enum mo_back_end back_end, uint32_t blocks)
{
  if (back_end == MO_ON_CPU)
    ((struct fake *)context)->wanted = blocks;
}

static inline uint64_t fake_waiting(struct mo_compute *context, enum mo_back_end back_end)
{
  const struct fake *fake = (const struct fake *)context;
  const struct fake_block *first = TAILQ_FIRST(&fake->queue);
  return back_end != MO_ON_CPU || first == NULL
             ? 0
             : (uint64_t)fake->n_waiting * first->block.n_environments *
                   first->block.physics.scheme.n_steps;
}

static inline void fake_wake(void *context, uint64_t session)
{
  struct fake *fake = context;
  fake->woken[fake->n_wakes++ % COUNT(fake->woken)] = session;
}

static inline void fake_event(void *context, const char *type, const char *data)
{
  struct fake *fake = context;
  fake->n_events++;
  snprintf(fake->event, sizeof(fake->event), "%s", type);
  json_t *json = json_loads(data, 0, NULL);
  CHECK(json_is_object(json) && strlen(data) < sizeof(fake->data));
  json_decref(json);
  snprintf(fake->data, sizeof(fake->data), "%s", data);
}

static inline int fake_origin(void *context, const char *text, int64_t *number)
{
  struct fake *fake = context;
  if (fake->origin_error != MO_OK)
    return fake->origin_error;
  fake->n_origins++;
  uint64_t h = FNV_START;
  fake_hash(&h, text, strlen(text));
  *number = (int64_t)(h >> 1 | 1);
  return MO_OK;
}

static inline void drop_fake(void *thing)
{
  struct fake *fake = thing;
  mo_fleet_free(fake->fleet);
  CHECK_INT(fake->n_taken, 0);
  for (struct fake_block *block; (block = TAILQ_FIRST(&fake->queue)) != NULL; free(block))
    TAILQ_REMOVE(&fake->queue, block, next);
}

static inline struct fake *make_fake(uint64_t seed)
{
  struct fake *fake = make_zeros(1, sizeof(*fake));
  struct mo_random random = dice(seed, 0, 0);
  fake->lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  fake->now_ns = MO_S_NS;
  TAILQ_INIT(&fake->queue);
  for (uint32_t e = 0; e < ENVIRONMENTS; e++)
    mo_environment_training(seed, 0, e, &fake->environments[e]);
  for (uint32_t g = 0; g < GENOTYPES; g++) {
    make_check(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, fake->genotypes[g]), "a body");
    mo_genotype_place(MO_DEFAULT_WORKSPACE, fake->genotypes[g]);
  }
  struct mo_fleet_config config = {.source = {(struct mo_compute *)fake, fake_take, fake_put_back,
                                              fake_keep, fake_split, fake_is_cancelled,
                                              fake_deliver, fake_want, fake_waiting, NULL},
                                   .workspace = MO_DEFAULT_WORKSPACE,
                                   .epoch = 5,
                                   .seed = seed,
                                   .version = "1.0.0",
                                   .classes = {{.scores = fake_class, .gradients = fake_gradients}},
                                   .origin = fake_origin,
                                   .wake = fake_wake,
                                   .event = fake_event,
                                   .context = fake};
  make_check(mo_fleet_create(&config, &fake->fleet), "the fleet");
  return check_keep(fake, drop_fake);
}

/* Counts open sessions that are refused and have names with this prefix. */
static inline uint32_t fake_refused(const struct fake *fake, const char *prefix)
{
  const struct mo_session *session;
  uint32_t n = 0;
  TAILQ_FOREACH(session, &fake->fleet->sessions, all)
  n += session->state == MO_SESSION_REFUSED &&
       strncmp(session->offer.name, prefix, strlen(prefix)) == 0;
  return n;
}

/* Waits for the thread that decides, if there is one. */
static inline void fake_settle(struct fake *fake)
{
  struct mo_decision *decision = &fake->fleet->decision;
  while (decision->lease != NULL && !atomic_load(&decision->is_done))
    usleep(50);
}

/* Queues n blocks of ROWS rollouts of 1000 steps. Returns the first, which the caller frees when it
 * is done (keep: at the end of the case). */
static inline struct fake_block *fake_submit(struct fake *fake, uint64_t number)
{
  struct fake_block *block = calloc(1, sizeof(*block));
  make_check(block != NULL ? MO_OK : MO_ERR_NO_MEMORY, "a block");
  block->block.lattice = fake->lattice;
  block->block.genotype = block->genotype;
  block->block.n_environments = ROWS;
  block->block.physics = physics_of(1000);
  block->block.measuring = fake->measuring;
  memcpy(block->genotype, fake->genotypes[number % GENOTYPES], sizeof(block->genotype));
  for (uint32_t k = 0; k < ROWS; k++)
    block->block.environments[k] = &fake->environments[(number + k) % ENVIRONMENTS];
  TAILQ_INSERT_TAIL(&fake->queue, block, next);
  fake->n_waiting++;
  mo_fleet_arrived(fake->fleet);
  return block;
}

/* ---- workers ---- */

static inline struct mo_fleet_offer fake_offer(const char *name, const char *host)
{
  struct mo_fleet_offer offer = {.version = "1.0.0", .n_threads = 1};
  snprintf(offer.name, sizeof(offer.name), "%s", name);
  snprintf(offer.host, sizeof(offer.host), "%s", host);
  snprintf(offer.classes[0].scores, sizeof(offer.classes[0].scores), "%s", fake_class);
  snprintf(offer.classes[0].gradients, sizeof(offer.classes[0].gradients), "%s", fake_gradients);
  return offer;
}

/* Computes a lease. liar: nullable; if given, one row in 1000 and the sum of every shard get a
 * wrong bit. */
static inline struct mo_wire_result fake_compute(const struct mo_wire_lease *lease,
                                                 struct mo_random *liar)
{
  struct mo_wire_result result = {.id = lease->id, .n_rows = lease->n_rows, .busy_s = 1};
  result.losses = calloc(lease->n_rows, sizeof(*result.losses));
  result.diverged_steps = calloc(lease->n_rows, sizeof(*result.diverged_steps));
  if (lease->has_measures)
    result.measures = calloc(lease->n_rows, sizeof(*result.measures));
  make_check(result.losses && result.diverged_steps &&
                     (result.measures != NULL) == lease->has_measures
                 ? MO_OK
                 : MO_ERR_NO_MEMORY,
             "a result");
  uint32_t row = 0;
  for (uint32_t b = 0; b < lease->n_blocks; b++) {
    const struct mo_wire_block *block = &lease->blocks[b];
    for (uint32_t k = 0; k < block->n_environments; k++, row++) {
      fake_rollout(block->genotype, &lease->environments[block->environments[k]],
                   &result.losses[row], &result.diverged_steps[row]);
      if (liar != NULL && mo_random_below(liar, 1000) == 0 && result.diverged_steps[row] == 0)
        result.losses[row] = nextafter(result.losses[row], 2);
      for (unsigned m = 0; m < MO_MEASURES && lease->has_measures; m++)
        result.measures[row][m] = result.diverged_steps[row] > 0 ? (double)NAN : row + m;
    }
  }
  if (lease->n_parameters == 0)
    return result;
  result.n_parameters = lease->n_parameters;
  result.d_parameters = calloc(lease->n_parameters, sizeof(double));
  make_check(result.d_parameters != NULL ? MO_OK : MO_ERR_NO_MEMORY, "a sum");
  result.d_parameters[0] = liar != NULL ? 0x1p-1000 : 0;
  result.counts.robots = lease->n_rows;
  return result;
}

/* A `recompute` of the source: this process decides. Without it both sessions are refused. */
static inline int fake_recompute(struct mo_compute *compute, struct mo_workspace workspace,
                                 const struct mo_wire_lease *lease, const uint8_t *file,
                                 size_t file_bytes, const volatile int *cancel, double *losses,
                                 uint32_t *diverged_steps, double (*measures)[MO_MEASURES])
{
  struct mo_wire_result result = fake_compute(lease, NULL);
  (void)compute;
  (void)cancel;
  CHECK(mo_workspace_equal(workspace, MO_DEFAULT_WORKSPACE));
  CHECK(lease->n_blocks == 1 && file == NULL && file_bytes == 0);
  memcpy(losses, result.losses, result.n_rows * sizeof(*losses));
  memcpy(diverged_steps, result.diverged_steps, result.n_rows * sizeof(*diverged_steps));
  if (lease->has_measures)
    memcpy(measures, result.measures, result.n_rows * sizeof(*measures));
  free(result.losses);
  free(result.diverged_steps);
  free(result.measures);
  return MO_OK;
}

/* One exchange at the fake clock's time: sends results (nullable; freed) and receives leases. */
static inline int fake_exchange(struct fake *fake, uint64_t session,
                                struct mo_wire_results *results, struct mo_wire_leases *leases)
{
  struct mo_message message = {""};
  uint8_t *up = NULL, *down = NULL;
  size_t up_size = 0, down_size = 0;
  uint32_t n_leases = 0;
  memset(leases, 0, sizeof(*leases));
  if (results != NULL) {
    make_check(mo_wire_put_results(results, &up, &up_size), "results");
    mo_wire_free_results(results);
  }
  int error = mo_fleet_exchange(fake->fleet, session, up, up_size, fake->now_ns, &down, &down_size,
                                &n_leases, &message);
  free(up);
  if (error != MO_OK)
    return error;
  make_check(mo_wire_get_leases(down, down_size, MO_DEFAULT_WORKSPACE, leases, &message),
             message.text);
  CHECK_INT(leases->n, n_leases);
  free(down);
  return MO_OK;
}

/* Checks invariants: every block that was taken is in a lease, every lease has an owner, and both
 * sides agree on who holds what. */
static inline void fake_check(const struct fake *fake)
{
  const struct mo_fleet *fleet = fake->fleet;
  const struct mo_lease *lease;
  uint32_t blocks = 0, n_checks = 0, n_holds = 0;
  TAILQ_FOREACH(lease, &fleet->leases, all)
  {
    if (lease->parcel != NULL) {
      CHECK(lease->n_holds > 0 && lease->n_votes == 0 && !lease->is_audit);
      CHECK_INT(lease->parcel->taken->n_rows, lease->content.n_rows);
      blocks += lease->parcel->taken->n_blocks;
    } else {
      CHECK(lease->n_votes > 0);
      CHECK(lease->n_holds > 0 || (lease->is_audit && (lease->is_listed || lease->is_deciding)));
    }
    CHECK(!lease->is_disputed || (lease->is_audit && lease->n_votes > 1));
    n_checks += lease->is_audit;
    n_holds += lease->n_holds;
    for (uint32_t i = 0; i < lease->n_holds; i++) {
      const struct mo_session *session = lease->holds[i].session;
      uint32_t held = 0;
      for (uint32_t k = 0; k < session->n_held[0]; k++)
        held += session->held[0][k] == lease;
      CHECK_INT(held, 1);
      for (uint32_t k = 0; k < i; k++)
        CHECK(lease->holds[k].session != session);
      for (uint32_t k = 0; k < lease->n_votes; k++)
        CHECK(lease->votes[k].session != session->id);
    }
  }
  CHECK_INT(blocks, fake->n_taken);
  CHECK_INT(n_checks, fleet->n_checks);
  const struct mo_session *session;
  uint32_t n_held = 0, n_sessions = 0, n_active = 0;
  TAILQ_FOREACH(session, &fleet->sessions, all)
  {
    n_sessions++;
    n_active += session->state == MO_SESSION_ACTIVE;
    n_held += session->n_held[0];
    CHECK(session->n_taking[0] == 0 && session->n_held[0] <= MO_FLEET_LEASES);
    CHECK(session->state != MO_SESSION_REFUSED || session->n_held[0] == 0);
  }
  CHECK_INT(n_held, n_holds);
  CHECK(n_sessions == fleet->n_sessions && n_active == fleet->classes[0].n_sessions);
}

#endif
