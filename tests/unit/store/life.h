/* life.h: the life of a state folder on a disk whose power fails: what is asked of the store, and
 * what it has promised.
 *
 * The model is what was acknowledged. An act in doubt, whose call had not returned when everything
 * stopped, is there wholly or not at all; one that saves several things in a row may have come
 * through some of them. */
#ifndef MORPHO_TESTS_STORE_LIFE_H
#define MORPHO_TESTS_STORE_LIFE_H

#include "disk.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/runner.h"
#include "store/trainings.h"

enum {
  NAMES = 4,
  CONTENTS_MAX = 160,
  EVALUATIONS_MAX = 60,
  DESIGNS_MAX = 5, /* of an evaluation */
  CAMPAIGNS_MAX = 4,
  GENERATIONS_MAX = 12,
  MEMBERS = 4,  /* of a population; as many are born in each generation */
  LEARNING = 4, /* steps in each */
  LISTED = 3,   /* designs that a campaign begins with */
  BODIES_OF_CAMPAIGNS = EVALUATIONS_MAX * DESIGNS_MAX,
  BODIES = BODIES_OF_CAMPAIGNS + CAMPAIGNS_MAX * GENERATIONS_MAX * MEMBERS,
  TRAININGS_MAX = 20,
  KEPT_MAX = 3
};

struct evaluation_model { /* its id is `id`; its designs are bodies from index · DESIGNS_MAX */
  long long id;
  uint64_t seed;
  uint32_t n_designs, saved;
  enum mo_job_state state;
};
struct training_model {
  long long id;
  uint64_t seed;
  enum mo_job_state state;
  uint32_t position; /* of the current run */
  uint32_t step, n_validations, last_validation;
  uint32_t checkpoints[KEPT_MAX], n_checkpoints; /* ascending */
  uint32_t attempts;
  int result; /* content; −1: none */
};
struct campaign_model {
  long long id;
  uint64_t seed;
  bool learns; /* else zero-shot */
  enum mo_job_state state;
  long long generation; /* newest; −1: none */
  uint32_t until;       /* generation */
  uint32_t scored;      /* of the next one */
  uint32_t inside;      /* step of its checkpoint; 0: none */
  uint32_t attempts;
  int result; /* content; −1: none */
};
struct model {
  struct {
    int content; /* −1: no such name */
    int64_t version;
  } names[NAMES];
  uint64_t contents[CONTENTS_MAX]; /* seeds */
  int n_contents;
  struct evaluation_model evaluations[EVALUATIONS_MAX];
  int n_evaluations;
  struct training_model trainings[TRAININGS_MAX];
  int n_trainings;
  struct campaign_model campaigns[CAMPAIGNS_MAX];
  int n_campaigns;
  long long jobs, events, epoch;
};

enum act_kind {
  ACT_REQUEUE,
  ACT_PUT,
  ACT_REMOVE,
  ACT_SUBMIT,
  ACT_SAVE,
  ACT_CHANGE,
  ACT_TRAIN,
  ACT_TRAIN_START,
  ACT_TRAIN_PROGRESS,
  ACT_TRAIN_CHECKPOINT,
  ACT_TRAIN_PARK,
  ACT_TRAIN_FINISH,
  ACT_TRAIN_REMOVE, /* checkpoints that are not needed */
  ACT_CAMPAIGN,
  ACT_CAMPAIGN_START,
  ACT_CAMPAIGN_LOSSES,
  ACT_CAMPAIGN_CHECKPOINT,
  ACT_CAMPAIGN_GENERATION,
  ACT_CAMPAIGN_PARK,
  ACT_CAMPAIGN_EXTEND,
  ACT_CAMPAIGN_FINISH,
  ACT_KINDS
};
struct act {
  enum act_kind kind;
  int index; /* of the name, evaluation, or training */
  uint64_t seed;
  uint32_t
      n; /* of what it has several of: parts of ACT_SAVE, steps, checkpoints kept; change; error */
  uint32_t parts; /* that may be there without the next */
};

struct life {
  struct disk *disk;
  struct mo_store *store;
  struct mo_bits *forms, *genotypes; /* (BODIES) */
  struct model model;
  struct act doing; /* with in_doubt */
  bool in_doubt;
  int64_t fingerprint;
  unsigned findings, acts[ACT_KINDS];
  char first[400]; /* finding */
};

/* Acts in turn, with something of everything. Up to HELD a folder has what goes on: a training and
 * a campaign that run, with checkpoints. */
enum { SCRIPT = 26, COUNTED_FROM = 4, HELD = 15 };
extern const struct act life_script[SCRIPT];

/* Draws from a seed that a thing has: the same for who writes it and for who checks it. */
uint64_t life_hash(uint64_t seed, uint64_t place);
size_t life_content(uint64_t seed, uint8_t **bytes); /* of a controller's file (malloc) */
size_t life_checkpoint(uint64_t seed, uint32_t step, uint8_t **bytes); /* (malloc) */
double life_loss(uint64_t seed, uint32_t design, uint32_t environment, int32_t *diverged_step);
struct mo_training_step_row life_step(uint64_t seed, uint32_t step);
void life_name(int index, char name[16]);
void life_key(char kind, int index, char key[32]);

/* A controller as it is put. */
struct put {
  struct mo_controller controller;
  struct mo_metadata_entry entry;
  char key[8], *note;
  uint8_t *bytes;
  size_t size;
};
void *life_memory(size_t size); /* also where the allocators that the store uses fail */
void put_start(struct put *put, uint64_t seed);
void put_end(struct put *put);

void life_found(struct life *life, const char *format, ...) __attribute__((format(printf, 2, 3)));

int life_some(struct life *life, int n);               /* 0 … n − 1 */
int model_content(struct model *model, uint64_t seed); /* its place; added when it is not there */

/* Of campaigns: campaign_acts.c, campaign_matches.c. */
bool campaign_fits(struct life *life, struct act *act);
void campaign_apply(struct model *model, const struct act *act);
int campaign_do(struct life *life, const struct act *act);
bool campaign_matches(const struct life *life, const struct campaign_model *campaign, int index,
                      char text[300]);
/* A generation as its runner commits it: a function of the campaign's seed and its number. */
struct population {
  uint32_t n, numbers[MEMBERS];
  double scores[MEMBERS];
};
struct generation {
  struct mo_birth births[MEMBERS];
  double child_scores[MEMBERS], parent_scores[MEMBERS];
  struct mo_campaign_loss losses[MEMBERS];
  struct mo_campaign_step steps[LEARNING];
  struct mo_design_size sizes[MEMBERS];
  uint32_t survivors[MEMBERS];
  struct population before, after;
};
void life_generation(const struct campaign_model *campaign, uint32_t number,
                     const struct population *before, struct generation *generation);
void life_replay(const struct campaign_model *campaign, int64_t until,
                 struct generation *generation); /* ≥ 0 */
struct mo_campaign_loss life_saved_loss(const struct campaign_model *campaign,
                                        uint32_t place); /* of the next one */
struct mo_campaign_step life_learned(const struct campaign_model *campaign, uint32_t generation,
                                     uint32_t step);
size_t life_state(const struct campaign_model *campaign, uint32_t generation, uint32_t step,
                  uint8_t **bytes);

bool life_differs(char text[300], const char *format, ...) __attribute__((format(printf, 2, 3)));
/* Files in "<folder>/<id>" of the state folder. sum (nullable): takes their names, in any order. */
uint32_t life_files(const struct life *life, const char *folder, int64_t id, uint64_t *sum);

/* On a new disk, with nothing promised. forms, genotypes: (BODIES). Returns 0 or −1. */
int life_start(struct life *life, uint64_t seed, unsigned lies, struct mo_bits *forms,
               struct mo_bits *genotypes);
int life_open(struct life *life, uint32_t checkpoint_frames, struct mo_message *message);

struct act life_choose(struct life *life);
/* How many of its parts were acknowledged; *error: what the call that was not gave. */
uint32_t life_do(struct life *life, const struct act *act, int *error);
/* Waits until the writer has done what it does between commits: then the same seed gives the same
 * order of changes. */
void life_settle(struct life *life);
/* The model after `parts` of an act. */
void life_apply(struct model *model, const struct act *act, uint32_t parts);
/* Is the store what the model says, exactly? Else `text` says where not. */
bool life_matches(const struct life *life, const struct model *model, char text[300]);

#endif
