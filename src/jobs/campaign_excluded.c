/* campaign_excluded.c: the bodies of a controller's pretraining runs, which a campaign must not
 * create.
 *
 * The bodies of all pretraining runs in the controller's lineage (campaign_lineage.c) are redrawn
 * into one set, on as many threads as there are workers, at most 16, and with the workers'
 * niceness. The set is then written to a file in the state folder (store/excluded.h) and used from
 * there. Later campaigns find the file. A finished set is const. Campaigns with the same lineage
 * and workspace share it. A separate thread opens or draws the set. The first campaign starts that
 * thread; later ones wait for it. The drawing continues when a campaign is paused or cancelled, and
 * stops when the last campaign leaves. If a file is damaged or cannot be written, the bodies are
 * simply redrawn, with a warning in the log. */
#include <malloc.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/campaign_excluded.h"
#include "morphospace/form_file.h"
#include "morphospace/form_set.h"
#include "store/excluded.h"

#define WAIT_MS_MAX 50
#define THREADS_MAX 16

#define DRAWING 1

struct mo_exclusion {
  struct mo_jobs *jobs;
  struct mo_workspace workspace;
  struct mo_lineage lineage;
  uint64_t n_bodies; /* of all parts */
  int64_t first;     /* the campaign that started the drawing, and its controller */
  struct mo_sha256 controller;
  int64_t begin_us;
  struct mo_form_set *forms;
  pthread_t thread;
  bool has_thread;
  volatile int cancel;
  volatile uint64_t n_drawn; /* of the current part */
  /* Under the mutex. */
  uint32_t users;
  int64_t drawer;    /* the campaign for which other campaigns report to be waiting; 0: it has left,
                      * and the next campaign that checks replaces it */
  uint64_t n_before; /* bodies of finished parts */
  int status;        /* DRAWING, MO_OK, or the error that look-ups return */
  struct mo_exclusion *next;
};

/* ---- files ---- */

/* Lists everything that the set depends on except for the workspace, which the file contains.
 * Returns the number that identifies the file. */
static uint64_t key_of(const struct mo_exclusion *exclusion, struct mo_form_key *key)
{
  const struct mo_lineage *lineage = &exclusion->lineage;
  const uint32_t version = MO_PRETRAINING_FORMS_VERSION;
  const struct mo_workspace *sides = &exclusion->workspace;
  _Static_assert(sizeof(version) + sizeof(lineage->parts) <= MO_FORM_KEY_MAX, "a key has no room");
  *key = (struct mo_form_key){.n = sizeof(version) + lineage->n_parts * sizeof(*lineage->parts)};
  memcpy(key->bytes, &version, sizeof(version));
  memcpy(key->bytes + sizeof(version), lineage->parts, key->n - sizeof(version));
  return mo_form_hash(key->bytes, key->n) ^
         ((uint64_t)sides->nx << 32 | (uint64_t)sides->ny << 16 | sides->nz);
}

static void warn(const struct mo_exclusion *exclusion, int error, const char *text)
{
  const struct mo_jobs_config *config = &exclusion->jobs->config;
  if (config->warn != NULL)
    config->warn(config->warn_context, exclusion->first, error, text);
}

static uint32_t threads_of(const struct mo_exclusion *exclusion)
{
  struct mo_compute_stats stats;
  mo_compute_get_stats(exclusion->jobs->compute, &stats);
  return stats.n_workers < THREADS_MAX ? stats.n_workers : THREADS_MAX;
}

/* Opens the file of the set. On any error, no usable file exists. */
static int open_file(const struct mo_exclusion *exclusion, struct mo_form_set **forms)
{
  struct mo_form_key key;
  struct mo_store *store = exclusion->jobs->store;
  const uint64_t name = key_of(exclusion, &key);
  const int fd = mo_store_excluded_open(store, name);
  if (fd < 0)
    return fd;
  const int error = mo_form_file_map(fd, exclusion->workspace, &key, threads_of(exclusion), forms);
  close(fd);
  if (error == MO_ERR_CORRUPT || error == MO_ERR_IO)
    mo_store_excluded_remove(store, name);
  return error;
}

struct file_of_forms {
  const struct mo_form_set *forms;
  const struct mo_form_key *key;
};

static int make_file(void *context, int (*put)(void *file, const void *bytes, size_t size),
                     void *file)
{
  const struct file_of_forms *made = context;
  return mo_form_file_write(made->forms, made->key, put, file);
}

/* Writes the drawn set to a file and uses it from there, which frees its memory. */
static void keep(struct mo_exclusion *exclusion)
{
  struct mo_form_key key;
  const uint64_t name = key_of(exclusion, &key);
  struct mo_form_set *kept = NULL;
  struct file_of_forms made = {exclusion->forms, &key};
  int error = mo_store_excluded_write(exclusion->jobs->store, &exclusion->controller, name,
                                      mo_form_file_bytes(exclusion->forms), &exclusion->cancel,
                                      make_file, &made);
  if (error == MO_OK)
    error = open_file(exclusion, &kept);
  if (error == MO_OK) {
    mo_form_set_free(exclusion->forms);
    exclusion->forms = kept;
    (void)malloc_trim(0);
  } else if (error == MO_ERR_LIMIT) {
    warn(exclusion, error,
         "the controller's pretraining bodies exceed max_excluded and are not kept; "
         "each campaign redraws them");
  } else if (error != MO_ERR_CANCELLED && error != MO_ERR_UNSUPPORTED) {
    warn(
        exclusion, error,
        "the controller's pretraining bodies cannot be kept in the state folder; the next campaign "
        "will redraw them");
  }
}

/* ---- drawing ---- */

static void end_part(struct mo_exclusion *exclusion, uint64_t n_bodies)
{
  MO_GUARD(&exclusion->jobs->exclusions_mutex);
  exclusion->n_before += n_bodies;
  __atomic_store_n(&exclusion->n_drawn, 0, __ATOMIC_RELAXED);
}

static void end(struct mo_exclusion *exclusion, int error)
{
  MO_GUARD(&exclusion->jobs->exclusions_mutex);
  exclusion->status = error;
}

static int draw(struct mo_exclusion *exclusion)
{
  int error = mo_form_set_create(exclusion->workspace, &exclusion->forms);
  for (uint32_t i = 0; i < exclusion->lineage.n_parts && error == MO_OK; i++) {
    const struct mo_lineage_part *part = &exclusion->lineage.parts[i];
    error = mo_pretraining_forms(part->seed, part->n_bodies, exclusion->workspace,
                                 threads_of(exclusion), &exclusion->cancel, &exclusion->n_drawn,
                                 exclusion->forms);
    if (error == MO_OK)
      end_part(exclusion, part->n_bodies);
  }
  if (error == MO_OK)
    keep(exclusion);
  return error;
}

static void *open_or_draw(void *context)
{
  struct mo_exclusion *exclusion = context;
  /* A crash is charged to this campaign, even after it has left. */
  mo_thread_tag = exclusion->first;
  mo_compute_lower_priority(exclusion->jobs->compute);
  int error = open_file(exclusion, &exclusion->forms);
  if (error != MO_OK) {
    if (error != MO_ERR_NOT_FOUND)
      warn(exclusion, error,
           error == MO_ERR_CORRUPT ? "the file with the controller's pretraining bodies is "
                                     "damaged; redrawing them"
                                   : "the file with the controller's pretraining bodies "
                                     "cannot be read; redrawing them");
    error = draw(exclusion);
  }
  end(exclusion, error);
  return NULL;
}

/* Starts the drawing. If the thread cannot be started, the campaigns that are waiting for it retry
 * later. */
static void begin(struct mo_exclusion *exclusion)
{
  exclusion->has_thread = mo_thread_create(&exclusion->thread, NULL, open_or_draw, exclusion) == 0;
  if (!exclusion->has_thread)
    end(exclusion, MO_ERR_NO_MEMORY);
}

/* ---- the sets ---- */

static bool is_of(const struct mo_exclusion *exclusion, const struct mo_lineage *lineage,
                  struct mo_workspace workspace)
{
  const struct mo_lineage *own = &exclusion->lineage;
  return exclusion->status >= 0 && own->n_parts == lineage->n_parts &&
         memcmp(own->parts, lineage->parts, own->n_parts * sizeof(*own->parts)) == 0 &&
         mo_workspace_equal(exclusion->workspace, workspace);
}

/* Returns the set of the lineage with one more user, or adds a new one to the list, which the
 * caller must start (*is_new). Returns NULL if memory runs out. */
static struct mo_exclusion *find_or_add(struct mo_campaign_run *run,
                                        const struct mo_lineage *lineage, bool *is_new)
{
  struct mo_jobs *jobs = run->jobs;
  MO_GUARD(&jobs->exclusions_mutex);
  struct mo_exclusion *found = jobs->exclusions;
  while (found != NULL && !is_of(found, lineage, run->settings->workspace))
    found = found->next;
  *is_new = found == NULL;
  if (found == NULL && (found = calloc(1, sizeof(*found))) != NULL) {
    *found = (struct mo_exclusion){.jobs = jobs,
                                   .workspace = run->settings->workspace,
                                   .status = DRAWING,
                                   .lineage = *lineage,
                                   .first = run->id,
                                   .controller = run->status.job.controller_sha256,
                                   .drawer = run->id,
                                   .begin_us = mo_clock_us(),
                                   .next = jobs->exclusions};
    for (uint32_t i = 0; i < lineage->n_parts; i++)
      found->n_bodies += lineage->parts[i].n_bodies;
    jobs->exclusions = found;
  }
  if (found != NULL)
    found->users++;
  return found;
}

/* Under the mutex. */
static void take_out(struct mo_jobs *jobs, const struct mo_exclusion *exclusion)
{
  struct mo_exclusion **link = &jobs->exclusions;
  while (*link != exclusion)
    link = &(*link)->next;
  *link = exclusion->next;
}

void mo_exclusion_release(struct mo_campaign_run *run)
{
  struct mo_jobs *jobs = run->jobs;
  struct mo_exclusion *exclusion = run->exclusion;
  if (exclusion == NULL)
    return;
  run->exclusion = NULL;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  if (exclusion->drawer == run->id)
    exclusion->drawer = 0;
  bool is_last = --exclusion->users == 0;
  if (is_last)
    take_out(jobs, exclusion);
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  if (!is_last)
    return;
  __atomic_store_n(&exclusion->cancel, 1, __ATOMIC_RELAXED);
  if (exclusion->has_thread)
    pthread_join(exclusion->thread, NULL);
  mo_form_set_free(exclusion->forms);
  free(exclusion);
}

/* ---- waiting ---- */

/* Estimates the time for all remaining generations from that of the newest one; 0: unknown. */
static double generations_s(const struct mo_campaign_run *run)
{
  const uint32_t generations = run->settings->generations;
  return run->generation <= generations
             ? (generations - run->generation + 1.0) * run->times.generation_s
             : 0;
}

/* Shows the progress of the drawing. seconds_left < 0: not known yet. */
static void show(struct mo_campaign_run *run, uint64_t done, uint64_t total, int64_t drawer,
                 double seconds_left)
{
  struct mo_live *live = &run->runner->live;
  MO_GUARD(&run->runner->runners->mutex);
  live->done = done;
  live->total = total;
  live->seconds_left = seconds_left < 0 ? -1 : seconds_left + generations_s(run);
  live->reason[0] = '\0';
  if (drawer != run->id)
    snprintf(live->reason, sizeof(live->reason),
             "waiting for campaign %lld, which is redrawing the bodies that the controller was "
             "pretrained on",
             (long long)drawer);
}

/* Waits for the end of the drawing, or for a request. */
static int await(struct mo_campaign_run *run, struct mo_exclusion *exclusion)
{
  for (uint32_t ms = 1;; ms = 2 * ms < WAIT_MS_MAX ? 2 * ms : WAIT_MS_MAX) {
    pthread_mutex_lock(&run->jobs->exclusions_mutex);
    if (exclusion->drawer == 0)
      exclusion->drawer = run->id;
    const uint64_t done =
        exclusion->n_before + __atomic_load_n(&exclusion->n_drawn, __ATOMIC_RELAXED);
    const int64_t drawer = exclusion->drawer;
    const int status = exclusion->status;
    pthread_mutex_unlock(&run->jobs->exclusions_mutex);
    if (status != DRAWING)
      return status;
    if (mo_runner_is_interrupted(run->runner))
      return MO_ERR_CANCELLED;
    /* All bodies take about the same time to draw: after the first second, the rate changes by only
     * a few percent within a minute. */
    const double passed_s = (double)(mo_clock_us() - exclusion->begin_us) * 1e-6;
    show(run, done, exclusion->n_bodies, drawer,
         done > 0 ? passed_s / (double)done * (double)(exclusion->n_bodies - done) : -1);
    const int error = mo_campaign_report(run);
    if (error != MO_OK)
      return error;
    mo_runner_sleep(run->runner, ms, MO_REQUEST_PAUSE);
  }
}

static int join(struct mo_campaign_run *run, const struct mo_lineage *lineage)
{
  bool is_new;
  run->exclusion = find_or_add(run, lineage, &is_new);
  if (run->exclusion == NULL)
    return MO_ERR_NO_MEMORY;
  mo_campaign_enter(run, MO_PHASE_PREPARE, run->exclusion->n_bodies);
  if (is_new)
    begin(run->exclusion);
  const int error = await(run, run->exclusion);
  if (error != MO_OK)
    mo_exclusion_release(run);
  show(run, 0, 0, run->id, generations_s(run) > 0 ? 0 : -1);
  return error;
}

int mo_exclusion_acquire(struct mo_campaign_run *run, const struct mo_form_set **forms)
{
  struct mo_message message = {""};
  struct mo_lineage lineage = {.n_parts = 0};
  int error = MO_OK;
  if (run->controller != NULL)
    error = mo_lineage_read(run->jobs, &run->status.job.controller_sha256, run, &lineage, &message);
  if (error == MO_ERR_LIMIT)
    return mo_runner_fail(run->runner, error, message.text);
  if (error != MO_OK || lineage.n_parts == 0)
    return error;
  error = join(run, &lineage);
  /* Returned unchanged, this error would end the campaign as if no child could be found. */
  if (error == MO_ERR_EXHAUSTED)
    return mo_runner_fail(run->runner, MO_ERR_LIMIT,
                          "the controller's lineage has more pretraining bodies than can be "
                          "redrawn; submit with exclude_pretraining false");
  if (error == MO_OK)
    *forms = run->exclusion->forms;
  return error;
}
