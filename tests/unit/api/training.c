/* The body of POST /v1/trainings: defaults by kind and preset. Faults and their places are in
 * tests/api/test_invalid.py. */
#include "unit/check.h"

#include "api/requests.h"

static struct mo_parsed_training parsed;
static struct mo_faults faults;

#define DESIGNS "\"designs\":[{\"cells\":[[0,0,0]]}]"
#define TUNE    "{\"kind\":\"finetune\"," DESIGNS ","
#define TRAIN   "{\"kind\":\"pretrain\","

static int parse(const char *text)
{
  mo_parts_free(&parsed.parts);
  faults = (struct mo_faults){0};
  return mo_training_parse(text, strlen(text), &parsed, &faults);
}

static void defaults(void)
{
  REQUIRE(parse("{\"kind\":\"pretrain\"}") == MO_OK);
  const struct mo_training_request *r = &parsed.request;
  const struct mo_training_settings *s = &r->record.settings;
  CHECK(s->kind == MO_TRAINING_PRETRAIN && s->n_steps == 1400 && s->batch == 256 && s->seed == 1);
  CHECK(s->learning.beta1 == 0.9 && s->learning.beta2 == 0.999 && s->learning.epsilon == 1e-8 &&
        s->learning.norm_limit == 1 && s->learning.adjoint_bound == 2);
  CHECK_INT(s->learning.adjoint_rule, MO_ADJOINT_CLIP);
  CHECK(s->learning.restart_weight == 3);
  CHECK(s->learning.schedule.kind == MO_SCHEDULE_COSINE && s->sensor == MO_SENSOR_INVERSE_SQRT &&
        s->physics.n_steps == 1000);
  CHECK(s->held_out_designs == 64 && s->held_out_environments == 8 &&
        r->record.validate_every_steps == 50);
  CHECK(r->record.checkpoint_every_steps == 0 && r->record.checkpoint_every_s == 60 &&
        r->record.checkpoints_kept == 3);
  CHECK(r->parent == NULL && r->label == NULL && r->priority == MO_BATCH && r->genotypes == NULL);
  CHECK(r->population == 0 && r->record.n_designs == 0);
  CHECK_TEXT(r->record.name, "");
  /* The kind decides, wherever it stands. */
  REQUIRE(parse("{" DESIGNS ",\"seed\":7,\"kind\":\"finetune\"}") == MO_OK);
  CHECK(s->kind == MO_TRAINING_FINETUNE && s->n_steps == 60 && s->seed == 7 &&
        s->learning.schedule.cycle_steps == 100);
  CHECK_TEXT(r->parent, "default");
  CHECK(r->record.n_designs == 1 && r->genotypes != NULL);
  REQUIRE(parse("{\"kind\":\"pretrain\",\"controller\":null,\"sensor\":\"inverse_square\"}") ==
          MO_OK);
  CHECK(r->parent == NULL && s->sensor == MO_SENSOR_INVERSE_SQUARE);
}

static void everything(void)
{
  REQUIRE(parse("{\"kind\":\"finetune\",\"name\":\"walker.2\",\"controller\":\"walker\","
                "\"population\":{\"evaluation\":"
                "\"12\",\"best\":64},\"steps\":30,\"batch\":65536,\"seed\":9007199254740991,"
                "\"schedule\":{\"peak\":"
                "0.01,\"kind\":\"restarts\",\"floor\":1e-6,\"decay\":0.5,\"cycle_steps\":5,\"cycle_"
                "growth\":3,"
                "\"warmup_steps\":2},\"adam\":{\"beta1\":0,\"beta2\":0.5,\"epsilon\":1e-6},"
                "\"gradient_norm_limit\":0,"
                "\"adjoint_bound\":8,\"adjoint_rule\":\"restart\",\"restart_weight\":0,\"physics\":"
                "{\"n_steps\":200,"
                "\"impact\":"
                "\"bisection8\"},\"validation\":{"
                "\"every_steps\":0,\"designs\":3,\"environments\":4},\"checkpoint\":{\"every_"
                "steps\":5,\"every_s\":0,"
                "\"keep\":1},\"priority\":\"batch\",\"label\":\"x\"}") == MO_OK);
  const struct mo_training_request *r = &parsed.request;
  const struct mo_training_settings *s = &r->record.settings;
  CHECK_TEXT(r->record.name, "walker.2");
  CHECK_TEXT(r->parent, "walker");
  CHECK_TEXT(r->label, "x");
  CHECK(r->population == 12 && r->population_best == 64 && r->record.n_designs == 0);
  CHECK(s->n_steps == 30 && s->batch == 65536 && s->seed == UINT64_C(9007199254740991));
  CHECK(s->learning.schedule.kind == MO_SCHEDULE_RESTARTS && s->learning.schedule.peak == 0.01 &&
        s->learning.schedule.floor == 1e-6);
  CHECK(s->learning.schedule.decay == 0.5 && s->learning.schedule.cycle_steps == 5 &&
        s->learning.schedule.cycle_growth == 3);
  CHECK(s->learning.schedule.warmup_steps == 2 && s->learning.beta1 == 0 &&
        s->learning.beta2 == 0.5 && s->learning.epsilon == 1e-6);
  CHECK_INT(s->learning.adjoint_rule, MO_ADJOINT_RESTART);
  CHECK(s->learning.restart_weight == 0);
  CHECK(s->learning.norm_limit == 0 && s->learning.adjoint_bound == 8 &&
        s->physics.n_steps == 200 && s->physics.bisections == 8);
  CHECK(r->record.validate_every_steps == 0 && s->held_out_designs == 3 &&
        s->held_out_environments == 4);
  CHECK(r->record.checkpoint_every_steps == 5 && r->record.checkpoint_every_s == 0 &&
        r->record.checkpoints_kept == 1);
}

/* The settings of a preset, wherever it stands, and what is named over them. */
static void presets(void)
{
  const struct mo_training_request *r = &parsed.request;
  const struct mo_training_settings *s = &r->record.settings;
  REQUIRE(parse(TRAIN "\"preset\":\"phototaxis\"}") == MO_OK);
  CHECK(s->n_steps == 1400 && s->batch == 8192 && s->seed == 1 && s->learning.beta1 == 0.8 &&
        s->learning.adjoint_bound == 8);
  CHECK(s->learning.schedule.kind == MO_SCHEDULE_RESTARTS && s->learning.schedule.peak == 2e-3 &&
        s->learning.schedule.floor == 1e-5);
  CHECK(s->learning.schedule.decay == 0.75 && s->learning.schedule.cycle_steps == 61 &&
        s->learning.schedule.cycle_growth == 22);
  CHECK(s->learning.schedule.warmup_steps == 5 && s->learning.adjoint_rule == MO_ADJOINT_RESTART &&
        s->learning.restart_weight == 3);
  CHECK(r->record.validate_every_steps == 50 && r->record.checkpoint_every_s == 60);
  REQUIRE(parse("{\"preset\":\"paper\",\"kind\":\"pretrain\"}") == MO_OK);
  CHECK(s->batch == 8192 && s->learning.schedule.peak == 1e-3 &&
        s->learning.schedule.decay == 0.7 && s->learning.adjoint_bound == 0);
  REQUIRE(parse(TUNE "\"preset\":\"paper\"}") == MO_OK);
  CHECK(s->n_steps == 60 && s->batch == 8192 && s->learning.schedule.peak == 3.5e-4 &&
        s->learning.adjoint_bound == 0);
  REQUIRE(parse(TUNE "\"preset\":\"workstation\"}") == MO_OK);
  CHECK(s->n_steps == 60 && s->batch == 256 && s->learning.schedule.peak == 3e-4 &&
        s->learning.adjoint_bound == 2);
  /* A word spelt with escapes is that word in both passes. */
  REQUIRE(parse(TRAIN "\"preset\":\"\\u0070aper\"}") == MO_OK);
  CHECK(s->batch == 8192 && s->learning.beta1 == 0.9);
  /* Given before the preset or behind it, what is named counts; of adam field by field, of the
   * schedule as a whole. */
  REQUIRE(parse("{\"steps\":10,\"adam\":{\"beta2\":0.99},\"kind\":\"pretrain\",\"restart_weight\":"
                "1,\"preset\":"
                "\"phototaxis\",\"batch\":7,\"adjoint_bound\":4,\"schedule\":{\"kind\":"
                "\"restarts\",\"peak\":0.003}}") == MO_OK);
  CHECK(s->n_steps == 10 && s->batch == 7 && s->learning.beta1 == 0.8 &&
        s->learning.beta2 == 0.99 && s->learning.adjoint_bound == 4);
  CHECK(s->learning.adjoint_rule == MO_ADJOINT_RESTART && s->learning.restart_weight == 1);
  CHECK(s->learning.schedule.peak == 0.003 && s->learning.schedule.decay == 0.7 &&
        s->learning.schedule.cycle_steps == 10);
  CHECK(s->learning.schedule.cycle_growth == 2 && s->learning.schedule.warmup_steps == 0);
  REQUIRE(
      parse(TRAIN
            "\"preset\":\"phototaxis\",\"schedule\":\"one-cosine\",\"adjoint_rule\":\"clip\"}") ==
      MO_OK);
  CHECK(s->learning.schedule.kind == MO_SCHEDULE_COSINE &&
        s->learning.schedule.warmup_steps == 10 && s->batch == 8192);
  CHECK_INT(s->learning.adjoint_rule, MO_ADJOINT_CLIP);
  /* An unknown one is refused with all names that there are. */
  CHECK_INT(parse(TRAIN "\"preset\":\"laptop\"}"), MO_ERR_INVALID);
  REQUIRE(faults.n == 1);
  CHECK_TEXT(faults.items[0].where, "/preset");
  static const char *const presets[] = {"workstation", "phototaxis", "paper"};
  for (int i = 0; i < 3; i++)
    CHECK(strstr(faults.items[0].detail, presets[i]) != NULL);
}

static void schedules(void)
{
  const struct mo_schedule *schedule = &parsed.request.record.settings.learning.schedule;
  REQUIRE(parse(TRAIN "\"schedule\":\"paper-simultaneous\"}") == MO_OK);
  CHECK(schedule->kind == MO_SCHEDULE_RESTARTS && schedule->decay == 0.65);
  REQUIRE(parse(TRAIN "\"schedule\":\"paper-finetune\"}") == MO_OK);
  CHECK(schedule->peak == 3.5e-4);
  REQUIRE(parse(TRAIN "\"schedule\":\"one-cosine\"}") == MO_OK);
  CHECK(schedule->kind == MO_SCHEDULE_COSINE && schedule->peak == 2e-3 &&
        schedule->warmup_steps == 10);
  REQUIRE(parse(TRAIN "\"schedule\":\"paper-pretrain\"}") == MO_OK);
  CHECK(schedule->kind == MO_SCHEDULE_RESTARTS && schedule->decay == 0.7);
  /* What an object leaves out. A peak below the usual floor lowers the floor. */
  REQUIRE(parse(TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":1e-6}}") == MO_OK);
  CHECK(schedule->kind == MO_SCHEDULE_COSINE && schedule->peak == 1e-6 && schedule->floor == 1e-6);
  CHECK_INT(schedule->warmup_steps, 10);
  REQUIRE(parse(TRAIN "\"schedule\":{\"kind\":\"constant\",\"peak\":0.5,\"warmup_steps\":0}}") ==
          MO_OK);
  CHECK(schedule->kind == MO_SCHEDULE_CONSTANT && schedule->peak == 0.5 &&
        schedule->warmup_steps == 0);
  REQUIRE(parse(TRAIN "\"schedule\":{\"kind\":\"restarts\"}}") == MO_OK);
  CHECK(schedule->peak == 1e-3 && schedule->cycle_steps == 10 && schedule->cycle_growth == 2);
}

static const struct check_case cases[] = {
    {"defaults", defaults},
    {"everything", everything},
    {"presets", presets},
    {"schedules", schedules},
};
CHECK_MAIN(cases)
