/* device_chunk.c: turns waiting blocks into the rows of one call, and back.
 *
 * A chunk is taken from the share that is next, as a worker takes one block, and is filled with the
 * share's other waiting blocks. Waiting work is cut evenly: a job with work for two and a half
 * calls gets three calls of the same size, and all devices finish at about the same time. */
#include "compute/devices.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "rollout/physics.h"

enum { BODIES_PER_THREAD = 100 }; /* about a millisecond */

int mo_chunk_create(struct mo_chunk *chunk)
{
  chunk->items = calloc(MO_CHUNK_ROWS, sizeof(*chunk->items));
  chunk->robots = calloc(MO_CHUNK_ROWS, sizeof(*chunk->robots));
  chunk->outcomes = calloc(MO_CHUNK_ROWS, sizeof(*chunk->outcomes));
  return chunk->items == NULL || chunk->robots == NULL || chunk->outcomes == NULL ? MO_ERR_NO_MEMORY
                                                                                  : MO_OK;
}

void mo_chunk_destroy(struct mo_chunk *chunk)
{
  free(chunk->items);
  free(chunk->robots);
  free(chunk->outcomes);
  free(chunk->measures);
}

/* ---- taking ---- */

struct room {
  const struct mo_block *like;
  uint32_t rows; /* number of rows left */
};

static bool fits(const struct mo_block *block, void *context)
{
  const struct room *room = context;
  return block->shards == NULL && block->controller == room->like->controller &&
         block->n_environments <= room->rows &&
         (block->measuring != NULL) == (room->like->measuring != NULL) &&
         mo_physics_equal(&block->physics, &room->like->physics);
}

uint32_t mo_unit_held(const struct mo_unit *unit)
{
  uint32_t n = 0;
  for (uint32_t c = 0; c < MO_CALLERS; c++)
    n += unit->callers[c].state != MO_CALLER_IDLE;
  return n;
}

/* Returns the number of calls that share the waiting work: the calls that could begin now. A device
 * with a call in flight or pending counts only if there is enough work for all. */
static uint64_t calls_now(const struct mo_devices *devices, uint64_t waiting)
{
  uint64_t n = 0, idle = 0;
  for (uint32_t i = 0; i < devices->n; i++) {
    const struct mo_unit *unit = &devices->units[i];
    const uint32_t held = mo_unit_held(unit);
    if (unit->status.state != MO_DEVICE_WORKS)
      continue;
    n += held < unit->n_callers ? unit->n_callers - held : 0;
    idle += held == 0;
  }
  if (waiting < n * MO_CHUNK_ROWS_ENOUGH)
    n = idle;
  return n > 0 ? n : 1;
}

/* Returns the rows per call if the waiting work of a share is cut evenly. */
static uint32_t even_rows(const struct mo_unit *unit, const struct mo_compute_share *share,
                          const struct mo_block *first)
{
  const bool is_alone = unit->devices->last == share &&
                        atomic_load(&unit->devices->fair.waiting) == atomic_load(&share->queue.n);
  const uint32_t limit = is_alone ? MO_CHUNK_ROWS : MO_CHUNK_ROWS_SHARED;
  const uint64_t most = unit->row_limit < limit ? unit->row_limit : limit;
  const uint64_t waiting = (1 + atomic_load(&share->queue.n)) * first->n_environments;
  const uint64_t n_calls = calls_now(unit->devices, waiting);
  const uint64_t rounds = (waiting + most * n_calls - 1) / (most * n_calls);
  const uint64_t rows = (waiting + rounds * n_calls - 1) / (rounds * n_calls);
  return rows < first->n_environments ? first->n_environments
                                      : (uint32_t)(rows < most ? rows : most);
}

bool mo_chunk_take(struct mo_unit *unit, struct mo_chunk *chunk)
{
  struct mo_fair *fair = &unit->devices->fair;
  struct mo_block *block = mo_fair_take_from(fair, &unit->devices->urgent, &chunk->charge);
  if (block == NULL)
    block = mo_fair_take(fair, &chunk->charge, NULL, NULL);
  if (block == NULL)
    return false;
  struct room room = {.like = block};
  chunk->task = block->shards;
  chunk->items[0] = (struct mo_chunk_item){.block = block, .status = MO_CHUNK_NOT_DONE};
  chunk->n_blocks = chunk->n_active = 1;
  chunk->n_rows = 0;
  chunk->is_measured = block->measuring != NULL;
  if (block->shards != NULL) {
    unit->devices->tasks_waiting--;
    unit->devices->last = chunk->charge.share;
    return true;
  }
  room.rows = even_rows(unit, chunk->charge.share, block) - block->n_environments;
  unit->devices->last = chunk->charge.share;
  while ((block = mo_fair_take_more(fair, &chunk->charge, fits, &room)) != NULL) {
    room.rows -= block->n_environments;
    chunk->items[chunk->n_blocks++] =
        (struct mo_chunk_item){.block = block, .status = MO_CHUNK_NOT_DONE};
  }
  chunk->n_active = chunk->n_blocks;
  return true;
}

/* ---- building ---- */

static bool same_body(const struct mo_block *a, const struct mo_block *b)
{
  return a->body == NULL && b->body == NULL && a->lattice == b->lattice &&
         memcmp(a->genotype, b->genotype,
                mo_workspace_words(a->lattice->workspace) * sizeof(*a->genotype)) == 0;
}

/* Marks the blocks that need their own body and returns their number. A block does not need one if
 * it brings its body, or has the same body as the previous block that is not cancelled. */
static uint32_t plan_bodies(struct mo_chunk *chunk)
{
  const struct mo_block *before = NULL;
  uint32_t n = 0;
  for (struct mo_chunk_item *item = chunk->items; item < chunk->items + chunk->n_active; item++) {
    const struct mo_block *block = item->block;
    if (mo_block_is_cancelled(block)) {
      item->status = MO_ERR_CANCELLED;
      continue;
    }
    item->needs_body = block->body == NULL && (before == NULL || !same_body(block, before));
    n += item->needs_body;
    before = block;
  }
  return n;
}

static void build_bodies(void *context, size_t first, size_t end)
{
  struct mo_chunk *chunk = context;
  for (struct mo_chunk_item *item = chunk->items + first; item < chunk->items + end; item++)
    if (item->needs_body) {
      const int status = mo_body_create(item->block->lattice, item->block->genotype, &item->body);
      if (status != MO_OK)
        item->status = status;
    }
}

/* Lays out the rows, and moves the blocks that have rows before the blocks that already have a
 * result. Environments of one body become adjacent, even across blocks. */
static void lay_out(struct mo_chunk *chunk)
{
  const uint32_t n = chunk->n_active;
  const struct mo_body *body = NULL;
  int status = MO_CHUNK_NOT_DONE; /* status of the body */
  chunk->n_active = 0;
  for (uint32_t i = 0; i < n; i++) {
    struct mo_chunk_item item = chunk->items[i];
    if (item.status == MO_ERR_CANCELLED)
      continue;
    if (item.needs_body || item.block->body != NULL) {
      body = item.needs_body ? item.body : item.block->body;
      status = item.status;
    }
    chunk->items[i].status = item.status = status;
    if (status != MO_CHUNK_NOT_DONE)
      continue;
    item.first_row = chunk->n_rows;
    for (uint32_t k = 0; k < item.block->n_environments; k++)
      chunk->robots[chunk->n_rows++] =
          (struct mo_robot){.body = body, .environment = item.block->environments[k]};
    chunk->items[i] = chunk->items[chunk->n_active];
    chunk->items[chunk->n_active++] = item;
  }
}

/* Makes room for measures. Returns false if memory runs out. */
static bool prepare_measures(struct mo_chunk *chunk)
{
  if (chunk->is_measured && chunk->measures == NULL)
    chunk->measures = malloc(MO_CHUNK_ROWS * sizeof(*chunk->measures));
  return !chunk->is_measured || chunk->measures != NULL;
}

void mo_chunk_build(struct mo_chunk *chunk, uint32_t n_threads)
{
  if (chunk->task != NULL)
    return;
  if (!prepare_measures(chunk)) {
    for (uint32_t i = 0; i < chunk->n_active; i++)
      chunk->items[i].status = MO_ERR_NO_MEMORY;
    chunk->n_active = 0;
    return;
  }
  const uint32_t n = plan_bodies(chunk), enough = 1 + n / BODIES_PER_THREAD;
  mo_parallel(n_threads < enough ? n_threads : enough, chunk->n_active, build_bodies, chunk);
  lay_out(chunk);
}

bool mo_chunk_is_cancelled(const struct mo_chunk *chunk)
{
  for (uint32_t i = 0; i < chunk->n_active; i++)
    if (!mo_block_is_cancelled(chunk->items[i].block))
      return false;
  return true;
}

/* ---- returning ---- */

void mo_chunk_return(struct mo_devices *devices, struct mo_chunk *chunk)
{
  for (struct mo_chunk_item *item = chunk->items; item < chunk->items + chunk->n_blocks; item++) {
    if (item->status != MO_CHUNK_NOT_DONE)
      continue;
    if (devices->stopping) {
      item->status = MO_ERR_CANCELLED;
    } else if (atomic_load(&devices->n_working) == 0) {
      item->status = MO_ERR_DEVICE;
    } else {
      devices->tasks_waiting += chunk->task != NULL;
      mo_fair_push(&devices->fair, chunk->charge.share, item->block);
      item->block = NULL;
    }
  }
  pthread_cond_broadcast(&devices->wake);
}

void mo_chunk_end_block(struct mo_devices *devices, struct mo_block *block, int status,
                        const struct mo_outcome *outcomes)
{
  if (status == MO_CHUNK_TO_WORKERS) {
    status = mo_core(devices->compute)->submit_to_workers(devices->compute, block);
    if (status == MO_OK)
      return;
  } else if (status == MO_OK && outcomes != NULL) {
    memcpy(block->outcomes, outcomes, block->n_environments * sizeof(*outcomes));
  }
  block->status = status;
  block->computed_on = MO_ON_DEVICE;
  block->done(block, block->context);
}

/* Copies the measures that a block requests. */
static void deliver_measures(const struct mo_chunk *chunk, const struct mo_chunk_item *item)
{
  const struct mo_block *block = item->block;
  for (uint32_t e = 0; e < block->n_environments; e++)
    for (int k = 0; k < MO_MEASURES; k++)
      block->measuring->values[e][k] = (block->measuring->set >> k & 1) != 0
                                           ? chunk->measures[item->first_row + e][k]
                                           : (double)NAN;
}

void mo_chunk_deliver(struct mo_devices *devices, struct mo_chunk *chunk)
{
  for (uint32_t i = 0; i < chunk->n_blocks; i++) {
    const struct mo_chunk_item *item = &chunk->items[i];
    if (item->block != NULL && item->status == MO_OK && chunk->is_measured && i < chunk->n_active)
      deliver_measures(chunk, item);
    if (item->block != NULL)
      mo_chunk_end_block(
          devices, item->block, item->status,
          chunk->task == NULL && i < chunk->n_active ? chunk->outcomes + item->first_row : NULL);
  }
  for (uint32_t i = 0; i < chunk->n_active; i++) /* owned by this chunk */
    mo_body_free(chunk->items[i].body);
  chunk->n_blocks = chunk->n_active = 0;
}
