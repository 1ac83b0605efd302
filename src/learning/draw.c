/* draw.c: the robots of a step.
 *
 * Pretraining: the next bodies of the stream of the seed that are not held out. The set of bodies seen is not saved: a restored
 * training draws its earlier bodies again, about 6 µs each, and must arrive at the same number of draws. Finetuning: the designs
 * in turn, which go on from one step to the next. Whatever stops a draw, the next call goes on where it stopped. */
#include "learning/internal.h"

#include <stdlib.h>
#include <string.h>

#define ASK_EVERY 64 /* bodies between two looks at `cancel` */

static int take(struct mo_training *training, uint64_t *body)
{
  for (;;) {
    uint64_t form[MO_DEFAULT_WORDS];
    const int r = mo_body_stream_next(training->stream, body);
    if (r < 0)
      return r;
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, body, form);
    if (!mo_held_out_form(form)) {
      training->taken++;
      return MO_OK;
    }
  }
}

static bool is_cancelled(const struct mo_training *training, const volatile int *cancel)
{
  return cancel != NULL && training->taken % ASK_EVERY == 0 && __atomic_load_n(cancel, __ATOMIC_RELAXED) != 0;
}

/* Draws that failed have left the stream beyond the step's beginning: what it must arrive at is checked once. */
static int replay(struct mo_training *training, const volatile int *cancel, volatile uint64_t *replayed)
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

static int draw_bodies(struct mo_training *training, const volatile int *cancel, volatile uint64_t *replayed)
{
  int r = replay(training, cancel, replayed);
  while (r == MO_OK && training->n_drawn < training->settings.batch) {
    r = is_cancelled(training, cancel) ? MO_ERR_CANCELLED
                                       : take(training, training->drawn + (size_t)MO_DEFAULT_WORDS * training->n_drawn);
    training->n_drawn += r == MO_OK;
  }
  return r;
}

static int prepare(struct mo_training *training)
{
  const bool pretrain = training->settings.kind == MO_TRAINING_PRETRAIN;
  const size_t batch = training->settings.batch;
  int r = MO_OK;
  if (training->lattice == NULL)
    r = mo_lattice_create(MO_DEFAULT_WORKSPACE, &training->lattice);
  if (r == MO_OK && pretrain && training->stream == NULL)
    r = mo_body_stream_create(MO_DEFAULT_WORKSPACE, training->settings.seed, &training->stream);
  if (r < 0)
    return r;
  training->n_bodies = pretrain ? training->settings.batch : training->n_designs;
  if (pretrain && training->drawn == NULL)
    training->drawn = calloc(batch, MO_DEFAULT_WORDS * sizeof(*training->drawn));
  if (training->bodies == NULL)
    training->bodies = calloc(training->n_bodies, sizeof(struct mo_body *));
  if (training->environments == NULL)
    training->environments = calloc(batch, sizeof(*training->environments));
  if (training->robots == NULL)
    training->robots = calloc(batch, sizeof(*training->robots));
  return (pretrain && training->drawn == NULL) || training->bodies == NULL || training->environments == NULL ||
                 training->robots == NULL
             ? MO_ERR_NO_MEMORY
             : MO_OK;
}

static int express(struct mo_training *training)
{
  const uint64_t *genotypes = training->settings.kind == MO_TRAINING_PRETRAIN ? training->drawn : training->designs;
  for (uint32_t i = 0; i < training->n_bodies; i++) {
    if (training->bodies[i] != NULL)
      continue;
    const int r = mo_body_create(training->lattice, genotypes + (size_t)MO_DEFAULT_WORDS * i, &training->bodies[i]);
    if (r < 0)
      return r;
  }
  return MO_OK;
}

int mo_training_draw(struct mo_training *training, const volatile int *cancel, volatile uint64_t *replayed,
                     const struct mo_robot **robots)
{
  const struct mo_training_settings *settings = &training->settings;
  if (training->step >= settings->n_steps)
    return MO_ERR_CONFLICT;
  if (!training->ready) {
    int r = prepare(training);
    if (r == MO_OK && settings->kind == MO_TRAINING_PRETRAIN)
      r = draw_bodies(training, cancel, replayed);
    if (r == MO_OK)
      r = express(training);
    if (r < 0)
      return r;
    const uint64_t first = (uint64_t)training->step * settings->batch;
    for (uint32_t i = 0; i < settings->batch; i++) {
      const uint64_t body = settings->kind == MO_TRAINING_PRETRAIN ? i : (first + i) % training->n_designs;
      mo_environment_training(settings->seed, training->step, i, &training->environments[i]);
      training->robots[i] = (struct mo_robot){training->bodies[body], &training->environments[i]};
    }
    training->ready = true;
  }
  *robots = training->robots;
  return MO_OK;
}

static void free_bodies(struct mo_training *training)
{
  for (uint32_t i = 0; training->bodies != NULL && i < training->n_bodies; i++) {
    mo_body_free(training->bodies[i]);
    training->bodies[i] = NULL;
  }
}

void mo_training_forget_robots(struct mo_training *training)
{
  training->ready = false;
  training->n_drawn = 0;
  if (training->settings.kind == MO_TRAINING_PRETRAIN)
    free_bodies(training);
}

void mo_training_forget_designs(struct mo_training *training)
{
  mo_training_forget_robots(training);
  free_bodies(training);
  free(training->bodies);
  training->bodies = NULL;
  training->n_bodies = 0;
}

size_t mo_training_draw_bytes(const struct mo_training *training)
{
  size_t bytes = training->stream != NULL ? mo_body_stream_bytes(training->stream) : 0;
  if (training->drawn != NULL)
    bytes += training->settings.batch * MO_DEFAULT_WORDS * sizeof(*training->drawn);
  if (training->environments != NULL)
    bytes += training->settings.batch * (sizeof(struct mo_environment) + sizeof(struct mo_robot));
  for (uint32_t i = 0; training->bodies != NULL && i < training->n_bodies; i++) {
    const struct mo_body *body = training->bodies[i];
    bytes += sizeof(struct mo_body *);
    if (body != NULL) /* per mass: lattice index and three coordinates; per spring: index, two ends, kind */
      bytes += sizeof(*body) + body->n_masses * (sizeof(uint32_t) + 3 * sizeof(uint16_t)) +
               body->n_springs * (3 * sizeof(uint32_t) + sizeof(uint8_t));
  }
  return bytes;
}

void mo_training_draw_free(struct mo_training *training)
{
  free_bodies(training);
  free(training->bodies);
  free(training->robots);
  free(training->environments);
  free(training->drawn);
  mo_body_stream_free(training->stream);
  mo_lattice_free(training->lattice);
}
