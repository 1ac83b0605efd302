/* device_chunk.c: turns waiting blocks into the rows of one call, and back.
 *
 * A chunk is taken from the share that is next, as a worker takes one block, and is filled with the
 * share's other waiting blocks. Waiting work is cut evenly: a job with work for two and a half
 * calls gets three of the same size, and all devices finish at about the same time. */
#include "compute/devices.h"

#include <stdlib.h>
#include <string.h>

#include "base/thread.h"

enum { BODIES_PER_THREAD = 100 }; /* about a millisecond */

int mo_chunk_create(struct mo_chunk *chunk)
{
  chunk->blocks = calloc(MO_CHUNK_ROWS, sizeof(struct mo_block *));
  chunk->status = calloc(MO_CHUNK_ROWS, sizeof(*chunk->status));
  chunk->first_row = calloc(MO_CHUNK_ROWS, sizeof(*chunk->first_row));
  chunk->bodies = calloc(MO_CHUNK_ROWS, sizeof(struct mo_body *));
  chunk->needs_body = calloc(MO_CHUNK_ROWS, sizeof(*chunk->needs_body));
  chunk->robots = calloc(MO_CHUNK_ROWS, sizeof(*chunk->robots));
  chunk->outcomes = calloc(MO_CHUNK_ROWS, sizeof(*chunk->outcomes));
  return chunk->blocks == NULL || chunk->status == NULL || chunk->first_row == NULL ||
                 chunk->bodies == NULL || chunk->needs_body == NULL || chunk->robots == NULL ||
                 chunk->outcomes == NULL
             ? MO_ERR_NO_MEMORY
             : MO_OK;
}

void mo_chunk_destroy(struct mo_chunk *chunk)
{
  free(chunk->blocks);
  free(chunk->status);
  free(chunk->first_row);
  free(chunk->bodies);
  free(chunk->needs_body);
  free(chunk->robots);
  free(chunk->outcomes);
}

/* ---- taking ---- */

struct room {
  const struct mo_block *like;
  uint32_t rows; /* left */
};

bool mo_same_physics(const struct mo_physics *a, const struct mo_physics *b)
{
  return a->dt_s == b->dt_s && a->n_steps == b->n_steps &&
         a->stiffness_n_per_m == b->stiffness_n_per_m && a->mass_kg == b->mass_kg &&
         a->drag_per_s == b->drag_per_s && a->gravity_m_per_s2 == b->gravity_m_per_s2 &&
         a->actuation == b->actuation && a->friction == b->friction &&
         a->friction_cap == b->friction_cap && a->drop_height_m == b->drop_height_m &&
         a->impact == b->impact && a->bisections == b->bisections;
}

static bool fits(const struct mo_block *block, void *context)
{
  const struct room *room = context;
  return block->shards == NULL && block->controller == room->like->controller &&
         block->n_environments <= room->rows &&
         mo_same_physics(&block->physics, &room->like->physics);
}

/* Returns the rows per call, if all that a share has waiting is cut evenly. */
static uint32_t even_rows(const struct mo_unit *unit, const struct mo_compute_share *share,
                          const struct mo_block *first)
{
  const bool is_alone = unit->devices->last == share &&
                        atomic_load(&unit->devices->fair.waiting) == atomic_load(&share->waiting);
  const uint32_t limit = is_alone ? MO_CHUNK_ROWS : MO_CHUNK_ROWS_SHARED;
  const uint64_t most = unit->row_limit < limit ? unit->row_limit : limit;
  const uint64_t n_working = atomic_load(&unit->devices->n_working),
                 n_devices = n_working > 0 ? n_working : 1;
  const uint64_t waiting = (1 + atomic_load(&share->waiting)) * first->n_environments;
  const uint64_t rounds = (waiting + most * n_devices - 1) / (most * n_devices);
  const uint64_t rows = (waiting + rounds * n_devices - 1) / (rounds * n_devices);
  return rows < first->n_environments ? first->n_environments
                                      : (uint32_t)(rows < most ? rows : most);
}

bool mo_chunk_take(struct mo_unit *unit, struct mo_chunk *chunk)
{
  struct mo_fair *fair = &unit->devices->fair;
  struct mo_block *block = mo_fair_take_from(fair, &unit->devices->urgent, &chunk->charge);
  if (block == NULL)
    block = mo_fair_take(fair, &chunk->charge);
  if (block == NULL)
    return false;
  struct room room = {.like = block};
  chunk->task = block->shards;
  chunk->blocks[0] = block;
  chunk->status[0] = MO_CHUNK_NOT_DONE;
  chunk->n_blocks = chunk->n_active = 1;
  chunk->n_rows = 0;
  if (block->shards != NULL) {
    unit->devices->tasks_waiting--;
    unit->devices->last = chunk->charge.share;
    return true;
  }
  room.rows = even_rows(unit, chunk->charge.share, block) - block->n_environments;
  unit->devices->last = chunk->charge.share;
  while ((block = mo_fair_take_more(fair, &chunk->charge, fits, &room)) != NULL) {
    room.rows -= block->n_environments;
    chunk->status[chunk->n_blocks] = MO_CHUNK_NOT_DONE;
    chunk->blocks[chunk->n_blocks++] = block;
  }
  chunk->n_active = chunk->n_blocks;
  return true;
}

/* ---- building ---- */

static bool is_cancelled(const struct mo_block *block)
{
  return (block->cancel != NULL && __atomic_load_n(block->cancel, __ATOMIC_RELAXED) != 0) ||
         (block->shards != NULL && atomic_load_explicit(block->shards->stop, memory_order_relaxed));
}

static bool same_body(const struct mo_block *a, const struct mo_block *b)
{
  return a->body == NULL && b->body == NULL && a->lattice == b->lattice &&
         memcmp(a->genotype, b->genotype,
                mo_workspace_words(a->lattice->workspace) * sizeof(*a->genotype)) == 0;
}

/* Marks the blocks that need a body of their own and returns their number. A block that brings a
 * body, or continues that of the previous block that is not cancelled, needs none. */
static uint32_t plan_bodies(struct mo_chunk *chunk)
{
  const struct mo_block *before = NULL;
  uint32_t n = 0;
  for (uint32_t i = 0; i < chunk->n_active; i++) {
    const struct mo_block *block = chunk->blocks[i];
    chunk->bodies[i] = NULL;
    chunk->needs_body[i] = false;
    if (is_cancelled(block)) {
      chunk->status[i] = MO_ERR_CANCELLED;
      continue;
    }
    chunk->needs_body[i] = block->body == NULL && (before == NULL || !same_body(block, before));
    n += chunk->needs_body[i];
    before = block;
  }
  return n;
}

static void build_bodies(void *context, size_t first, size_t end)
{
  struct mo_chunk *chunk = context;
  for (size_t i = first; i < end; i++)
    if (chunk->needs_body[i]) {
      const int status =
          mo_body_create(chunk->blocks[i]->lattice, chunk->blocks[i]->genotype, &chunk->bodies[i]);
      if (status != MO_OK)
        chunk->status[i] = status;
    }
}

/* Moves the block at `place` to the end of the active ones and gives it rows; the block that was
 * there already has a result. */
static void keep(struct mo_chunk *chunk, uint32_t place, const struct mo_body *body)
{
  const uint32_t to = chunk->n_active++;
  struct mo_block *block = chunk->blocks[place], *ended = chunk->blocks[to];
  struct mo_body *own = chunk->bodies[place];
  const int status = chunk->status[place];
  chunk->blocks[place] = ended;
  chunk->status[place] = chunk->status[to];
  chunk->bodies[place] = NULL;
  chunk->blocks[to] = block;
  chunk->status[to] = status;
  chunk->bodies[to] = own;
  chunk->first_row[to] = chunk->n_rows;
  for (uint32_t i = 0; i < block->n_environments; i++)
    chunk->robots[chunk->n_rows++] =
        (struct mo_robot){.body = body, .environment = block->environments[i]};
}

/* Lays out the rows. Environments of one body are neighbors, also across blocks. */
static void lay_out(struct mo_chunk *chunk)
{
  const uint32_t n = chunk->n_active;
  const struct mo_body *body = NULL;
  int status = MO_CHUNK_NOT_DONE; /* status of the body */
  chunk->n_active = 0;
  for (uint32_t i = 0; i < n; i++) {
    if (chunk->status[i] == MO_ERR_CANCELLED)
      continue;
    if (chunk->needs_body[i] || chunk->blocks[i]->body != NULL) {
      body = chunk->needs_body[i] ? chunk->bodies[i] : chunk->blocks[i]->body;
      status = chunk->status[i];
    }
    chunk->status[i] = status;
    if (status == MO_CHUNK_NOT_DONE)
      keep(chunk, i, body);
  }
}

void mo_chunk_build(struct mo_chunk *chunk, uint32_t n_threads)
{
  if (chunk->task != NULL)
    return;
  const uint32_t n = plan_bodies(chunk), enough = 1 + n / BODIES_PER_THREAD;
  mo_parallel(n_threads < enough ? n_threads : enough, chunk->n_active, build_bodies, chunk);
  lay_out(chunk);
}

bool mo_chunk_is_cancelled(const struct mo_chunk *chunk)
{
  for (uint32_t i = 0; i < chunk->n_active; i++)
    if (!is_cancelled(chunk->blocks[i]))
      return false;
  return true;
}

/* ---- returning ---- */

void mo_chunk_return(struct mo_devices *devices, struct mo_chunk *chunk)
{
  for (uint32_t i = 0; i < chunk->n_blocks; i++) {
    if (chunk->status[i] != MO_CHUNK_NOT_DONE)
      continue;
    if (devices->stopping) {
      chunk->status[i] = MO_ERR_CANCELLED;
    } else if (atomic_load(&devices->n_working) == 0) {
      chunk->status[i] = MO_ERR_DEVICE;
    } else {
      devices->tasks_waiting += chunk->task != NULL;
      mo_fair_push(&devices->fair, chunk->charge.share, chunk->blocks[i]);
      chunk->blocks[i] = NULL;
    }
  }
  pthread_cond_broadcast(&devices->wake);
}

/* Calls `done`, or passes the block to the workers. outcomes: for a scoring block that has rows;
 * else NULL. */
static void end_block(struct mo_devices *devices, struct mo_block *block, int status,
                      const struct mo_outcome *outcomes)
{
  if (status == MO_CHUNK_TO_WORKERS) {
    status = mo_compute_submit_to_workers(devices->compute, block);
    if (status == MO_OK)
      return;
  } else if (status == MO_OK && outcomes != NULL) {
    memcpy(block->outcomes, outcomes, block->n_environments * sizeof(*outcomes));
  }
  block->status = status;
  block->computed_on = MO_ON_DEVICE;
  block->done(block, block->context);
}

void mo_chunk_deliver(struct mo_devices *devices, struct mo_chunk *chunk)
{
  const uint32_t n_bodies = chunk->task == NULL ? chunk->n_active : 0;
  for (uint32_t i = 0; i < chunk->n_blocks; i++)
    if (chunk->blocks[i] != NULL)
      end_block(devices, chunk->blocks[i], chunk->status[i],
                chunk->task == NULL && i < chunk->n_active ? chunk->outcomes + chunk->first_row[i]
                                                           : NULL);
  for (uint32_t i = 0; i < n_bodies; i++) { /* owned by this chunk */
    mo_body_free(chunk->bodies[i]);
    chunk->bodies[i] = NULL;
  }
  chunk->n_blocks = chunk->n_active = 0;
}
