/* campaign_excluded.c: the bodies that a campaign's controller was pretrained on, which count as seen.
 *
 * A controller says in its metadata how it was made: a pretraining has a seed, a batch and a number of steps, and the bodies follow
 * from these; a finetuning, or a campaign, has a parent, whose own file says the same of it. The bodies of every pretraining on the
 * way up, as far as the store has the files, are drawn again into one set, on as many threads as there are workers, 16 at most, and with their
 * niceness. The set is const once it is made, and campaigns with the same lineage and workspace share it: the first one makes it, the
 * others wait. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "base/thread.h"
#include "jobs/campaign_run.h"

#define PARTS_MAX     16
#define ANCESTORS_MAX 64
#define WAIT_MS       50
#define THREADS_MAX   16

struct part {
  uint64_t seed, n_bodies;
};

enum state { MAKING = 0, READY, FAILED /* its maker gave up: nobody finds it any more */ };

struct mo_exclusion {
  struct mo_workspace workspace;
  struct part parts[PARTS_MAX];
  uint32_t n_parts;
  struct mo_form_set *forms;
  enum state state;
  uint32_t users;
  struct mo_exclusion *next;
};

const struct mo_form_set *mo_exclusion_forms(const struct mo_exclusion *exclusion)
{
  return exclusion != NULL ? exclusion->forms : NULL;
}

/* ---- the lineage ---- */

static bool read_number(const char *text, uint64_t *number)
{
  char *end = NULL;
  if (text == NULL || *text < '0' || *text > '9')
    return false;
  *number = strtoull(text, &end, 10);
  return *end == '\0' || *end == ',' || *end == '}';
}

/* What a controller was pretrained on; false: its metadata do not say so. */
static bool read_part(const struct mo_controller *controller, struct part *part)
{
  static const char key[] = "\"batch\":";
  const char *kind = mo_controller_get_metadata(controller, "morphod.kind");
  const char *settings = mo_controller_get_metadata(controller, "morphod.settings");
  const char *batch_text = settings != NULL ? strstr(settings, key) : NULL;
  uint64_t steps, batch;
  if (kind == NULL || strcmp(kind, "pretrain") != 0 || batch_text == NULL ||
      !read_number(batch_text + sizeof(key) - 1, &batch) ||
      !read_number(mo_controller_get_metadata(controller, "morphod.seed"), &part->seed) ||
      !read_number(mo_controller_get_metadata(controller, "morphod.step"), &steps) || steps == 0 || batch == 0)
    return false;
  part->n_bodies = steps <= MO_TRAINING_STEPS_MAX && batch <= MO_TRAINING_BATCH_MAX ? steps * batch : UINT64_MAX;
  return true;
}

static int add_part(struct mo_campaign_run *run, struct mo_exclusion *wanted, const struct mo_controller *controller)
{
  struct part part;
  char text[256];
  uint64_t most = MO_TRAINING_BODIES_MAX; /* of all parts together */
  if (!read_part(controller, &part))
    return MO_OK;
  for (uint32_t i = 0; i < wanted->n_parts; i++)
    most -= wanted->parts[i].n_bodies;
  if (part.n_bodies > most || wanted->n_parts == PARTS_MAX) {
    snprintf(text, sizeof(text),
             "the controller's lineage names more bodies of pretraining than the %" PRIu64
             " that can be drawn again: submit with exclude_pretraining false",
             MO_TRAINING_BODIES_MAX);
    return mo_attempt_fail(&run->attempt, MO_ERR_LIMIT, text);
  }
  wanted->parts[wanted->n_parts++] = part;
  return MO_OK;
}

/* An ancestor's file. MO_ERR_NOT_FOUND: the store has none. */
static int load_ancestor(struct mo_campaign_run *run, const struct mo_sha256 *sha256, struct mo_controller **controller)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = mo_store_controller_bytes(run->jobs->store, sha256, &bytes, &size);
  if (error == MO_OK)
    error = mo_controller_decode(bytes, size, controller, NULL);
  free(bytes);
  return error == MO_ERR_CORRUPT || error == MO_ERR_IO || error == MO_ERR_FORMAT
             ? mo_attempt_fail_controller(&run->attempt, error, sha256)
             : error;
}

static int read_lineage(struct mo_campaign_run *run, struct mo_exclusion *wanted)
{
  struct mo_controller *ancestor = NULL;
  const struct mo_controller *controller = run->controller;
  int error = MO_OK;
  for (int i = 0; i < ANCESTORS_MAX && controller != NULL && error == MO_OK; i++) {
    struct mo_controller *above = NULL;
    struct mo_sha256 sha256;
    const char *parent = mo_controller_get_metadata(controller, "morphod.parent");
    error = add_part(run, wanted, controller);
    if (error == MO_OK && parent != NULL && mo_sha256_from_hex(parent, strlen(parent), &sha256) == MO_OK)
      error = load_ancestor(run, &sha256, &above);
    mo_controller_free(ancestor);
    controller = ancestor = above;
  }
  mo_controller_free(ancestor);
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

/* ---- the sets ---- */

static bool is_same(const struct mo_exclusion *a, const struct mo_exclusion *b)
{
  if (a->state == FAILED || a->n_parts != b->n_parts || a->workspace.nx != b->workspace.nx ||
      a->workspace.ny != b->workspace.ny || a->workspace.nz != b->workspace.nz)
    return false;
  for (uint32_t i = 0; i < a->n_parts; i++)
    if (a->parts[i].seed != b->parts[i].seed || a->parts[i].n_bodies != b->parts[i].n_bodies)
      return false;
  return true;
}

static void free_exclusion(struct mo_exclusion *exclusion)
{
  mo_form_set_free(exclusion->forms);
  free(exclusion);
}

/* Takes out of the list what nobody uses. Under the mutex. */
static void drop(struct mo_jobs *jobs, struct mo_exclusion *exclusion)
{
  struct mo_exclusion **link = &jobs->exclusions;
  if (--exclusion->users > 0)
    return;
  while (*link != exclusion)
    link = &(*link)->next;
  *link = exclusion->next;
  free_exclusion(exclusion);
}

void mo_exclusion_release(struct mo_jobs *jobs, struct mo_exclusion *exclusion)
{
  if (exclusion == NULL)
    return;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  drop(jobs, exclusion);
  pthread_mutex_unlock(&jobs->exclusions_mutex);
}

struct drawing {
  struct mo_campaign_run *run;
  const struct part *part;
  struct mo_exclusion *made;
  uint32_t n_threads;
  int error;
};

static void draw(struct drawing *drawing)
{
  struct mo_runner *runner = drawing->run->attempt.runner;
  drawing->error =
      mo_pretraining_forms(drawing->part->seed, drawing->part->n_bodies, drawing->made->workspace, drawing->n_threads,
                           &runner->interrupt, &runner->replayed, drawing->made->forms);
}

static void *draw_nicely(void *context)
{
  struct drawing *drawing = context;
  mo_thread_tag = drawing->run->id;
  mo_compute_settle(drawing->run->jobs->compute);
  draw(drawing);
  return NULL;
}

/* On a thread of its own, because niceness is not for coming back from; without one, alone on this one. */
static int draw_part(struct mo_campaign_run *run, const struct part *part, struct mo_exclusion *made)
{
  struct drawing drawing = {.run = run, .part = part, .made = made};
  struct mo_compute_stats stats;
  pthread_t thread;
  mo_compute_get_stats(run->jobs->compute, &stats);
  drawing.n_threads = stats.n_workers < THREADS_MAX ? stats.n_workers : THREADS_MAX;
  if (mo_thread_create(&thread, NULL, draw_nicely, &drawing) == 0) {
    pthread_join(thread, NULL);
  } else {
    drawing.n_threads = 1;
    draw(&drawing);
  }
  return drawing.error;
}

static int draw_forms(struct mo_campaign_run *run, struct mo_exclusion *made)
{
  struct mo_runner *runner = run->attempt.runner;
  uint64_t total = 0, drawn = 0;
  int error = mo_form_set_create(made->workspace, &made->forms);
  for (uint32_t i = 0; i < made->n_parts; i++)
    total += made->parts[i].n_bodies;
  (void)mo_campaign_enter(run, MO_CAMPAIGN_PREPARE, total);
  for (uint32_t i = 0; i < made->n_parts && error == MO_OK; i++) {
    error = draw_part(run, &made->parts[i], made);
    drawn += made->parts[i].n_bodies;
    __atomic_store_n(&runner->replayed, 0, __ATOMIC_RELAXED);
    mo_campaign_advance(run, drawn);
  }
  return error;
}

/* The set of that lineage, with one user more, or `mine` put into the list for this run to fill (*is_mine). */
static struct mo_exclusion *find_or_add(struct mo_jobs *jobs, struct mo_exclusion *mine, bool *is_mine)
{
  struct mo_exclusion *found;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  for (found = jobs->exclusions; found != NULL; found = found->next)
    if (is_same(found, mine))
      break;
  *is_mine = found == NULL;
  if (found == NULL) {
    found = mine;
    mine->next = jobs->exclusions;
    jobs->exclusions = mine;
  }
  found->users++;
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  return found;
}

static enum state look(struct mo_jobs *jobs, const struct mo_exclusion *exclusion)
{
  enum state state;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  state = exclusion->state;
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  return state;
}

static int fill(struct mo_campaign_run *run, struct mo_exclusion *mine)
{
  struct mo_jobs *jobs = run->jobs;
  int error = draw_forms(run, mine);
  pthread_mutex_lock(&jobs->exclusions_mutex);
  mine->state = error == MO_OK ? READY : FAILED;
  if (error != MO_OK)
    drop(jobs, mine);
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  return error;
}

int mo_exclusion_acquire(struct mo_campaign_run *run, struct mo_exclusion **exclusion)
{
  struct mo_exclusion wanted = {.workspace = run->status.record.settings.workspace};
  int error = read_lineage(run, &wanted);
  *exclusion = NULL;
  while (error == MO_OK && wanted.n_parts > 0) {
    struct mo_exclusion *mine = malloc(sizeof(*mine)), *found;
    enum state state = MAKING;
    bool is_mine;
    if (mine == NULL)
      return MO_ERR_NO_MEMORY;
    *mine = wanted;
    found = find_or_add(run->jobs, mine, &is_mine);
    if (is_mine) {
      error = fill(run, mine);
      *exclusion = error == MO_OK ? mine : NULL;
      return error;
    }
    free(mine);
    while (state == MAKING && error == MO_OK) {
      state = look(run->jobs, found);
      if (state == MAKING)
        mo_runner_sleep(run->attempt.runner, WAIT_MS, MO_WISH_PAUSE);
      if (mo_runner_is_interrupted(run->attempt.runner))
        error = MO_ERR_CANCELLED;
    }
    if (error == MO_OK && state == READY) {
      *exclusion = found;
      return MO_OK;
    }
    mo_exclusion_release(run->jobs, found);
  }
  return error;
}
