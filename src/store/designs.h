/* designs.h: designs and their scores. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_DESIGNS_H
#define MORPHO_STORE_DESIGNS_H

#include "store/records.h"

/* A row of a page of designs. */
struct mo_design_row {
  int64_t row;             /* cursor of sort=id */
  struct mo_genotype form; /* canonical */
  int64_t first_seen_us;
  struct mo_genotype genotype; /* sort=score: the scored genotype, oriented and placed */
  double score; /* sort=score: mean loss; +infinity: a rollout diverged. NaN with other sorts */
  int64_t genotype_row; /* sort=score: with score, the cursor */
};

/* The score of one oriented genotype under one setting: over an entire named set, or in one
 * environment outside any set. */
struct mo_design_score {
  struct mo_sha256 controller_sha256, physics_sha256;
  enum mo_precision precision;
  enum mo_sensor sensor;
  char environment_set[MO_NAME_BYTES_MAX + 1]; /* "": one environment, identified by its hash */
  struct mo_sha256 environment_sha256;         /* if environment_set is "" */
  uint32_t n_losses;
  double losses[MO_ENVIRONMENTS_MAX]; /* NaN: not computed yet */
  int32_t diverged_steps[MO_ENVIRONMENTS_MAX];
  int64_t computed_us;                    /* when the newest rollout was computed */
  char fingerprint[MO_FINGERPRINT_BYTES]; /* its class */
  char origin[MO_ORIGIN_BYTES];           /* the host that computed the newest rollout */
};

struct mo_design_orientation {
  struct mo_genotype genotype; /* placed */
  uint32_t n_scores;
  struct mo_design_score *scores; /* (n_scores) */
};

struct mo_design {
  struct mo_genotype form; /* canonical */
  int64_t first_seen_us;
  uint32_t n_orientations;
  struct mo_design_orientation *orientations; /* (n_orientations) in order of first appearance */
  bool truncated; /* more than 1000 rollouts are stored; the first 1000 are reported */
};
void mo_design_free(void *design); /* NULL-safe */

struct mo_store;

int mo_store_design(struct mo_store *store, const struct mo_genotype *form,
                    struct mo_design **design); /* MO_ERR_NOT_FOUND */

enum mo_design_sort {
  MO_DESIGNS_BY_ID = 0 /* in order of first appearance */,
  MO_DESIGNS_BY_SCORE = 1 /* best first */
};
struct mo_design_query {
  enum mo_design_sort sort;
  bool is_descending; /* by id: newest first; by score: worst first, diverged ones before all
                         others */
  int64_t after_row;  /* by id: the last row; by score: the last genotype_row; 0: from the first */
  double after_score; /* by score, with after_row: the last score */
  /* by score: the setting of the scores (designs without such a score are left out) */
  struct mo_sha256 controller_sha256;
  char environment_set[MO_NAME_BYTES_MAX + 1];
  struct mo_physics physics;
  enum mo_precision precision;
  char fingerprint[MO_FINGERPRINT_BYTES]; /* the class of the scores */
};
int64_t mo_store_designs(struct mo_store *store, const struct mo_design_query *query,
                         struct mo_design_row *rows, size_t limit);

/* Reads the designs of a job, in order (malloc): those listed in the request. For a campaign, the
 * initial ones: record.n_listed listed ones, or the designs of initial_campaign's newest population
 * that fit the campaign's workspace, best first, up to the size of the population.
 * MO_ERR_NOT_FOUND. */
int mo_store_job_designs(struct mo_store *store, int64_t id, struct mo_bits **genotypes,
                         uint32_t *n);
/* Reads the notes about the designs of a job's request, ascending (malloc; NULL if there are
 * none). */
int mo_store_design_notes(struct mo_store *store, int64_t id, struct mo_design_note **notes,
                          uint32_t *n);

/* ---- the orientation of designs given as ids ---- */

/* Returns whether a placed genotype fits a workspace, which is not larger than its own, without
 * being turned. mo_genotype_move also turns bodies, which then have different scores. */
bool mo_fits_as_it_is(struct mo_workspace workspace, const struct mo_genotype *genotype);
/* The conditions of a score, except for the body. */
struct mo_orienting {
  const char *controller;                    /* name or "sha256:…"; NULL: random weights */
  const char *environment_set;               /* NULL: `environments` */
  const struct mo_environment *environments; /* (n_environments) */
  uint32_t n_environments;
  const struct mo_physics *physics;
  enum mo_precision precision;
  int64_t fingerprint,
      workers; /* its class; and the class of bodies that devices leave to the workers */
  struct mo_workspace workspace; /* which the orientation must fit without being turned */
};
/* For each design that was given as an id without an orientation, according to its note (the
 * genotype is canonical), chooses the orientation with the best stored score, which is the mean
 * loss over all environments. Diverged scores rank last; ties go to the first orientation. Without
 * any score, the genotype stays unchanged. Completes these notes. */
int mo_store_orient(struct mo_store *store, const struct mo_orienting *under,
                    struct mo_bits *genotypes, uint32_t n, struct mo_design_note *notes,
                    uint32_t n_notes);

#endif
