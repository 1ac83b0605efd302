/* certificate_request.c: the body of POST /v1/certificates.
 *
 * If a request names a population, settings that it leaves out are taken from that job at
 * submission, so the parser records which settings were given. */
#include "api/certificate_request.h"

#include "rollout/physics.h"

#define BEST 20 /* designs of a population, unless the request says how many */

static void read_population(struct mo_json *json, void *value)
{
  struct mo_parsed_certificate *parsed = value;
  struct mo_certificate_request *request = &parsed->request;
  parsed->has_population = true;
  mo_read_population(json, MO_CERTIFICATE_DESIGNS_MAX, &parsed->population_kind,
                     &request->record.population, &request->best, NULL);
}

static void read_physics(struct mo_json *json, void *value)
{
  struct mo_certificate_request *request = value;
  request->has_physics = true;
  mo_fields_read(json, &mo_physics_fields, &request->physics);
}

#define AT(member) offsetof(struct mo_parsed_certificate, member)
static const struct mo_field_own population = {.read = read_population};
static const struct mo_field_own physics = {.read = read_physics};
static const struct mo_field rows[] = {
    {"designs", MO_FIELD_OWN, 0, AT(parts), .own = &mo_designs_field},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_design_rules_fields},
    {"population", MO_FIELD_OWN, 0, 0, .own = &population, .unit = "",
     .help = "the best designs of another job"},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"physics", MO_FIELD_OWN, 0, AT(request), .group = &mo_physics_fields, .own = &physics},
    {NULL, MO_FIELD_INLINE, 0, AT(request.record.settings), .group = &mo_certificate_fields},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
};
#undef AT
const struct mo_fields mo_certificate_request_fields = MO_FIELDS(rows);

static void check_designs(struct mo_json *json, const struct mo_parsed_certificate *parsed)
{
  const struct mo_parts *parts = &parsed->parts;
  if (parts->has_designs == parsed->has_population)
    mo_json_fault_at(json, 0, "", "%s; a certificate needs exactly one of them",
                     parts->has_designs ? "both designs and population are given"
                                        : "neither designs nor population is given");
  else if (parts->has_designs && parts->n_designs == 0 && parts->n_skipped > 0)
    mo_json_fault_at(json, 0, "/designs",
                     "every design is invalid and was skipped; give at least one valid design");
}

static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_certificate *parsed = any;
  struct mo_certificate_request *request = &parsed->request;
  const struct mo_parts *parts = &parsed->parts;
  struct mo_message message;
  check_designs(json, parsed);
  if (mo_physics_check(&request->physics, &message) == MO_ERR_RANGE)
    mo_json_fault_at(json, 0, "/physics", "%s", message.text);
  else if (request->has_physics || request->record.population == 0)
    mo_parts_check_factors(json, &parsed->parts, &request->physics, NULL);
  /* The other settings were checked when they were read. */
  if (json->faults->n == 0 && mo_certificate_check(&request->record.settings, &message) != MO_OK)
    mo_json_fault_at(json, 0, "/ranges", "%s", message.text);
  if (parts->no_controller)
    mo_json_fault_at(json, 0, "/controller", "must be a controller's name, got null");
  if (parts->job.priority == MO_INTERACTIVE)
    mo_json_fault_at(json, 0, "/priority",
                     "must be \"batch\": a certificate takes too long to run ahead of other work");
  return MO_OK;
}

int mo_certificate_parse(const char *text, size_t size, struct mo_parsed_certificate *parsed,
                         struct mo_faults *faults)
{
  struct mo_certificate_request *request = &parsed->request;
  struct mo_parts *parts = &parsed->parts;
  *parsed =
      (struct mo_parsed_certificate){.request = {.physics = mo_default_physics(),
                                                 .record = {.settings = mo_certificate_defaults()},
                                                 .best = BEST},
                                     .parts = {.job = {.priority = MO_BATCH, .weight = 1},
                                               .most_designs = MO_CERTIFICATE_DESIGNS_MAX},
                                     .population_kind = MO_JOB_EVALUATION};
  mo_read_words(text, size, &mo_design_rules_fields, parts, NULL);
  const int error =
      mo_read_body(text, size, &mo_certificate_request_fields, parsed, parts, check, faults);
  request->controller = mo_parts_controller(parts);
  request->job = parts->job;
  request->genotypes = parts->genotypes;
  request->n_designs = parts->n_designs;
  request->notes = parts->notes;
  request->n_notes = parts->n_notes;
  request->has_environments = parts->has_environments;
  request->environments = parts->environments;
  request->n_environments = parts->n_environments;
  request->environment_set = mo_parts_set(parts);
  return error;
}
