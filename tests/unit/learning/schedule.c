/* schedule.c: learning rates compared with numbers from the paper and numbers worked out by
 * hand. */
#include "../make.h"

/* Rates of the paper's schedules and of ours at some steps. */
static void rates(void)
{
  const double quarter = (1.0 + sqrt(0.5)) / 2.0, late = (1.0 - sqrt(0.5)) / 2.0;
  const struct mo_schedule pretrain = mo_schedule_presets[MO_SCHEDULE_PAPER_PRETRAIN],
                           paper_finetune = mo_schedule_presets[MO_SCHEDULE_PAPER_FINETUNE],
                           simultaneous = mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS],
                           one_cosine = mo_schedule_presets[MO_SCHEDULE_ONE_COSINE],
                           finetune = mo_schedule_presets[MO_SCHEDULE_FINETUNE_COSINE];
  const struct {
    const struct mo_schedule *schedule;
    uint32_t step, n_steps;
    double rate, tolerance;
  } all[] = {
      /* Cycles of 10, 20, 40, … steps, each with a peak of 0.7 times the last. */
      {&pretrain, 0, 1400, 1e-3, 1e-17},
      {&pretrain, 10, 1400, 7e-4, 1e-17},
      {&pretrain, 30, 1400, 4.9e-4, 1e-17},
      {&pretrain, 70, 1400, 3.43e-4, 1e-17},
      {&pretrain, 150, 1400, 2.401e-4, 1e-17},
      {&pretrain, 310, 1400, 1.6807e-4, 1e-17},
      {&pretrain, 630, 1400, 1.17649e-4, 1e-17},
      {&pretrain, 1270, 1400, 8.23543e-5, 1e-17},
      {&pretrain, 5, 1400, 5.05e-4, 1e-17}, /* half way: the mean of peak and floor */
      {&pretrain, 20, 1400, 3.55e-4, 1e-17},
      {&pretrain, 40, 1400, 1e-5 + 4.8e-4 * quarter, 1e-17},
      {&pretrain, 60, 1400, 1e-5 + 4.8e-4 * late, 1e-17},
      {&pretrain, 9, 1400, 1e-5, 0.03 * 1e-3}, /* nearly at the floor before it restarts */
      {&paper_finetune, 0, 60, 3.5e-4, 1e-18},
      {&paper_finetune, 50, 60, 1.925e-4, 1e-17},
      {&paper_finetune, 59, 60, 1.5e-4, 0.05e-4}, /* the paper's "effective minimum" */
      {&paper_finetune, 100, 200, 3.5e-4, 1e-18},
      {&simultaneous, 10, 360, 6.5e-4, 1e-17},
      {&simultaneous, 30, 360, 4.225e-4, 1e-17},
      {&one_cosine, 0, 110, 2e-4, 1e-18},
      {&one_cosine, 4, 110, 1e-3, 1e-18},
      {&one_cosine, 9, 110, 2e-3, 1e-18},
      {&one_cosine, 10, 110, 2e-3, 1e-18},
      {&one_cosine, 60, 110, 1.005e-3, 1e-17},
      {&one_cosine, 10 + 25, 110, 1e-5 + 1.99e-3 * quarter, 1e-17},
      {&one_cosine, 109, 110, 1e-5, 1e-6},
      {&one_cosine, 110, 110, 1e-5, 0},
      {&one_cosine, 4, 5, 1e-3, 1e-18}, /* shorter than its warm-up: the rate is still rising */
      {&finetune, 0, 60, 3e-4, 1e-18},
      {&finetune, 30, 60, 1.505e-4, 1e-17},
      {&finetune, 59, 60, 1e-6, 1e-6},
  };
  for (size_t i = 0; i < COUNT(all); i++)
    CHECK_NEAR(mo_schedule_rate(all[i].schedule, all[i].step, all[i].n_steps), all[i].rate,
               all[i].tolerance);
  CHECK(mo_schedule_rate(&pretrain, 9, 10) == mo_schedule_rate(&pretrain, 9, 1400));
  for (uint32_t step = 11; step < 110; step++)
    CHECK(mo_schedule_rate(&one_cosine, step, 110) < mo_schedule_rate(&one_cosine, step - 1, 110));
}

static int check(const struct mo_schedule *schedule, struct mo_message *message)
{
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_PRETRAIN);
  settings.learning.schedule = *schedule;
  return mo_training_settings_check(&settings, message);
}

static void corners(void)
{
  struct mo_schedule s = {.kind = MO_SCHEDULE_CONSTANT,
                          .peak = 1e-3,
                          .floor = 1e-5,
                          .decay = 0.5,
                          .cycle_steps = 1,
                          .cycle_growth = 1,
                          .warmup_steps = 2};
  CHECK(check(&s, NULL) == MO_OK);
  CHECK_NEAR(mo_schedule_rate(&s, 0, 10), 5e-4, 1e-18);
  CHECK(mo_schedule_rate(&s, 2, 10) == 1e-3);
  CHECK(mo_schedule_rate(&s, 9, 10) == 1e-3);
  s.kind =
      MO_SCHEDULE_RESTARTS; /* cycles of one step: only peaks, until they are below the floor */
  CHECK_NEAR(mo_schedule_rate(&s, 3, 10), 5e-4, 1e-18);
  CHECK_NEAR(mo_schedule_rate(&s, 8, 10), 1e-3 / 64, 1e-18);
  CHECK(mo_schedule_rate(&s, 9, 10) == 1e-5);
  CHECK(mo_schedule_rate(&s, MO_TRAINING_STEPS_MAX - 1, MO_TRAINING_STEPS_MAX) == 1e-5);
  s.cycle_steps = MO_TRAINING_STEPS_MAX;
  s.cycle_growth = 1000;
  CHECK(check(&s, NULL) == MO_OK);
  CHECK(mo_schedule_rate(&s, MO_TRAINING_STEPS_MAX - 1, MO_TRAINING_STEPS_MAX) > 1e-5);
}

/* Against the C library's cosine, for every step of cycles of many lengths. */
static void cosine(void)
{
  struct mo_schedule s = {.kind = MO_SCHEDULE_COSINE, .peak = 1.0, .floor = 1e-300};
  double worst = 0.0;
  for (uint32_t n = 1; n < 3000; n += 7)
    for (uint32_t step = 0; step < n; step++) {
      const double expected = (1.0 + cos(3.14159265358979323846 * step / n)) / 2.0;
      worst = fmax(worst, fabs(mo_schedule_rate(&s, step, n) - expected));
    }
  printf("# largest difference from the C library: %g\n", worst);
  CHECK(worst < 5e-16);
}

/* The bits are part of the format: a restored training run must continue with the same rates. */
static void bits(void)
{
  const struct mo_schedule s = mo_schedule_presets[MO_SCHEDULE_ONE_COSINE],
                           p = mo_schedule_presets[MO_SCHEDULE_PAPER_PRETRAIN];
  uint64_t hash = 0;
  for (uint32_t step = 0; step < 1400; step++) {
    const double rates[2] = {mo_schedule_rate(&s, step, 1400), mo_schedule_rate(&p, step, 1400)};
    for (int i = 0; i < 2; i++) {
      uint64_t word;
      memcpy(&word, &rates[i], sizeof(word));
      hash = (hash ^ word) * UINT64_C(0x9e3779b97f4a7c15);
      hash ^= hash >> 29;
    }
  }
  printf("# hash of 2800 rates: %016llx\n", (unsigned long long)hash);
  CHECK(hash == UINT64_C(0x5729012fd3ea6147));
}

static void refused(void)
{
  static struct mo_schedule s;
  static const struct field_case cases[] = {
      {FIELD(s.kind), 3, MO_ERR_INVALID,
       "schedule.kind must be \"restarts\", \"cosine\" or \"constant\", got number 3"},
      {FIELD(s.peak), NAN, MO_ERR_INVALID,
       "schedule.peak must be above 0 and at most 1, got a number that is not finite"},
      {FIELD(s.peak), -1e-3, MO_ERR_RANGE, "peak must be above 0 and at most 1, got -0.001"},
      {FIELD(s.peak), 1.5, MO_ERR_RANGE, "at most 1"},
      {FIELD(s.floor), 0, MO_ERR_RANGE, "schedule.floor must be above 0 and at most 1, got 0"},
      {FIELD(s.floor), INFINITY, MO_ERR_INVALID, "got a number that is not finite"},
      {FIELD(s.floor), 2e-3, MO_ERR_RANGE,
       "schedule.floor must be at most the peak, which is 0.001, got 0.002"},
      {FIELD(s.decay), 0, MO_ERR_RANGE, "schedule.decay must be above 0 and at most 1, got 0"},
      {FIELD(s.decay), 1.1, MO_ERR_RANGE, "at most 1, got 1.1"},
      {FIELD(s.cycle_steps), 0, MO_ERR_RANGE,
       "schedule.cycle_steps must be at least 1 and at most 1000000, got 0"},
      {FIELD(s.cycle_growth), 0, MO_ERR_RANGE,
       "schedule.cycle_growth must be at least 1 and at most 1000, got 0"},
      {FIELD(s.cycle_growth), 1001, MO_ERR_RANGE, "at most 1000, got 1001"},
      {FIELD(s.warmup_steps), 1000001, MO_ERR_RANGE,
       "schedule.warmup_steps must be at least 0 and at most 1000000, got 1000001"},
  };
  for (size_t i = 0; i < COUNT(cases); i++) {
    struct mo_message message = {""};
    s = (struct mo_schedule){MO_SCHEDULE_RESTARTS, 1e-3, 1e-5, 1, 1, 1, 0};
    CHECK_INT(check(&s, NULL), MO_OK);
    set_field(cases[i].field, cases[i].size, cases[i].value);
    CHECK_INT(check(&s, &message), cases[i].code);
    CHECK_SAYS(message, cases[i].says);
  }
}

static void known(void)
{
  const struct mo_schedule all[] = {mo_schedule_presets[MO_SCHEDULE_PAPER_PRETRAIN],
                                    mo_schedule_presets[MO_SCHEDULE_PAPER_FINETUNE],
                                    mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS],
                                    mo_schedule_presets[MO_SCHEDULE_ONE_COSINE],
                                    mo_schedule_presets[MO_SCHEDULE_FINETUNE_COSINE]};
  for (int i = 0; i < 5; i++)
    CHECK_INT(check(&all[i], NULL), MO_OK);
}

static const struct check_case cases[] = {
    {"the paper's schedules and ours, at some steps", rates},
    {"constant rates, short cycles, long cycles", corners},
    {"the cosine agrees with the C library's", cosine},
    {"the same bits everywhere", bits},
    {"invalid schedules are refused with a reason", refused},
    {"all built-in schedules are valid", known},
};
CHECK_MAIN(cases)
