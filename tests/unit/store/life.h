/* life.h: the life of a state folder on a disk whose power fails: what is asked of the store, and
 * what it has promised.
 *
 * Promised is what was acknowledged: beside the disk a store that no fault meets does the same
 * acts. After a stop the rows and files of the two must be the same, bit for bit. An act in doubt,
 * whose call had not returned when everything stopped, is there wholly or not at all; one that
 * saves several things in a row may have come through some of them. */
#ifndef MORPHO_TESTS_STORE_LIFE_H
#define MORPHO_TESTS_STORE_LIFE_H

#include "disk.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/runner.h"
#include "store/trainings.h"

enum {
  KINDS = MO_JOB_KINDS,
  JOBS_MAX = 60, /* of a kind */
  NAMES = 4,
  PUTS_MAX = 160,
  DESIGNS_MAX = 5, /* of an evaluation */
  TRAININGS_MAX = 20,
  CAMPAIGNS_MAX = 4,
  GENERATIONS_MAX = 12,
  MEMBERS = 4,  /* of a population; as many are born in each generation */
  LEARNING = 4, /* steps in each */
  LISTED = 3,   /* designs that a campaign begins with */
  BODIES_OF_CAMPAIGNS = JOBS_MAX * DESIGNS_MAX,
  BODIES = BODIES_OF_CAMPAIGNS + CAMPAIGNS_MAX * GENERATIONS_MAX * MEMBERS,
  KEPT_MAX = 3
};

/* A job as it is promised. */
struct subject {
  int64_t id;
  uint64_t seed;
  enum mo_job_state state;
  uint32_t done; /* designs of an evaluation, steps of a training's current run, losses of a
                    campaign's next generation */
  uint32_t n_checkpoints, validated; /* validated: step of the newest validation */
  int64_t generation, told;          /* of a campaign: the newest; −1: none; of a study, batch */
  uint32_t inside;                   /* step of the checkpoint inside the next one; 0: none */
  uint32_t until;                    /* generation */
};

enum act_kind {
  ACT_REQUEUE,
  ACT_PUT,
  ACT_REMOVE,
  ACT_SCORES, /* of another store */
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
  ACT_CAMPAIGN_TELL, /* a batch of a study */
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
  struct mo_store *store, *promised;
  char promised_folder[64];
  struct mo_bits *forms, *genotypes; /* (BODIES) */
  struct subject jobs[KINDS][JOBS_MAX];
  int n_jobs[KINDS];
  bool named[NAMES];
  uint64_t puts[PUTS_MAX]; /* seeds */
  int n_puts;
  long long epoch;
  int64_t history;
  bool was_stopped; /* since this history was opened */
  struct act doing; /* with in_doubt */
  bool in_doubt;
  int64_t fingerprint;
  unsigned findings, acts[ACT_KINDS];
  char first[400]; /* finding */
};

/* Acts in turn, with something of everything. Up to HELD a folder has what goes on: a training and
 * a campaign that run, with checkpoints. */
enum { SCRIPT = 32, COUNTED_FROM = 4, HELD = 15 };
extern const struct act life_script[SCRIPT];

/* Draws from a seed that a thing has. */
uint64_t life_hash(uint64_t seed, uint64_t place);
size_t life_checkpoint(uint64_t seed, uint32_t step, uint8_t **bytes); /* (malloc) */
double life_loss(uint64_t seed, uint32_t design, uint32_t environment, int32_t *diverged_step);
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
void put_start(struct put *put, uint64_t seed);
void put_end(struct put *put);

void life_found(struct life *life, const char *format, ...) __attribute__((format(printf, 2, 3)));
int life_some(struct life *life, int n); /* 0 … n − 1 */
/* The oldest job of a kind in one of the states (bits), or the newest; −1: there is none. */
int life_job_in(const struct life *life, enum mo_job_kind kind, unsigned states, bool newest);

/* Of campaigns: campaign_acts.c. */
bool campaign_fits(struct life *life, struct act *act);
int campaign_do(struct life *life, struct mo_store *of, const struct act *act, int64_t *id);

/* On a new disk, with nothing promised. forms, genotypes: (BODIES). Returns 0 or −1. */
int life_start(struct life *life, uint64_t seed, unsigned lies, struct mo_bits *forms,
               struct mo_bits *genotypes);
int life_open(struct life *life, uint32_t checkpoint_frames, struct mo_message *message);
void life_end(struct life *life); /* closes what is open */

struct act life_choose(struct life *life);
/* Asks a store for an act. Returns how many of its parts were acknowledged; *error: what the call
 * that was not gave. */
uint32_t life_do(struct life *life, struct mo_store *of, const struct act *act, int *error);
/* Waits until the writer has done what it does between commits: then the same seed gives the same
 * order of changes. */
void life_wait_for_writer(struct mo_store *of);
/* Promises `parts` of an act, which keeps the others. */
void life_apply(struct life *life, struct act *act, uint32_t parts);

/* Every row but for times and what counts openings, and the names of checkpoints' files. */
struct contents {
  uint64_t sum; /* of all */
  int n;
  struct {
    char name[40];
    uint64_t sum;
  } tables[64];
};
void life_contents(const char *folder, struct contents *contents);
/* After an opening whose rows are as promised: the numbers of events go on where they were, or, in
 * another history, behind a jump, and the promise with them. */
void life_follow(struct life *life);
/* Is what the disk holds what is promised, and are all its files and checksums right? Else `text`
 * says what is not. */
enum { MATCH_TEXT = 200 };
bool life_matches(const struct life *life, char text[MATCH_TEXT]);

#endif
