/* scoring.c: scores designs in environments under one controller.
 *
 * A grid is cut, in order, into blocks of one design and up to MO_BLOCK_LANES environments. What
 * the store knows is marked as done before. The thread that submits blocks takes them back from a
 * inbox, stores their results, and submits more, so that the back end always holds a window of
 * them. A crash loses the blocks in flight and the results that wait for their commit. */
#include "jobs/scoring.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"

#define NOT_A_LOSS     MO_ERR_RANGE /* a code that back ends do not return */
#define RATE_AFTER_US  INT64_C(500000)
#define QUIET_US       INT64_C(20000)
#define SAVED_AFTER_US INT64_C(1000000)

/* ---- grids ---- */

int mo_grid_create(struct mo_grid *grid)
{
  grid->cells = calloc((size_t)grid->n_designs * grid->n_environments + 1, 1);
  grid->left = malloc((size_t)grid->n_designs + 1);
  if (grid->cells == NULL || grid->left == NULL)
    return MO_ERR_NO_MEMORY;
  memset(grid->left, (int)grid->n_environments, grid->n_designs);
  return MO_OK;
}

void mo_grid_free(struct mo_grid *grid)
{
  free(grid->cells);
  free(grid->left);
  grid->cells = grid->left = NULL;
}

bool mo_grid_finish(struct mo_grid *grid, uint32_t design, uint32_t k)
{
  *mo_grid_cell(grid, design, k) = MO_CELL_DONE;
  return --grid->left[design] == 0;
}

void mo_grid_finish_design(struct mo_grid *grid, uint32_t design)
{
  memset(mo_grid_cell(grid, design, 0), MO_CELL_DONE, grid->n_environments);
  grid->left[design] = 0;
}

void mo_grid_return(struct mo_grid *grid, uint32_t design, uint32_t k)
{
  *mo_grid_cell(grid, design, k) = MO_CELL_TO_DO;
  if (design < grid->cursor)
    grid->cursor = design;
}

/* ---- flights ---- */

static void arrive(struct mo_block *block, void *context)
{
  struct mo_flight *flight = context;
  struct mo_inbox *inbox = flight->inbox;
  (void)block;
  pthread_mutex_lock(inbox->mutex);
  flight->next = inbox->finished;
  inbox->finished = flight;
  pthread_cond_broadcast(inbox->news);
  pthread_mutex_unlock(inbox->mutex);
}

void mo_flight_begin(struct mo_flight *flight, struct mo_grid *grid, uint32_t design,
                     struct mo_inbox *inbox)
{
  flight->block = grid->block;
  flight->block.genotype = grid->genotypes[design].words;
  flight->block.done = arrive;
  flight->block.context = flight;
  flight->grid = grid;
  flight->inbox = inbox;
  flight->design = design;
}

bool mo_flight_add(struct mo_flight *flight, uint32_t k)
{
  struct mo_block *block = &flight->block;
  if (block->n_environments == MO_BLOCK_LANES)
    return false;
  *mo_grid_cell(flight->grid, flight->design, k) = MO_CELL_IN_FLIGHT;
  flight->places[block->n_environments] = (uint8_t)k;
  block->environments[block->n_environments++] = &flight->grid->environments[k];
  return true;
}

void mo_flight_launch(struct mo_compute *compute, struct mo_flight *flight)
{
  const int error = mo_compute_submit(compute, &flight->block);
  if (error == MO_OK)
    return;
  flight->block.status = error;
  arrive(&flight->block, flight);
}

int mo_flight_check(const struct mo_flight *flight, uint32_t i)
{
  const struct mo_block *block = &flight->block;
  if (block->status != MO_OK)
    return mo_back_end_error(block->back_end, block->status);
  return block->outcomes[i].loss > -INFINITY ? MO_OK : NOT_A_LOSS;
}

void mo_flight_describe(int error, char text[128])
{
  if (error == NOT_A_LOSS)
    snprintf(text, 128, "the runner of rollouts gave a loss that is not a number");
  else
    snprintf(text, 128, "the runner of rollouts reported: %s", mo_error_text(error));
}

/* ---- a whole grid ---- */

struct window {
  struct mo_scoring *scoring;
  struct mo_flight *flights, *free;
  uint32_t n_in_flight;
  int64_t begin_us;
  int64_t unsaved_us; /* time of the oldest unsaved result; 0: none */
  uint64_t computed;
  pthread_mutex_t mutex;
  pthread_cond_t news;
  struct mo_inbox inbox;
};

static void launch(struct window *window)
{
  struct mo_grid *grid = &window->scoring->grid;
  struct mo_flight *flight = window->free;
  window->free = flight->next;
  window->n_in_flight++;
  mo_flight_begin(flight, grid, grid->cursor, &window->inbox);
  for (uint32_t k = 0; k < grid->n_environments; k++)
    if (*mo_grid_cell(grid, grid->cursor, k) == MO_CELL_TO_DO && !mo_flight_add(flight, k))
      break;
  mo_flight_launch(window->scoring->runner->jobs->compute, flight);
}

static void fill(struct window *window)
{
  struct mo_grid *grid = &window->scoring->grid;
  struct mo_compute *compute = window->scoring->runner->jobs->compute;
  mo_compute_begin_blocks(compute);
  while (window->free != NULL && grid->cursor < grid->n_designs) {
    if (memchr(mo_grid_cell(grid, grid->cursor, 0), MO_CELL_TO_DO, grid->n_environments) != NULL)
      launch(window);
    else
      grid->cursor++;
  }
  mo_compute_end_blocks(compute);
}

static int take_back(struct window *window, struct mo_flight *flight)
{
  struct mo_scoring *scoring = window->scoring;
  const uint32_t n = flight->block.n_environments;
  bool is_done = false;
  int error = MO_OK;
  window->n_in_flight--;
  for (uint32_t i = 0; i < n && error == MO_OK; i++)
    error = mo_flight_check(flight, i);
  if (error == MO_OK) {
    for (uint32_t i = 0; i < n; i++)
      is_done = mo_grid_finish(&scoring->grid, flight->design, flight->places[i]);
    window->computed += n;
    scoring->take(scoring->context, flight, is_done);
  } else if (error != MO_ERR_CANCELLED) {
    mo_flight_describe(error, scoring->runner->text);
  }
  flight->next = window->free;
  window->free = flight;
  return error;
}

/* Waits for a block and takes the finished ones. A request cancels all blocks soon. */
static int take_all(struct window *window)
{
  struct mo_flight *flight;
  int error = MO_OK;
  pthread_mutex_lock(&window->mutex);
  while (window->inbox.finished == NULL)
    pthread_cond_wait(&window->news, &window->mutex);
  flight = window->inbox.finished;
  window->inbox.finished = NULL;
  pthread_mutex_unlock(&window->mutex);
  while (flight != NULL) {
    struct mo_flight *next = flight->next;
    const int taken = take_back(window, flight);
    if (error == MO_OK || error == MO_ERR_CANCELLED)
      error = taken != MO_OK ? taken : error;
    flight = next;
  }
  return error;
}

/* Waits for the next block. Returns whether none arrived within QUIET_US. */
static bool is_quiet(struct window *window)
{
  const int64_t end_us = mo_clock_us() + QUIET_US;
  const struct timespec deadline = {.tv_sec = end_us / 1000000,
                                    .tv_nsec = (end_us % 1000000) * 1000};
  int status = 0;
  pthread_mutex_lock(&window->mutex);
  while (window->inbox.finished == NULL && status != ETIMEDOUT)
    status = pthread_cond_timedwait(&window->news, &window->mutex, &deadline);
  const bool quiet = window->inbox.finished == NULL;
  pthread_mutex_unlock(&window->mutex);
  return quiet;
}

/* Saves the results that arrived. A device returns thousands of designs within milliseconds, so
 * saving waits until it is quiet. Workers that compute what the device does not support return one
 * design after the other and may never be quiet, so saving waits at most SAVED_AFTER_US. */
static int save_what_came(struct window *window)
{
  const struct mo_scoring *scoring = window->scoring;
  const int64_t now_us = mo_clock_us();
  if (scoring->save == NULL || *scoring->n_unsaved == 0)
    return MO_OK;
  if (window->unsaved_us == 0)
    window->unsaved_us = now_us;
  if (scoring->grid.block.back_end == MO_ON_DEVICE &&
      now_us - window->unsaved_us < SAVED_AFTER_US && !is_quiet(window))
    return MO_OK;
  window->unsaved_us = 0;
  return scoring->save(scoring->context);
}

static void show(const struct window *window)
{
  const double passed_s = (double)(mo_clock_us() - window->begin_us) * 1e-6;
  if (window->scoring->show != NULL)
    window->scoring->show(window->scoring->context, passed_s >= 1e-6 * RATE_AFTER_US
                                                        ? (double)window->computed / passed_s
                                                        : 0);
}

static int compute(struct window *window)
{
  int error = MO_OK;
  for (;;) {
    int taken;
    if (error == MO_OK && mo_runner_is_interrupted(window->scoring->runner))
      error = MO_ERR_CANCELLED;
    if (error == MO_OK)
      fill(window);
    if (window->n_in_flight == 0)
      return error;
    if (error == MO_OK)
      error = save_what_came(window);
    taken = take_all(window);
    if (error == MO_OK)
      error = taken;
    show(window);
  }
}

int mo_score(struct mo_scoring *scoring)
{
  const struct mo_grid *grid = &scoring->grid;
  const uint32_t most = mo_back_end_window(scoring->runner->jobs, grid->block.back_end),
                 blocks = (grid->n_environments + MO_BLOCK_LANES - 1) / MO_BLOCK_LANES *
                          (grid->n_designs > 0 ? grid->n_designs : 1),
                 n = most < blocks ? most : blocks;
  struct window window = {.scoring = scoring, .begin_us = mo_clock_us()};
  pthread_condattr_t monotonic;
  int error = MO_ERR_NO_MEMORY;
  pthread_condattr_init(&monotonic);
  pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
  pthread_mutex_init(&window.mutex, NULL);
  pthread_cond_init(&window.news, &monotonic);
  pthread_condattr_destroy(&monotonic);
  window.inbox = (struct mo_inbox){.mutex = &window.mutex, .news = &window.news};
  window.flights = calloc(n, sizeof(*window.flights));
  for (uint32_t i = 0; i < n && window.flights != NULL; i++) {
    window.flights[i].next = window.free;
    window.free = &window.flights[i];
  }
  if (window.flights != NULL)
    error = compute(&window);
  free(window.flights);
  pthread_mutex_destroy(&window.mutex);
  pthread_cond_destroy(&window.news);
  return error;
}
