/* fixture.h: a state folder of its own for every case, and small submissions. */
#ifndef MORPHO_TESTS_STORE_FIXTURE_H
#define MORPHO_TESTS_STORE_FIXTURE_H

#include <ftw.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/runner.h"

struct fixture {
  char path[256];
  struct mo_store *store;
  struct mo_message message;
  struct mo_bits *forms, *genotypes; /* of fixture_evaluation */
};

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

static inline int fixture_folder(struct fixture *fixture)
{
  const char *base = getenv("TMPDIR");
  memset(fixture, 0, sizeof(*fixture));
  snprintf(fixture->path, sizeof(fixture->path), "%s/morpho-store-XXXXXX",
           base != NULL ? base : "/tmp");
  return mkdtemp(fixture->path) != NULL ? 0 : -1;
}

static inline int fixture_reopen(struct fixture *fixture)
{
  struct mo_store_config config = {.path = fixture->path};
  mo_store_close(fixture->store);
  fixture->store = NULL;
  return mo_store_open(&config, &fixture->store, &fixture->message);
}

static inline void fixture_end(struct fixture *fixture)
{
  mo_store_close(fixture->store);
  fixture_remove(fixture->path);
  free(fixture->forms);
  free(fixture->genotypes);
}

static inline void fixture_close(struct fixture *fixture)
{
  mo_store_close(fixture->store);
  fixture->store = NULL;
}

/* Weights drawn from a seed, stored under a name. */
static inline int fixture_controller(struct mo_store *store, const char *name, uint64_t seed,
                                     struct mo_controller_record *record)
{
  struct mo_controller *controller = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool created;
  int error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller);
  if (error == MO_OK) {
    mo_controller_randomize(controller, seed);
    error = mo_controller_set_metadata(controller, "note", "a \"quoted\"\n\\ \xc3\xa9 note");
  }
  if (error == MO_OK) {
    error = mo_controller_encode(controller, &bytes, &size);
  }
  if (error == MO_OK)
    error = mo_store_controller_put(store, name, bytes, size, controller, record, &created);
  free(bytes);
  mo_controller_free(controller);
  return error;
}

static inline int fixture_start(struct fixture *fixture)
{
  struct mo_controller_record record;
  int error = fixture_folder(fixture);
  if (error == 0)
    error = fixture_reopen(fixture);
  if (error == MO_OK)
    error = fixture_controller(fixture->store, "default", 1, &record);
  return error;
}

/* Distinct bodies, placed, with their canonical forms. Caller frees both. */
static inline int fixture_bodies(uint64_t seed, uint32_t n, struct mo_bits **forms,
                                 struct mo_bits **genotypes)
{
  struct mo_body_stream *stream = NULL;
  int error = mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &stream);
  *forms = calloc(n, sizeof(**forms));
  *genotypes = calloc(n, sizeof(**genotypes));
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    error = mo_body_stream_next(stream, (*genotypes)[i].words, NULL);
    if (error == MO_OK) {
      mo_genotype_place(MO_DEFAULT_WORKSPACE, (*genotypes)[i].words);
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, (*genotypes)[i].words, (*forms)[i].words);
    }
  }
  mo_body_stream_free(stream);
  return error;
}

static inline struct mo_submission fixture_submission(const struct mo_bits *forms,
                                                      const struct mo_bits *genotypes, uint32_t n)
{
  return (struct mo_submission){.forms = forms,
                                .genotypes = genotypes,
                                .n_designs = n,
                                .environment_set = "paper-test",
                                .controller = "default",
                                .physics = mo_default_physics(),
                                .precision = MO_FLOAT32,
                                .priority = MO_BATCH,
                                .record_stride = 10};
}

/* Settings of learning, each with another value than its default. */
static inline struct mo_learning fixture_learning(void)
{
  return (struct mo_learning){.schedule = {.kind = MO_SCHEDULE_RESTARTS,
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
                              .adjoint_bound = 2,
                              .adjoint_rule = MO_ADJOINT_RESTART,
                              .restart_weight = 2.5};
}

/* The classes of a process that has but one. */
static inline const struct mo_classes *fixture_classes(int64_t fingerprint)
{
  static _Thread_local struct mo_classes classes;
  classes = (struct mo_classes){{fingerprint, fingerprint}, fingerprint};
  return &classes;
}

/* Reads the newest checkpoint of the newest generation that has one. */
static inline int fixture_campaign_checkpoint(struct mo_store *store, int64_t id,
                                              uint32_t *generation, uint32_t *step, uint8_t **bytes,
                                              size_t *size)
{
  struct mo_checkpoint_row row;
  const int64_t n = mo_store_checkpoints(store, id, &row, 1);
  if (n <= 0)
    return n < 0 ? (int)n : MO_ERR_NOT_FOUND;
  *generation = row.generation;
  return mo_store_campaign_checkpoint_of(store, id, row.generation, step, bytes, size);
}

#endif
