/* The body of POST /v1/evaluations: what is read. Faults and their places
 * are in tests/api/test_invalid.py. */
#include "unit/check.h"

#include "api/requests.h"

static struct mo_parsed_evaluation parsed;
static struct mo_faults faults;

static int parse(const char *text)
{
  mo_parts_free(&parsed.parts);
  faults = (struct mo_faults){0};
  return mo_evaluation_parse(text, strlen(text), &parsed, &faults);
}

static void defaults(void)
{
  REQUIRE(parse("{\"designs\":[{\"cells\":[[1,1,0],[1,1,1]]}]}") == MO_OK);
  CHECK_INT(parsed.request.n_designs, 1);
  CHECK_TEXT(parsed.request.environment_set, "paper-test");
  CHECK_TEXT(parsed.request.controller, "default");
  CHECK_INT(parsed.request.priority, -1);
  CHECK(parsed.request.precision == MO_FLOAT32 && !parsed.request.verify &&
        parsed.request.label == NULL);
  CHECK(parsed.request.record == 0 && parsed.request.record_stride == 10);
  CHECK(parsed.request.physics.impact == MO_IMPACT_EXACT && parsed.request.physics.n_steps == 1000);
  CHECK_INT(mo_genotype_count(MO_DEFAULT_WORKSPACE, parsed.request.genotypes[0].words), 2);
}

static void everything(void)
{
  char text[4096], heights[600] = "0.05";
  for (int i = 1; i < 64; i++)
    strcat(heights, ",0.05");
  snprintf(text, sizeof(text),
           "{\"label\":\"r\\u00e9\",\"verify\":true,\"priority\":\"interactive\",\"precision\":"
           "\"float64\",\"record_"
           "stride\":50,"
           "\"record\":[\"masses\",\"com\"],\"physics\":{\"impact\":\"bisection12\",\"n_steps\":"
           "500,\"dt_s\":0.002},"
           "\"controller\":\"bootstrap\",\"environments\":[{\"light_xy_m\":[4.5,2.5],\"terrain_"
           "heights_m\":[%s]},"
           "{\"seed\":3,\"terrain_sigma_m\":0.1,\"light_xy_m\":[1,1]}],\"designs\":[{\"voxels\":"
           "\"1%0143d\"},{"
           "\"cells\":[[5,5,3]]}]}",
           heights, 0);
  int code = parse(text);
  if (code != MO_OK)
    printf("# %s %s\n", faults.items[0].where, faults.items[0].detail);
  REQUIRE(code == MO_OK);
  const struct mo_evaluation_request *r = &parsed.request;
  CHECK(r->n_designs == 2 && r->n_environments == 2 && r->environment_set == NULL);
  CHECK_TEXT(r->label, "ré");
  CHECK(r->verify && r->priority == MO_INTERACTIVE && r->precision == MO_FLOAT64 &&
        r->record_stride == 50);
  CHECK(r->record == (MO_RECORD_COM | MO_RECORD_MASSES) && r->physics.bisections == 12 &&
        r->physics.impact == MO_IMPACT_BISECTION);
  CHECK(r->physics.n_steps == 500 && r->physics.dt_s == 0.002 && r->physics.mass_kg == 1);
  double expected[MO_TERRAIN_HEIGHTS];
  mo_terrain_random(3, 0, 0, 0.1, expected);
  CHECK(memcmp(r->environments[1].terrain_heights_m, expected, sizeof(expected)) == 0);
  /* An id is another way to say the same. */
  char id[MO_DEFAULT_ID_DIGITS + 1];
  mo_genotype_id(MO_DEFAULT_WORKSPACE, r->genotypes[0].words, id);
  snprintf(text, sizeof(text), "{\"designs\":[{\"id\":\"%s\"}]}", id);
  REQUIRE(parse(text) == MO_OK);
  char again[MO_DEFAULT_ID_DIGITS + 1];
  mo_genotype_id(MO_DEFAULT_WORKSPACE, parsed.request.genotypes[0].words, again);
  CHECK_TEXT(again, id);
}

static const struct check_case cases[] = {{"defaults", defaults}, {"everything", everything}};
CHECK_MAIN(cases)
