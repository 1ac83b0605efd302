/* internal.h: the state of a training run, shared by the files of this room. */
#ifndef MORPHO_LEARNING_INTERNAL_H
#define MORPHO_LEARNING_INTERNAL_H

#include <morpho/learning.h>

struct mo_training {
  struct mo_training_settings settings; /* the sensor is always the controller's */
  struct mo_controller *controller;
  struct mo_adam {
    double *first, *second;          /* (n_parameters) moments */
    double beta1_power, beta2_power; /* β^updates */
  } adam;
  uint32_t step;    /* steps that were applied */
  uint32_t skipped; /* steps that changed no weight; all other steps are updates of Adam */
  uint32_t n_designs;
  uint64_t *designs;                   /* finetune: (n_designs, MO_DEFAULT_WORDS) */
  uint32_t n_environments;             /* 0: the run draws its environments */
  struct mo_environment *environments; /* (n_environments) its own */
  bool draws_worlds;                   /* environments are drawn: the run has only its own tasks, or
                                          neither tasks nor environments */
  uint64_t draws; /* pretrain: draws of the stream up to the current step; a replay must reach this
                     number */

  /* Created at the first draw; not part of a checkpoint. */
  uint32_t n_threads; /* threads of draw and apply */
  struct mo_lattice *lattice;
  struct mo_body_stream *stream;
  uint64_t taken; /* bodies taken from the stream */
  bool replayed;  /* the stream has reached the start of the current step */
  uint32_t n_bodies;
  struct mo_body **bodies; /* finetune: (n_bodies) of the designs; NULL: not built yet */
  struct mo_hand {
    uint32_t step;
    uint64_t *drawn;         /* pretrain: (batch, MO_DEFAULT_WORDS) bodies of the step */
    uint32_t n_drawn;        /* number of bodies drawn so far */
    struct mo_body **bodies; /* pretrain: (batch); NULL: not built yet */
    struct mo_environment
        *environments; /* (batch) drawn or varied; NULL: the robots have the training run's own */
    struct mo_variation *variations; /* (batch) drawn; NULL: nothing varies */
    struct mo_robot *robots;         /* (batch) */
    uint64_t draws;                  /* pretrain: draws of the stream up to the step's end */
    bool ready;                      /* `robots` is complete */
    bool stale;                      /* its bodies are no longer needed */
  } hands[2]; /* the current step and the next; the index is the lowest bit of the step */
};

/* training.c: creates the controller for these settings, with zero weights. On failure the caller
 * frees *controller, which may be NULL. */
int mo_training_blank(const struct mo_training_settings *settings,
                      struct mo_controller **controller);
/* training.c: allocates everything that a checkpoint holds, but fills in only the settings. */
int mo_training_allocate(const struct mo_training_settings *settings, uint32_t n_designs,
                         struct mo_training **training);
/* Returns 1 if a design is in one piece (and therefore not empty) and placed, else 0; or
 * MO_ERR_NO_MEMORY. */
int mo_training_design_is_placed(const uint64_t *design);

/* draw.c */
struct mo_hand *mo_training_hand(struct mo_training *training, uint32_t step);
void mo_training_forget_robots(
    struct mo_training *training); /* after the current step: the next draw frees its bodies */
void mo_training_forget_designs(struct mo_training *training); /* finetune: the designs changed */
void mo_training_draw_free(struct mo_training *training);

/* adam.c */
void mo_adam_count(struct mo_adam *adam, const struct mo_training_settings *settings,
                   uint32_t updates); /* β^updates */
/* Returns the global L2 norm, computed without overflow or underflow; infinite or NaN if the
 * gradient has infinite or NaN elements. */
double mo_gradient_norm(const double *gradient, size_t n);
/* Performs one update with gradient · scale. If any new moment or weight would not be finite,
 * changes nothing and returns false. */
bool mo_adam_update(struct mo_adam *adam, const struct mo_training_settings *settings, double rate,
                    double scale, const double *gradient, float *weights, size_t n,
                    uint32_t n_threads, uint32_t *bounded);

/* environments.c: allocates n environments that belong to the training run, to be filled in. */
int mo_training_allocate_environments(struct mo_training *training, uint32_t n);
/* Gives a drawn environment the task of another, and its light if the task moves the light. */
void mo_training_give_task(const struct mo_environment *tasked, struct mo_environment *environment);
/* A training run's own environments as bytes: in their packed form, all in the first version that
 * includes all their fields. */
unsigned mo_training_environments_version(const struct mo_training *training);
size_t mo_training_environments_bytes(const struct mo_training *training, unsigned version);
void mo_training_environments_pack(const struct mo_training *training, unsigned version,
                                   uint8_t *bytes);
/* Fills in the allocated environments from the first *used of `size` bytes. MO_ERR_FORMAT: a value,
 * or the version, is invalid, or there are too few bytes; MO_ERR_NO_MEMORY. */
int mo_training_environments_unpack(struct mo_training *training, unsigned version,
                                    const uint8_t *bytes, size_t size, size_t *used);

/* checkpoint.c: CRC-64/XZ: detects every error burst of at most 64 bits, and all but one in 2^64
 * other errors. */
uint64_t mo_checksum(const uint8_t *bytes, size_t n);

#endif
