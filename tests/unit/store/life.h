/* life.h: the history of a state folder on a disk that loses power: acts that a store performs, and
 * what it has promised.
 *
 * Everything that was acknowledged is promised. A second store without faults, the promised store,
 * performs the same acts. After a stop, the rows and files of the two must be the same, bit for
 * bit. An act is in doubt if its call had not returned when everything stopped: then either all of
 * it is stored or nothing. If it saves several things in a row, the first few may be stored. */
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
  JOBS_MAX = 60, /* of each kind */
  NAMES = 4,
  PUTS_MAX = 160,
  DESIGNS_MAX = 5, /* of an evaluation */
  TRAININGS_MAX = 20,
  CAMPAIGNS_MAX = 4,
  GENERATIONS_MAX = 12,
  MEMBERS = 4,  /* of a population; each generation has the same number of children */
  LEARNING = 4, /* learning steps in each generation */
  LISTED = 3,   /* designs that a campaign starts with */
  BODIES_OF_CAMPAIGNS = JOBS_MAX * DESIGNS_MAX,
  BODIES = BODIES_OF_CAMPAIGNS + CAMPAIGNS_MAX * GENERATIONS_MAX * MEMBERS,
  KEPT_MAX = 3
};

/* A promised job. */
struct subject {
  int64_t id;
  uint64_t seed;
  enum mo_job_state state;
  uint32_t done; /* designs of an evaluation, steps of a training job's current run, or losses of a
                    campaign's next generation */
  uint32_t n_checkpoints, validated; /* of a training run: step of the newest validation */
  int64_t generation, told;          /* of a campaign: the newest, or −1; of a study, the batch */
  uint32_t inside;                   /* step of the checkpoint inside the next generation, or 0 */
  uint32_t until;                    /* its generation */
};

enum act_kind {
  ACT_REQUEUE,
  ACT_PUT,
  ACT_REMOVE,
  ACT_SCORES, /* made by another store */
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
  ACT_CAMPAIGN_TELL, /* submits a batch of a study */
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
  uint32_t n;     /* number of repeated things: parts of ACT_SAVE, steps, checkpoints to keep; or a
                     change or error */
  uint32_t parts; /* parts of which the first may be stored without the next */
};

struct life {
  struct disk *disk;
  struct mo_store *store, *promised;
  char promised_folder[64];
  struct mo_bits *forms, *genotypes; /* (BODIES) */
  struct subject jobs[KINDS][JOBS_MAX];
  int n_jobs[KINDS];
  bool named[NAMES];
  uint64_t puts[PUTS_MAX]; /* seeds of the stored controllers */
  int n_puts;
  long long epoch;
  int64_t history;
  bool was_stopped; /* since this history was opened */
  struct act doing; /* valid with in_doubt */
  bool in_doubt;
  int64_t fingerprint;
  unsigned findings, acts[ACT_KINDS];
  char first[400]; /* the first fault found */
};

/* A script of acts that covers every kind. Up to HELD, the folder has unfinished jobs: a running
 * training run and a running campaign, with checkpoints. */
enum { SCRIPT = 32, COUNTED_FROM = 4, HELD = 15 };
extern const struct act life_script[SCRIPT];

/* Draws from a seed. */
uint64_t life_hash(uint64_t seed, uint64_t place);
size_t life_checkpoint(uint64_t seed, uint32_t step, uint8_t **bytes); /* (malloc) */
double life_loss(uint64_t seed, uint32_t design, uint32_t environment, int32_t *diverged_step);
void life_name(int index, char name[16]);
void life_key(char kind, int index, char key[32]);

/* A controller to be stored. */
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
/* Returns the oldest job of a kind in one of the states (a bit set), or the newest if `newest`; −1
 * if there is no such job. */
int life_job_in(const struct life *life, enum mo_job_kind kind, unsigned states, bool newest);

/* For campaigns, in campaign_acts.c. */
bool campaign_fits(struct life *life, struct act *act);
int campaign_do(struct life *life, struct mo_store *of, const struct act *act, int64_t *id);

/* Begins on a new disk, with nothing promised. forms, genotypes: (BODIES). Returns 0 or −1. */
int life_start(struct life *life, uint64_t seed, unsigned lies, struct mo_bits *forms,
               struct mo_bits *genotypes);
int life_open(struct life *life, uint32_t checkpoint_frames, struct mo_message *message);
void life_end(struct life *life); /* closes whatever is open */

struct act life_choose(struct life *life);
/* Runs an act on a store. Returns how many of its parts were acknowledged. *error: the error of the
 * first part that was not. */
uint32_t life_do(struct life *life, struct mo_store *of, const struct act *act, int *error);
/* Waits until the writer has finished its work between commits, so that equal seeds give the same
 * order of changes. */
void life_wait_for_writer(struct mo_store *of);
/* Runs the first `parts` parts of an act on the promised store; the act keeps the others. */
void life_apply(struct life *life, struct act *act, uint32_t parts);

/* Returns every row, without times, counters of openings, and names of checkpoint files. */
struct contents {
  uint64_t sum; /* of all rows */
  int n;
  struct {
    char name[40];
    uint64_t sum;
  } tables[64];
};
void life_contents(const char *folder, struct contents *contents);
/* Call it after an opening whose rows are as promised. Event numbers must continue, or jump ahead
 * in a new history; the promised store follows. */
void life_follow(struct life *life);
/* Checks that the disk holds exactly what was promised, and that all files and checksums are
 * correct. If not, `text` says what is wrong. */
enum { MATCH_TEXT = 200 };
bool life_matches(const struct life *life, char text[MATCH_TEXT]);

#endif
