/* study_compare.c: see study_compare.h.
 *
 * The body is read a second time, over the study's settings instead of the defaults. If a setting
 * differs after that, the request gave it a different value. */
#include "api/study_compare.h"

#include <stdio.h>
#include <string.h>

#include "api/requests.h"
#include "store/fields.h"
#include "world/environment.h"
#include "world/factors.h"
#include "world/task_json.h"

#define VALUE_SHOWN 88 /* bytes of a value in a message */

struct comparison {
  const struct mo_campaign_status *status;
  struct mo_faults *faults;
  int error;
};

static void add(struct comparison *comparison, const char *pointer, const char *given,
                const char *known)
{
  char texts[2][VALUE_SHOWN + 4];
  mo_faults_add(comparison->faults, MO_FAULT_BODY, pointer, "got %s, but study %lld has %s",
                mo_cut_text(given, VALUE_SHOWN, texts[0]), (long long)comparison->status->job.id,
                mo_cut_text(known, VALUE_SHOWN, texts[1]));
}

static void differs(void *context, const char *pointer, const char *given, const char *known)
{
  struct comparison *comparison = context;
  if (given == NULL || known == NULL)
    comparison->error = MO_ERR_NO_MEMORY;
  else
    add(comparison, pointer, given, known);
}

static void compare_texts(struct comparison *comparison, const char *pointer, const char *given,
                          const char *known)
{
  if (strcmp(given, known) != 0)
    add(comparison, pointer, given, known[0] != '\0' ? known : "none");
}

/* Returns the record with the mutation rate as a number. A rate of null means one voxel on average,
 * which is the same setting. */
static struct mo_campaign_record in_numbers(const struct mo_campaign_record *record)
{
  struct mo_campaign_record shown = *record;
  if (shown.settings.mutation_rate == 0)
    shown.settings.mutation_rate = 1.0 / mo_workspace_voxels(shown.settings.workspace);
  return shown;
}

/* ---- environments ---- */

/* Writes numbers as JSON; a single number has no brackets. */
static void show(const double *numbers, uint32_t n, char text[VALUE_SHOWN])
{
  size_t at = (size_t)snprintf(text, VALUE_SHOWN, "%s", n > 1 ? "[" : "");
  for (uint32_t i = 0; i < n && at < VALUE_SHOWN; i++)
    at += (size_t)snprintf(text + at, VALUE_SHOWN - at, "%s%.12g", i > 0 ? ", " : "", numbers[i]);
  if (n > 1 && at < VALUE_SHOWN)
    snprintf(text + at, VALUE_SHOWN - at, "]");
}

/* For a table, shows only the first number that differs, because all numbers of a drawn terrain
 * would differ. */
static void compare_numbers(struct comparison *comparison, const struct mo_field *field,
                            uint32_t place, const double *given, const double *known)
{
  const uint32_t n = field->type == MO_FIELD_NUMBERS ? field->n : 1;
  char pointer[64], a[VALUE_SHOWN], b[VALUE_SHOWN];
  uint32_t i = 0;
  while (i < n && given[i] == known[i])
    i++;
  if (i == n)
    return;
  const uint32_t first = field->side > 0 ? i : 0, shown = field->side > 0 ? 1 : n;
  const int at = snprintf(pointer, sizeof(pointer), "/environments/%u/%s", place, field->name);
  if (field->side > 0)
    snprintf(pointer + at, sizeof(pointer) - (size_t)at, "/%u", i);
  show(given + first, shown, a);
  show(known + first, shown, b);
  add(comparison, pointer, a, b);
}

static void compare_tasks(struct comparison *comparison, uint32_t place,
                          const struct mo_environment *given, const struct mo_environment *known)
{
  struct mo_text texts[2] = {{0}, {0}};
  char pointer[64];
  snprintf(pointer, sizeof(pointer), "/environments/%u/task", place);
  mo_task_write(&texts[0], given);
  mo_task_write(&texts[1], known);
  if (texts[0].failed || texts[1].failed)
    comparison->error = MO_ERR_NO_MEMORY;
  else if (strcmp(texts[0].data, texts[1].data) != 0)
    add(comparison, pointer, texts[0].data, texts[1].data);
  mo_text_free(&texts[0]);
  mo_text_free(&texts[1]);
}

static void describe_damage(const struct mo_damage *damage, char text[VALUE_SHOWN])
{
  if (damage->cut == 0)
    snprintf(text, VALUE_SHOWN, "none");
  else
    snprintf(text, VALUE_SHOWN, "octant %u at %.12g s", damage->cut - 1, damage->time_s);
}

static void compare_damage(struct comparison *comparison, uint32_t place,
                           const struct mo_environment *given, const struct mo_environment *known)
{
  char pointer[64], a[VALUE_SHOWN], b[VALUE_SHOWN];
  snprintf(pointer, sizeof(pointer), "/environments/%u/damage", place);
  describe_damage(&given->damage, a);
  describe_damage(&known->damage, b);
  if (strcmp(a, b) != 0)
    add(comparison, pointer, a, b);
}

static void compare_number(struct comparison *comparison, uint32_t place, const char *below,
                           const double *given, const double *known)
{
  char pointer[96], a[VALUE_SHOWN], b[VALUE_SHOWN];
  if (*given == *known)
    return;
  snprintf(pointer, sizeof(pointer), "/environments/%u/%s", place, below);
  show(given, 1, a);
  show(known, 1, b);
  add(comparison, pointer, a, b);
}

static void compare_factors(struct comparison *comparison, uint32_t place,
                            const struct mo_environment *given, const struct mo_environment *known)
{
  const struct mo_factors ones = mo_factors_ones();
  const struct mo_factors *ours = given->factors.given ? &given->factors : &ones;
  const struct mo_factors *theirs = known->factors.given ? &known->factors : &ones;
  for (size_t i = 0; i < mo_factor_fields.n; i++) {
    const struct mo_field *row = &mo_factor_fields.rows[i];
    char below[48];
    snprintf(below, sizeof(below), "factors/%s", row->name);
    compare_number(comparison, place, below, (const void *)((const char *)ours + row->offset),
                   (const void *)((const char *)theirs + row->offset));
  }
}

static void describe_terrain(const struct mo_environment *environment, char text[VALUE_SHOWN])
{
  const struct mo_terrain_grid *grid = environment->grid;
  if (grid != NULL)
    snprintf(text, VALUE_SHOWN, "a grid of %u rows of %u heights, %.12g m apart", grid->rows,
             grid->columns, grid->spacing_m);
  else if (environment->n_profile == 0)
    snprintf(text, VALUE_SHOWN, "a grid of heights");
  else
    snprintf(text, VALUE_SHOWN, "a profile of %u heights, %.12g m apart", environment->n_profile,
             environment->profile_spacing_m);
}

/* Compares terrains of which at least one is a profile or a custom grid. Shows only the first
 * height that differs. */
static void compare_terrains(struct comparison *comparison, uint32_t place,
                             const struct mo_environment *given, const struct mo_environment *known)
{
  char pointer[64], a[VALUE_SHOWN], b[VALUE_SHOWN];
  uint32_t k = 0;
  describe_terrain(given, a);
  describe_terrain(known, b);
  snprintf(pointer, sizeof(pointer), "/environments/%u/terrain", place);
  if (strcmp(a, b) != 0 || (given->grid == NULL) != (known->grid == NULL)) {
    add(comparison, pointer, a, b);
    return;
  }
  const struct mo_terrain_grid *grid = given->grid;
  const uint32_t n = grid != NULL ? grid->columns * grid->rows : given->n_profile;
  const double *ours = grid != NULL ? grid->heights_m : given->terrain_heights_m;
  const double *theirs = grid != NULL ? known->grid->heights_m : known->terrain_heights_m;
  while (k < n && ours[k] == theirs[k])
    k++;
  if (k == n)
    return;
  if (grid != NULL)
    snprintf(pointer, sizeof(pointer), "/environments/%u/terrain/heights_m/%u/%u", place,
             k / grid->columns, k % grid->columns);
  else
    snprintf(pointer, sizeof(pointer), "/environments/%u/terrain/heights_m/%u", place, k);
  show(&ours[k], 1, a);
  show(&theirs[k], 1, b);
  add(comparison, pointer, a, b);
}

static void compare_environment(struct comparison *comparison, uint32_t place,
                                const struct mo_environment *given,
                                const struct mo_environment *known)
{
  for (size_t i = 0; i < mo_place_fields.n; i++) {
    const struct mo_field *field = &mo_place_fields.rows[i];
    if (i == MO_PLACE_HEIGHTS && (!mo_place_has(given, i) || !mo_place_has(known, i)))
      compare_terrains(comparison, place, given, known);
    else if (mo_place_has(given, i) && mo_place_has(known, i))
      compare_numbers(comparison, field, place, mo_environment_numbers(given, field),
                      mo_environment_numbers(known, field));
  }
  compare_tasks(comparison, place, given, known);
  compare_damage(comparison, place, given, known);
  compare_factors(comparison, place, given, known);
  compare_number(comparison, place, "drop_m", &given->drop_m, &known->drop_m);
}

static void compare_environments(struct comparison *comparison, const struct mo_parts *parts,
                                 const struct mo_environment *known)
{
  const struct mo_campaign_record *record = &comparison->status->record;
  const bool is_set = record->environment_set[0] != '\0';
  char a[64], b[64];
  if (!parts->has_environments)
    return;
  if (parts->environments == NULL && strcmp(mo_parts_set(parts), record->environment_set) == 0)
    return;
  snprintf(a, sizeof(a), "a list of %u", (unsigned)parts->n_environments);
  snprintf(b, sizeof(b), "a list of %u", (unsigned)record->n_environments);
  if (parts->environments == NULL)
    add(comparison, "/environments", mo_parts_set(parts), is_set ? record->environment_set : b);
  else if (parts->n_environments != record->n_environments)
    add(comparison, "/environments", a, is_set ? record->environment_set : b);
  else
    for (uint32_t i = 0; i < parts->n_environments; i++)
      compare_environment(comparison, i, &parts->environments[i], &known[i]);
}

/* ---- settings that do not belong to the search ---- */

static void compare_job(struct comparison *comparison, const struct mo_parsed_campaign *parsed)
{
  static const char *const devices[] = {[MO_ON_CPU] = "\"cpu\"", [MO_ON_DEVICE] = "\"cuda\""};
  static const char *const priorities[] = {
      [MO_BATCH] = "\"batch\"", [MO_INTERACTIVE] = "\"interactive\""};
  const struct mo_job *job = &comparison->status->job;
  const struct mo_parts *parts = &parsed->parts;
  if (parts->job.back_end >= 0 && parts->job.back_end != (int)job->back_end)
    add(comparison, "/device", devices[parts->job.back_end], devices[job->back_end]);
  if (parts->job.priority != (int)job->priority)
    add(comparison, "/priority", priorities[parts->job.priority], priorities[job->priority]);
  if (parts->job.weight != job->weight)
    add(comparison, "/weight", MO_NUMBER(parts->job.weight), MO_NUMBER(job->weight));
  if (parts->experiment[0] != '\0')
    compare_texts(comparison, "/experiment", parts->experiment, job->experiment);
}

static void compare_own_scores(struct comparison *comparison, const struct mo_own_score *given,
                               const struct mo_own_score *known)
{
  struct mo_text texts[2] = {{0}, {0}};
  if (mo_own_score_equal(given, known))
    return;
  mo_own_score_field.write(&texts[0], given);
  mo_own_score_field.write(&texts[1], known);
  if (texts[0].failed || texts[1].failed)
    comparison->error = MO_ERR_NO_MEMORY;
  else
    add(comparison, "/own_score", texts[0].data, texts[1].data);
  mo_text_free(&texts[0]);
  mo_text_free(&texts[1]);
}

static void compare_controller(struct comparison *comparison, const struct mo_parts *parts,
                               const struct mo_sha256 *controller)
{
  const struct mo_job *job = &comparison->status->job;
  char given[VALUE_SHOWN], known[VALUE_SHOWN];
  if (!parts->has_controller || mo_sha256_equal(controller, &job->controller_sha256))
    return;
  snprintf(given, sizeof(given), "%.30s (SHA-256 %.12s…)", parts->controller,
           MO_SHA256_HEX(controller));
  snprintf(known, sizeof(known), "%.30s (SHA-256 %.12s…)", job->controller_name,
           MO_SHA256_HEX(&job->controller_sha256));
  add(comparison, "/controller", given, known);
}

int mo_study_compare(const char *text, size_t size, const struct mo_campaign_status *status,
                     const struct mo_environment *environments, const struct mo_sha256 *controller,
                     struct mo_faults *faults)
{
  struct comparison comparison = {.status = status, .faults = faults};
  struct mo_faults read = {0}; /* the first pass found no faults */
  struct mo_parsed_campaign parsed = {
      .request.record = status->record,
      .parts.job = {.priority = (int)status->job.priority, .weight = status->job.weight},
      .preset = -1};
  struct mo_campaign_record given, known = in_numbers(&status->record);
  if (status->record.select_by.is_set) /* the service chose its name */
    known.own_score = parsed.request.record.own_score = (struct mo_own_score){.name = ""};
  comparison.error =
      mo_read_body(text, size, &mo_campaign_request_fields, &parsed, &parsed.parts, NULL, &read);
  /* It is one of the measures, whether or not the list names it. */
  if (parsed.request.record.select_by.is_set)
    parsed.request.record.measures |= UINT32_C(1) << parsed.request.record.select_by.measure;
  given = in_numbers(&parsed.request.record);
  given.settings.generations = known.settings.generations; /* the client can send any number of
                                                            * them */
  if (comparison.error == MO_OK) {
    mo_fields_compare(&mo_campaign_record_fields, "", &given, &known, differs, &comparison);
    if (parsed.preset >= 0)
      compare_texts(&comparison, "/preset", mo_preset_words[parsed.preset], status->record.preset);
    compare_environments(&comparison, &parsed.parts, environments);
    compare_own_scores(&comparison, &given.own_score, &known.own_score);
    compare_controller(&comparison, &parsed.parts, controller);
    compare_job(&comparison, &parsed);
  }
  mo_parts_free(&parsed.parts);
  return comparison.error;
}
