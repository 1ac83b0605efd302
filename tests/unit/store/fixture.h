/* fixture.h: a separate state folder for each case, its store, and small requests. */
#ifndef MORPHO_TESTS_STORE_FIXTURE_H
#define MORPHO_TESTS_STORE_FIXTURE_H

#include <ftw.h>
#include <stdarg.h>
#include <unistd.h>

#include "../make.h"

#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/runner.h"
#include "store/trainings.h"

static struct {
  char path[256];
  struct mo_message message; /* from the last opening, check or refused request */
} fixture;
static struct mo_store *store; /* in the fixture's folder; NULL if closed */

static inline int fixture_remove_entry(const char *path, const struct stat *status, int kind,
                                       struct FTW *place)
{
  (void)status;
  (void)kind;
  (void)place;
  return remove(path);
}

static inline void fixture_remove(const char *path)
{
  (void)nftw(path, fixture_remove_entry, 16, FTW_DEPTH | FTW_PHYS);
}

static inline int fixture_folder(void)
{
  const char *base = getenv("TMPDIR");
  store = NULL;
  snprintf(fixture.path, sizeof(fixture.path), "%s/morpho-store-XXXXXX",
           base != NULL ? base : "/tmp");
  return mkdtemp(fixture.path) != NULL ? 0 : -1;
}

/* Returns the path of a file in the state folder. The next call overwrites it. */
__attribute__((format(printf, 1, 2))) static inline const char *path_of(const char *format, ...)
{
  static char path[512];
  const int n = snprintf(path, sizeof(path), "%s/", fixture.path);
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(path + n, sizeof(path) - (size_t)n, format, arguments);
  va_end(arguments);
  return path;
}

/* Overwrites bytes at an offset of an existing file. */
static inline int overwrite(const char *path, long at, const void *bytes, size_t n)
{
  FILE *file = fopen(path, "r+");
  return file != NULL && fseek(file, at, SEEK_SET) == 0 && fwrite(bytes, 1, n, file) == n &&
                 fclose(file) == 0
             ? 0
             : -1;
}

static inline void close_store(void)
{
  mo_store_close(store);
  store = NULL;
}

static inline int reopen_with(struct mo_store_config config)
{
  close_store();
  config.path = fixture.path;
  return mo_store_open(&config, &store, &fixture.message);
}

static inline int reopen(void)
{
  return reopen_with((struct mo_store_config){.path = NULL});
}

static inline void fixture_end(void)
{
  close_store();
  fixture_remove(fixture.path);
}

static inline int check_whole(void)
{
  return mo_store_check(store, &fixture.message);
}

/* Draws weights from a seed and encodes them. */
static inline int draw_weights(uint64_t seed, struct mo_controller **controller, uint8_t **bytes,
                               size_t *size)
{
  int error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, controller);
  if (error == MO_OK) {
    mo_controller_randomize(*controller, seed);
    error = mo_controller_set_metadata(*controller, "note", "a \"quoted\"\n\\ \xc3\xa9 note");
  }
  return error == MO_OK ? mo_controller_encode(*controller, bytes, size) : error;
}

/* Stores such weights under a name. record: nullable. */
static inline int put_weights(const char *name, uint64_t seed, struct mo_controller_record *record)
{
  struct mo_controller_record stored;
  struct mo_controller *controller = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool created;
  int error = draw_weights(seed, &controller, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_controller_put(store, name, bytes, size, controller,
                                    record != NULL ? record : &stored, &created);
  free(bytes);
  mo_controller_free(controller);
  return error;
}

static inline int fixture_start(void)
{
  int error = fixture_folder();
  if (error == 0)
    error = reopen();
  return error == MO_OK ? put_weights("default", 1, NULL) : error;
}

/* Returns distinct placed bodies, with their canonical forms (nullable). */
static inline struct mo_bits *make_bodies(uint64_t seed, uint32_t n, struct mo_bits **forms)
{
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, seed);
  struct mo_bits *genotypes = make_zeros(n, sizeof(*genotypes)), form;
  if (forms != NULL)
    *forms = make_zeros(n, sizeof(**forms));
  for (uint32_t i = 0; i < n; i++) {
    make_check(mo_body_stream_next(stream, genotypes[i].words, NULL), "a body");
    mo_genotype_place(MO_DEFAULT_WORKSPACE, genotypes[i].words);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, genotypes[i].words, form.words);
    if (forms != NULL)
      (*forms)[i] = form;
  }
  return genotypes;
}

static inline struct mo_evaluation_request
fixture_submission(const struct mo_bits *forms, const struct mo_bits *genotypes, uint32_t n)
{
  return (struct mo_evaluation_request){.forms = forms,
                                        .genotypes = genotypes,
                                        .n_designs = n,
                                        .environment_set = "paper-test",
                                        .controller = "default",
                                        .physics = mo_paper_physics(),
                                        .precision = MO_FLOAT32,
                                        .record_stride = 10};
}

/* Adds a loss of design n to the last block of a save, or to a new one. */
static inline void fixture_loss(struct mo_save *save, const struct mo_work *work, uint32_t n,
                                uint32_t k, int64_t fingerprint, double loss, int32_t step)
{
  struct mo_saved_block *block = save->blocks + save->n_blocks;
  if (save->n_blocks > 0 && block[-1].genotype == work->genotype_rows[n] &&
      block[-1].condition.n < MO_BLOCK_LANES) {
    block--;
  } else {
    *block = (struct mo_saved_block){.genotype = work->genotype_rows[n],
                                     .condition = {.controller = work->controller,
                                                   .physics = work->physics_rows[0],
                                                   .fingerprint = fingerprint},
                                     .verify_job = work->job.verify ? work->job.id : 0,
                                     .design_position = work->positions[n]};
    save->n_blocks++;
  }
  const uint32_t i = block->condition.n++;
  block->condition.environments[i] = work->environment_rows[k];
  block->places[i] = (uint8_t)k;
  block->losses[i] = loss;
  block->diverged_steps[i] = (uint32_t)step;
}

/* Returns learning settings that all differ from their defaults. */
static inline struct mo_learning fixture_learning(void)
{
  return (struct mo_learning){
      .schedule = {.kind = MO_SCHEDULE_RESTARTS,
                   .peak = 1e-3,
                   .floor = 1e-5,
                   .decay = 0.65,
                   .cycle_steps = 10,
                   .cycle_growth = 2,
                   .warmup_steps = 3},
      .beta1 = 0.9,
      .beta2 = 0.999,
      .epsilon = 1e-8,
      .norm_limit = 1,
      .gradient = {.adjoint_bound = 2, .adjoint_rule = MO_ADJOINT_RESTART, .restart_weight = 2.5},
      .vary = {true, {0.9, 1.1}, {0.8, 1.2}, {1, 1}, {0.7, 1}, {1, 1.5}, {0.5, 1.25}}};
}

/* The classes of a process that has only one. */
static inline const struct mo_classes *fixture_classes(int64_t fingerprint)
{
  static _Thread_local struct mo_classes classes;
  classes = (struct mo_classes){{fingerprint, fingerprint}, fingerprint};
  return &classes;
}

/* Reads the newest checkpoint of the newest generation that has checkpoints. */
static inline int newest_checkpoint(struct mo_store *of, int64_t id, uint32_t *generation,
                                    uint32_t *step, uint8_t **bytes, size_t *size)
{
  struct mo_checkpoint_row row;
  const int64_t n = mo_store_checkpoints(of, id, &row, 1);
  if (n <= 0)
    return n < 0 ? (int)n : MO_ERR_NOT_FOUND;
  *generation = row.generation;
  return mo_store_campaign_checkpoint_of(of, id, row.generation, step, bytes, size);
}

#endif
