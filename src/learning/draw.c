/* draw.c: the robots of a step.
 *
 * Pretraining: the next bodies of the seed's stream that are not held out. The set of seen bodies
 * is not saved: a restored run redraws its earlier bodies, which takes about 3.5 µs each, and must
 * end at the same number of draws. Finetuning: the designs in turn, continued from step to step.
 * After an interrupted draw, the next call continues where it stopped.
 *
 * There are two sets ("hands") of robots: one for the current step, and one for the next step,
 * which is drawn ahead while the gradient of the current robots is computed. Bodies are drawn from
 * the stream one after another. Everything else about a robot depends only on its number, and is
 * built on several threads. */
#include "learning/internal.h"

#include "base/thread.h"
#include "world/factors.h"

#include <stdatomic.h>
#include <stdlib.h>

#define ASK_EVERY 64 /* bodies between two checks of `cancel` */

static int take(struct mo_training *training, uint64_t *body)
{
  for (;;) {
    uint64_t form[MO_DEFAULT_WORDS];
    const int r = mo_body_stream_next(training->stream, body, form);
    if (r < 0)
      return r;
    if (!mo_held_out_form(form)) {
      training->taken++;
      return MO_OK;
    }
  }
}

static bool is_cancelled(const struct mo_training *training, const volatile int *cancel)
{
  return training->taken % ASK_EVERY == 0 && mo_is_cancelled(cancel);
}

/* Replays the stream of a restored run. A failed draw may leave the stream past the start of the
 * step, so the number of draws is checked only once. */
static int replay(struct mo_training *training, const volatile int *cancel,
                  volatile uint64_t *replayed)
{
  const uint64_t before = (uint64_t)training->step * training->settings.batch;
  if (training->replayed)
    return MO_OK;
  while (training->taken < before) {
    uint64_t body[MO_DEFAULT_WORDS];
    const int r = is_cancelled(training, cancel) ? MO_ERR_CANCELLED : take(training, body);
    if (r < 0)
      return r;
    if (replayed != NULL)
      __atomic_store_n(replayed, training->taken, __ATOMIC_RELAXED);
  }
  if (mo_body_stream_draws(training->stream) != training->draws)
    return MO_ERR_CORRUPT;
  training->replayed = true;
  return MO_OK;
}

static int draw_bodies(struct mo_training *training, struct mo_hand *hand,
                       const volatile int *cancel)
{
  int r = MO_OK;
  while (r == MO_OK && hand->n_drawn < training->settings.batch) {
    r = is_cancelled(training, cancel)
            ? MO_ERR_CANCELLED
            : take(training, hand->drawn + (size_t)MO_DEFAULT_WORDS * hand->n_drawn);
    hand->n_drawn += r == MO_OK;
  }
  hand->draws = mo_body_stream_draws(training->stream);
  return r;
}

static int prepare(struct mo_training *training, struct mo_hand *hand)
{
  const bool pretrain = training->settings.kind == MO_TRAINING_PRETRAIN;
  const size_t batch = training->settings.batch;
  int r = MO_OK;
  if (training->lattice == NULL)
    r = mo_lattice_create(training->controller->workspace, &training->lattice);
  if (r == MO_OK && pretrain && training->stream == NULL) {
    r = mo_body_stream_create(training->controller->workspace, training->settings.seed,
                              &training->stream);
    if (r == MO_OK)
      (void)mo_body_stream_set_threads(training->stream,
                                       training->n_threads); /* a failure only slows drawing */
  }
  if (r < 0)
    return r;
  if (pretrain && hand->drawn == NULL)
    hand->drawn = calloc(batch, MO_DEFAULT_WORDS * sizeof(*hand->drawn));
  if (pretrain && hand->bodies == NULL)
    hand->bodies = calloc(batch, sizeof(struct mo_body *));
  if (!pretrain && training->bodies == NULL) {
    training->n_bodies = training->n_designs;
    training->bodies = calloc(training->n_bodies, sizeof(struct mo_body *));
  }
  const bool varies = mo_factors_vary(&training->settings.learning.vary);
  const bool draws = training->draws_worlds || varies;
  if (draws && hand->environments == NULL)
    hand->environments = calloc(batch, sizeof(*hand->environments));
  if (varies && hand->variations == NULL)
    hand->variations = calloc(batch, sizeof(*hand->variations));
  if (hand->robots == NULL)
    hand->robots = calloc(batch, sizeof(*hand->robots));
  return (pretrain ? hand->drawn == NULL || hand->bodies == NULL : training->bodies == NULL) ||
                 (draws && hand->environments == NULL) || (varies && hand->variations == NULL) ||
                 hand->robots == NULL
             ? MO_ERR_NO_MEMORY
             : MO_OK;
}

/* The parts of robots that depend only on genotypes and numbers. */
struct making {
  const struct mo_training *training;
  const struct mo_hand *hand;
  const uint64_t *genotypes;
  struct mo_body **bodies;
  atomic_int error; /* the last error */
};

static void make_bodies(void *context, size_t first, size_t end)
{
  struct making *making = context;
  for (size_t i = first; i < end; i++) {
    if (making->bodies[i] != NULL)
      continue;
    const int r = mo_body_create(making->training->lattice,
                                 making->genotypes + MO_DEFAULT_WORDS * i, &making->bodies[i]);
    if (r < 0)
      atomic_store(&making->error, r);
  }
}

/* Returns one of the training run's own environments. */
static const struct mo_environment *choose(const struct mo_training *training, uint32_t step,
                                           uint32_t i)
{
  struct mo_random random;
  mo_random_init(&random, training->settings.seed, MO_PURPOSE_TRAINING_WORLD, step, i);
  return &training->environments[mo_random_below(&random, training->n_environments)];
}

static void make_environments(void *context, size_t first, size_t end)
{
  struct making *making = context;
  const struct mo_training *training = making->training;
  for (size_t i = first; i < end; i++) {
    struct mo_environment *environment = &making->hand->environments[i];
    const uint32_t step = making->hand->step;
    if (training->draws_worlds) {
      mo_environment_training(training->settings.seed, step, i, environment);
      if (training->n_environments > 0)
        mo_training_give_task(choose(training, step, (uint32_t)i), environment);
    } else {
      *environment = *choose(training, step, (uint32_t)i); /* borrows its grid */
    }
    const int r = making->hand->variations != NULL
                      ? mo_environment_vary(&making->hand->variations[i], environment)
                      : MO_OK;
    if (r < 0)
      atomic_store(&making->error, r);
  }
}

static int make_robots(struct mo_training *training, struct mo_hand *hand)
{
  const struct mo_training_settings *settings = &training->settings;
  const bool pretrain = settings->kind == MO_TRAINING_PRETRAIN;
  const uint32_t n_bodies = pretrain ? settings->batch : training->n_bodies;
  struct making making = {.training = training,
                          .hand = hand,
                          .genotypes = pretrain ? hand->drawn : training->designs,
                          .bodies = pretrain ? hand->bodies : training->bodies};
  mo_parallel(training->n_threads, n_bodies, make_bodies, &making);
  int r = atomic_load(&making.error);
  if (r == MO_OK && hand->variations != NULL)
    r = mo_variations_draw(&settings->learning.vary, settings->seed, hand->step, settings->batch,
                           hand->variations);
  if (r < 0)
    return r;
  const bool draws = hand->environments != NULL;
  if (draws)
    mo_parallel(training->n_threads, settings->batch, make_environments, &making);
  r = atomic_load(&making.error);
  if (r < 0)
    return r;
  const uint64_t first = (uint64_t)hand->step * settings->batch;
  for (uint32_t i = 0; i < settings->batch; i++) {
    const size_t body = pretrain ? i : (first + i) % n_bodies;
    const struct mo_environment *environment =
        draws ? &hand->environments[i] : choose(training, hand->step, i);
    hand->robots[i] = (struct mo_robot){making.bodies[body], environment,
                                        making.genotypes + MO_DEFAULT_WORDS * body};
  }
  hand->ready = true;
  return MO_OK;
}

static void free_bodies(struct mo_body **bodies, uint32_t n)
{
  for (uint32_t i = 0; bodies != NULL && i < n; i++) {
    mo_body_free(bodies[i]);
    bodies[i] = NULL;
  }
}

static void forget(const struct mo_training *training, struct mo_hand *hand)
{
  hand->ready = hand->stale = false;
  hand->n_drawn = 0;
  free_bodies(hand->bodies, training->settings.batch);
}

static int fill(struct mo_training *training, uint32_t step, const volatile int *cancel,
                volatile uint64_t *replayed)
{
  const bool pretrain = training->settings.kind == MO_TRAINING_PRETRAIN;
  struct mo_hand *hand = &training->hands[step % 2];
  if (hand->ready && hand->step == step)
    return MO_OK;
  if (hand->stale)
    forget(training, hand);
  hand->step = step;
  int r = prepare(training, hand);
  if (r == MO_OK && pretrain)
    r = replay(training, cancel, replayed);
  if (r == MO_OK && pretrain)
    r = draw_bodies(training, hand, cancel);
  return r == MO_OK ? make_robots(training, hand) : r;
}

int mo_training_draw(struct mo_training *training, const volatile int *cancel,
                     volatile uint64_t *replayed, const struct mo_robot **robots)
{
  if (training->step >= training->settings.n_steps)
    return MO_ERR_CONFLICT;
  const int r = fill(training, training->step, cancel, replayed);
  if (r == MO_OK)
    *robots = training->hands[training->step % 2].robots;
  return r;
}

int mo_training_draw_ahead(struct mo_training *training, const volatile int *cancel)
{
  if (mo_training_hand(training, training->step) == NULL)
    return MO_ERR_CONFLICT;
  return training->settings.n_steps - training->step > 1
             ? fill(training, training->step + 1, cancel, NULL)
             : MO_OK;
}

struct mo_hand *mo_training_hand(struct mo_training *training, uint32_t step)
{
  struct mo_hand *hand = &training->hands[step % 2];
  return hand->ready && hand->step == step ? hand : NULL;
}

void mo_training_set_threads(struct mo_training *training, uint32_t n_threads)
{
  training->n_threads = n_threads > 1 ? n_threads : 1;
  if (training->stream != NULL)
    (void)mo_body_stream_set_threads(training->stream, training->n_threads);
}

const struct mo_robot *mo_training_robots_ahead(struct mo_training *training)
{
  const struct mo_hand *hand = mo_training_hand(training, training->step + 1);
  return hand != NULL ? hand->robots : NULL;
}

/* Forgets the current robots. Freeing the bodies of thousands of robots takes milliseconds, so if
 * the next robots are ready, a later draw ahead frees these bodies, while no thread waits. */
void mo_training_forget_robots(struct mo_training *training)
{
  struct mo_hand *hand = &training->hands[training->step % 2];
  if (mo_training_hand(training, training->step + 1) == NULL)
    forget(training, hand);
  hand->ready = false;
  hand->stale = true;
}

void mo_training_forget_designs(struct mo_training *training)
{
  for (int h = 0; h < 2; h++)
    forget(training, &training->hands[h]);
  free_bodies(training->bodies, training->n_bodies);
  free(training->bodies);
  training->bodies = NULL;
  training->n_bodies = 0;
}

void mo_training_draw_free(struct mo_training *training)
{
  mo_training_forget_designs(training);
  for (int h = 0; h < 2; h++) {
    struct mo_hand *hand = &training->hands[h];
    free(hand->drawn);
    free(hand->bodies);
    free(hand->environments);
    free(hand->variations);
    free(hand->robots);
  }
  mo_body_stream_free(training->stream);
  mo_lattice_free(training->lattice);
}
