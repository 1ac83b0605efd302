/* The body of POST /v1/trainings: defaults by kind and preset, each fault at its place, all of them
 * at once. */
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

static void places(void)
{
  static const struct {
    const char *text, *where;
  } tries[] = {
      {"[]", ""},
      {"{}", ""},
      {"{\"kind\":7}", "/kind"},
      {"{\"kind\":\"train\"}", "/kind"},
      {"{\"kind\":\"finetune\"}", ""},
      {"{\"kind\":\"finetune\"," DESIGNS ",\"population\":{\"evaluation\":\"1\"}}", ""},
      {TRAIN "\"preset\":\"Paper\"}", "/preset"},
      {TRAIN "\"preset\":\"demo\"}", "/preset"},
      {TRAIN "\"preset\":\"\"}", "/preset"},
      {TRAIN "\"preset\":null}", "/preset"},
      {TRAIN "\"preset\":{\"name\":\"paper\"}}", "/preset"},
      {TRAIN "\"preset\":\"paper of which the name is far too long\"}", "/preset"},
      {TUNE "\"preset\":\"phototaxis\"}", "/preset"},
      {TRAIN "\"preset\":\"paper\",\"steps\":32769}", "/steps"},
      {TUNE "\"controller\":null}", "/controller"},
      {TUNE "\"controller\":\"Not A Name\"}", "/controller"},
      {TUNE "\"controller\":5}", "/controller"},
      {TUNE "\"controller\":\"sha256:12\"}", "/controller"},
      {TUNE "\"sensor\":\"inverse_sqrt\"}", "/sensor"},
      {TRAIN "\"sensor\":\"inverse_sqrt\",\"controller\":\"default\"}", "/sensor"},
      {TRAIN "\"sensor\":\"linear\"}", "/sensor"},
      {TRAIN DESIGNS "}", "/designs"},
      {TRAIN "\"population\":{\"evaluation\":\"1\"}}", "/population"},
      {"{\"kind\":\"finetune\",\"designs\":[]}", "/designs"},
      {"{\"kind\":\"finetune\",\"designs\":[{\"cells\":[[0,0,4]]}]}", "/designs/0/cells/0/2"},
      {"{\"kind\":\"finetune\",\"population\":12}", "/population"},
      {"{\"kind\":\"finetune\",\"population\":{}}", "/population"},
      {"{\"kind\":\"finetune\",\"population\":{\"evaluation\":12}}", "/population/evaluation"},
      {"{\"kind\":\"finetune\",\"population\":{\"evaluation\":\"\"}}", "/population/evaluation"},
      {"{\"kind\":\"finetune\",\"population\":{\"evaluation\":\"012\"}}", "/population/evaluation"},
      {"{\"kind\":\"finetune\",\"population\":{\"evaluation\":\"-1\"}}", "/population/evaluation"},
      {"{\"kind\":\"finetune\",\"population\":{\"evaluation\":\"12\",\"best\":0}}",
       "/population/best"},
      {"{\"kind\":\"finetune\",\"population\":{\"evaluation\":\"12\",\"worst\":1}}",
       "/population/worst"},
      {TRAIN "\"name\":\"\"}", "/name"},
      {TRAIN "\"name\":\"A\"}", "/name"},
      {TRAIN "\"name\":\"12345678901234567890123456789012345678901234567890123456789012345\"}",
       "/name"},
      {TRAIN "\"name\":null}", "/name"},
      {TRAIN "\"steps\":0}", "/steps"},
      {TRAIN "\"steps\":1000000000}", "/steps"},
      {TRAIN "\"steps\":1000001}", "/steps"},
      {TRAIN "\"steps\":1.5}", "/steps"},
      {TRAIN "\"steps\":\"60\"}", "/steps"},
      {TRAIN "\"steps\":1000000,\"batch\":65536}", "/steps"},
      {TRAIN "\"batch\":0}", "/batch"},
      {TRAIN "\"batch\":-1}", "/batch"},
      {TRAIN "\"batch\":65537}", "/batch"},
      {TRAIN "\"seed\":-1}", "/seed"},
      {TRAIN "\"seed\":9007199254740992}", "/seed"},
      {TRAIN "\"schedule\":\"cosine\"}", "/schedule"},
      {TRAIN "\"schedule\":7}", "/schedule"},
      {TRAIN "\"schedule\":null}", "/schedule"},
      {TRAIN "\"schedule\":{\"peak\":1}}", "/schedule"},
      {TRAIN "\"schedule\":{\"kind\":\"linear\"}}", "/schedule/kind"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":-1e-3}}", "/schedule/peak"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":0}}", "/schedule/peak"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":1e400}}", "/schedule/peak"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":2}}", "/schedule/peak"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":\"fast\"}}", "/schedule/peak"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":1e-3,\"floor\":1e-2}}", "/schedule/floor"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"floor\":0}}", "/schedule/floor"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"decay\":0}}", "/schedule/decay"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"decay\":1.5}}", "/schedule/decay"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"cycle_steps\":0}}", "/schedule/cycle_steps"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"cycle_growth\":0}}", "/schedule/cycle_growth"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"cycle_growth\":1001}}",
       "/schedule/cycle_growth"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"warmup_steps\":-1}}", "/schedule/warmup_steps"},
      {TRAIN "\"schedule\":{\"kind\":\"restarts\",\"warm\":1}}", "/schedule/warm"},
      {TRAIN "\"adam\":[]}", "/adam"},
      {TRAIN "\"adam\":{\"beta1\":1}}", "/adam/beta1"},
      {TRAIN "\"adam\":{\"beta2\":-0.1}}", "/adam/beta2"},
      {TRAIN "\"adam\":{\"epsilon\":0}}", "/adam/epsilon"},
      {TRAIN "\"adam\":{\"gamma\":0}}", "/adam/gamma"},
      {TRAIN "\"gradient_norm_limit\":-1}", "/gradient_norm_limit"},
      {TRAIN "\"gradient_norm_limit\":1e400}", "/gradient_norm_limit"},
      {TRAIN "\"gradient_norm_limit\":1e7}", "/gradient_norm_limit"},
      {TRAIN "\"adjoint_bound\":-2}", "/adjoint_bound"},
      {TRAIN "\"adjoint_bound\":\"off\"}", "/adjoint_bound"},
      {TRAIN "\"adjoint_rule\":1}", "/adjoint_rule"},
      {TRAIN "\"adjoint_rule\":\"Restart\"}", "/adjoint_rule"},
      {TRAIN "\"adjoint_rule\":null}", "/adjoint_rule"},
      {TRAIN "\"restart_weight\":-1}", "/restart_weight"},
      {TRAIN "\"restart_weight\":1e7}", "/restart_weight"},
      {TRAIN "\"restart_weight\":\"3\"}", "/restart_weight"},
      {TRAIN "\"restart_weight\":null}", "/restart_weight"},
      {TRAIN "\"physics\":{\"dt_s\":0}}", "/physics/dt_s"},
      {TRAIN "\"physics\":{\"gravity\":0}}", "/physics/gravity"},
      {TRAIN "\"validation\":{\"every_steps\":-1}}", "/validation/every_steps"},
      {TRAIN "\"validation\":{\"designs\":0}}", "/validation/designs"},
      {TRAIN "\"validation\":{\"designs\":10001}}", "/validation/designs"},
      {TRAIN "\"validation\":{\"environments\":65}}", "/validation/environments"},
      {TRAIN "\"validation\":{\"every\":5}}", "/validation/every"},
      {TRAIN "\"validation\":50}", "/validation"},
      {TRAIN "\"checkpoint\":{\"every_steps\":-1}}", "/checkpoint/every_steps"},
      {TRAIN "\"checkpoint\":{\"every_s\":86401}}", "/checkpoint/every_s"},
      {TRAIN "\"checkpoint\":{\"keep\":0}}", "/checkpoint/keep"},
      {TRAIN "\"checkpoint\":{\"keep\":101}}", "/checkpoint/keep"},
      {TRAIN "\"checkpoint\":{\"path\":\"/\"}}", "/checkpoint/path"},
      {TRAIN "\"priority\":\"urgent\"}", "/priority"},
      {TRAIN "\"label\":7}", "/label"},
      {TRAIN "\"epochs\":7}", "/epochs"},
  };
  for (size_t i = 0; i < sizeof(tries) / sizeof(tries[0]); i++) {
    CHECK_INT(parse(tries[i].text), MO_ERR_INVALID);
    CHECK_INT(faults.n, 1);
    CHECK_TEXT(faults.items[0].where, tries[i].where);
    if (faults.n != 1 || strcmp(faults.items[0].where, tries[i].where) != 0)
      printf("# %s: %s\n", tries[i].text, faults.items[0].detail);
    /* What would be right. */
    static const char *const words[] = {"expected", "missing", "exactly one", "must be"};
    bool says = false;
    for (size_t w = 0; w < 4; w++)
      says |= strstr(faults.items[0].detail, words[w]) != NULL;
    CHECK(says);
    if (!says)
      printf("# %s\n", faults.items[0].detail);
  }
  CHECK_INT(parse(TRAIN "\"steps\":NaN}"), MO_ERR_FORMAT);
  CHECK_TEXT(faults.items[0].where, "/steps");
  CHECK_INT(parse("{\"kind\":\"pretrain\",\"kind\":\"finetune\"}"), MO_ERR_FORMAT);
  CHECK_INT(parse(""), MO_ERR_FORMAT);
}

/* A number just beyond its bound never looks like the bound. */
static void digits(void)
{
  static const struct {
    const char *text, *says;
  } tries[] = {
      {TRAIN "\"restart_weight\":1000000.0000001}",
       "must be at least 0 and at most 1e+06, got 1000000.0000001"},
      {TRAIN "\"weight\":1000.0000000001}",
       "must be at least 0.001 and at most 1000, got 1000.0000000001"},
      {TRAIN "\"gradient_norm_limit\":1000000.0000001}",
       "must be at least 0 and at most 1e+06, got 1000000.0000001"},
      {TRAIN "\"adam\":{\"epsilon\":1.0000000001}}",
       "must be above 0 and at most 1, got 1.0000000001"},
      {TRAIN "\"schedule\":{\"kind\":\"cosine\",\"peak\":0.5,\"floor\":0.5000000001}}",
       "must be at most the peak, which is 0.5, got 0.5000000001"},
      {TRAIN "\"physics\":{\"dt_s\":0.1000000001}}",
       "must be at least 1e-07 and at most 0.1, got 0.1000000001"},
  };
  for (size_t i = 0; i < sizeof(tries) / sizeof(tries[0]); i++) {
    CHECK_INT(parse(tries[i].text), MO_ERR_INVALID);
    CHECK_INT(faults.n, 1);
    if (strstr(faults.items[0].detail, tries[i].says) == NULL) {
      printf("# \"%s\" lacks \"%s\"\n", faults.items[0].detail, tries[i].says);
      CHECK(0);
    }
  }
}

static void all_at_once(void)
{
  static const char *const where[] = {"/steps",         "/batch",  "/schedule/peak",
                                      "/adjoint_bound", "/epochs", "/sensor"};
  CHECK_INT(parse(TUNE "\"steps\":1e9,\"batch\":0,\"schedule\":{\"kind\":\"cosine\",\"peak\":-1},"
                       "\"adjoint_bound\":-1,"
                       "\"epochs\":3,\"controller\":\"walker\",\"sensor\":\"inverse_sqrt\"}"),
            MO_ERR_INVALID);
  REQUIRE(faults.n == 6);
  for (unsigned i = 0; i < 6; i++)
    CHECK_TEXT(faults.items[i].where, where[i]);
  CHECK_TEXT(parsed.request.parent, "walker"); /* to be looked up besides */
}

static const struct check_case cases[] = {
    {"defaults", defaults},
    {"everything", everything},
    {"presets", presets},
    {"schedules", schedules},
    {"every fault has its place, and is the only one", places},
    {"numbers just beyond their bounds", digits},
    {"all faults at once", all_at_once},
};
CHECK_MAIN(cases)
