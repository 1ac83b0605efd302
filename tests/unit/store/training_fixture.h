/* training_fixture.h: a training request, and rows of its learning curve. */
#ifndef MORPHO_TESTS_STORE_TRAINING_FIXTURE_H
#define MORPHO_TESTS_STORE_TRAINING_FIXTURE_H

#include <math.h>

#include "fixture.h"
#include "store/trainings.h"

static inline struct mo_training_request submission_of(uint32_t n_steps)
{
  return (struct mo_training_request){.record = {.settings = {.kind = MO_TRAINING_PRETRAIN,
                                                              .seed = UINT64_C(0x1CBA9876543210),
                                                              .n_steps = n_steps,
                                                              .batch = 16,
                                                              .learning = fixture_learning(),
                                                              .physics = mo_paper_physics(),
                                                              .sensor = MO_SENSOR_INVERSE_SQUARE,
                                                              .held_out_designs = 5,
                                                              .held_out_environments = 7},
                                                 .name = "walker",
                                                 .validate_every_steps = 11,
                                                 .checkpoint_every_steps = 12,
                                                 .checkpoint_every_s = 13,
                                                 .checkpoints_kept = 2},
                                      .job.label = "a label"};
}

static inline int64_t submit_training(const struct mo_training_request *submission)
{
  int64_t id = 0;
  bool replayed = true;
  const int error = mo_store_submit_training(store, submission, &id, &replayed);
  return error != MO_OK ? error : id;
}

static inline struct mo_training_status training_of(int64_t id)
{
  struct mo_training_status status = {.step = 0};
  CHECK_OK(mo_store_training(store, id, &status));
  return status;
}

static inline struct mo_training_step_row row_of(uint32_t step)
{
  return (struct mo_training_step_row){.report = {.step = step,
                                                  .mean_loss = step == 3 ? NAN : 1.0 / (step + 2),
                                                  .rate = 1e-3 / step,
                                                  .gradient_norm = 0.1 * step,
                                                  .clipped_share = 0.25,
                                                  .clipped_robots_share = 0.5,
                                                  .diverged = step,
                                                  .zeroed = step + 1,
                                                  .skipped = step == 3,
                                                  .bounded = step + 2},
                                       .seconds = 0.125};
}

#endif
