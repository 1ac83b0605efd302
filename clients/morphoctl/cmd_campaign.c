/* cmd_campaign.c: campaign start, extend, champions, export. */
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "commands.h"
#include "live.h"
#include "results.h"

/* ---- start ---- */

static void fill_workspace(const struct ctl *ctl, json_t *request)
{
  const char *text = option_text(ctl, "workspace", NULL);
  int x, y, z, end = 0;
  if (text == NULL)
    return;
  /* NOLINTNEXTLINE(cert-err34-c): 5 digits fit */
  if (sscanf(text, "%5d,%5d,%5d%n", &x, &y, &z, &end) != 3 || text[end] != 0)
    fail(STATUS_USAGE, "--workspace: \"%s\" is not X,Y,Z, e.g. 6,6,4", text);
  json_object_set_new(request, "workspace", json_pack("[i, i, i]", x, y, z));
}

/* Adds the initial population: the operands, or the population of another campaign. */
static void fill_initial(struct ctl *ctl, json_t *request)
{
  const char *from = option_text(ctl, "from", NULL);
  if (from != NULL && ctl->n_operands > 1)
    fail(STATUS_USAGE, "give either initial designs or --from, not both");
  if (from != NULL)
    json_object_set_new(request, "initial", json_pack("{s:s}", "campaign", job_id(from)));
  if (ctl->n_operands > 1)
    json_object_set_new(request, "initial",
                        json_pack("{s:O}", "designs", given_designs(ctl, 1, NULL).list));
}

/* Adds the measure to select by, as MEASURE,max or MEASURE,min. */
static void fill_select_by(const struct ctl *ctl, json_t *request)
{
  const char *text = option_text(ctl, "select-by", NULL);
  const char *comma = text != NULL ? strchr(text, ',') : NULL;
  if (text == NULL)
    return;
  if (comma == NULL || (strcmp(comma, ",max") != 0 && strcmp(comma, ",min") != 0))
    fail(STATUS_USAGE,
         "--select-by: \"%s\" is not a measure with ,max or ,min, e.g. displacement_m,max", text);
  json_object_set_new(
      request, "select_by",
      json_pack("{s:s%, s:s}", "measure", text, (size_t)(comma - text), "direction", comma + 1));
}

/* Adds how losses become scores, as KIND or KIND:NUMBER. */
static void fill_aggregate(const struct ctl *ctl, json_t *request)
{
  const char *text = option_text(ctl, "aggregate", NULL);
  const char *colon = text != NULL ? strchr(text, ':') : NULL;
  char *end = NULL;
  if (text == NULL)
    return;
  json_t *aggregate = colon != NULL ? json_pack("{s:s%}", "kind", text, (size_t)(colon - text))
                                    : json_pack("{s:s}", "kind", text);
  const double number = colon != NULL ? strtod(colon + 1, &end) : 0;
  if (aggregate == NULL ||
      (colon != NULL && (colon[1] == '\0' || *end != '\0' || !isfinite(number))))
    fail(STATUS_USAGE,
         "--aggregate: \"%s\" is not a kind, optionally with a number, e.g. cvar:0.9 or mean-sd:1",
         text);
  if (colon != NULL)
    json_object_set_new(aggregate,
                        strncmp(text, "mean-sd:", strlen("mean-sd:")) == 0 ? "weight" : "level",
                        json_real(number));
  json_object_set_new(request, "aggregate", aggregate);
}

/* Adds when the best designs are scored in fresh worlds, as EVERY or EVERY:ENVIRONMENTS. */
static void fill_re_evaluate(const struct ctl *ctl, json_t *request)
{
  const char *text = option_text(ctl, "re-evaluate", NULL);
  long long every = 0, environments = 0;
  char *end = NULL;
  if (text == NULL)
    return;
  every = strtoll(text, &end, 10);
  const bool has_worlds = end != text && *end == ':';
  if (has_worlds)
    environments = strtoll(end + 1, &end, 10);
  if (every < 1 || (has_worlds && environments < 1) || *end != '\0')
    fail(STATUS_USAGE,
         "--re-evaluate: \"%s\" is not a number of generations, optionally with a number of "
         "environments, e.g. 10 or 10:64",
         text);
  json_t *value = need(json_pack("{s:I}", "every", (json_int_t)every));
  if (has_worlds)
    json_object_set_new(value, "environments", json_integer(environments));
  json_object_set_new(request, "re_evaluate", value);
}

void run_campaign_start(struct ctl *ctl)
{
  json_t *request = json_pack("{s:s}", "mode", ctl->operands[0]);
  const char *controller = option_text(ctl, "controller", NULL);
  if (request == NULL)
    fail(STATUS_USAGE, "the mode is not UTF-8");
  fill_workspace(ctl, keep(request));
  fill_schedule(ctl, request, "learning.schedule");
  fill_initial(ctl, request);
  request_fill_measures(ctl, request);
  fill_select_by(ctl, request);
  fill_aggregate(ctl, request);
  fill_re_evaluate(ctl, request);
  request_fill(ctl, request);
  if (controller != NULL && strcmp(controller, "random") == 0)
    json_object_set_new(request, "controller", json_null());
  if (option_is_set(ctl, "no-exclusions"))
    json_object_set_new(request, "exclude_pretraining", json_false());
  live_start(ctl, request);
}

/* ---- extend ---- */

void run_campaign_extend(struct ctl *ctl)
{
  const char *id = job_id(ctl->operands[0]), *more = ctl->operands[1];
  char *end;
  long long generations = strtoll(more, &end, 10);
  if (*more == 0 || *end != 0 || generations < 1 || generations > 1000000)
    fail(STATUS_USAGE, "\"%s\" is not a number of additional generations", more);
  const json_t *request = keep(json_pack("{sI}", "generations", (json_int_t)generations));
  tell(ctl, post_job(ctl, path_to("/v1/campaigns/%s/extend", id), request, 0),
       "campaign {id} is {state}, to generation {progress.generations}");
}

/* ---- champions ---- */

/* Re-evaluates the champions with recording; saves their trajectories in a folder (nullable), and
 * films them with --film. */
static void record_champions(struct ctl *ctl, const char *id, int64_t count, const char *folder)
{
  const int64_t stride = option_number(ctl, "record-stride", 1, 1000000, 10);
  json_t *request =
      keep(json_pack("{s:I, s:I}", "count", (json_int_t)count, "stride", (json_int_t)stride));
  request_fill_record(ctl, request, folder != NULL ? "com" : NULL);
  const json_t *evaluation =
      evaluate(ctl, path_to("/v1/campaigns/%s/champions", id), request, true);
  expect_success("job", evaluation);
  if (folder != NULL)
    save_trajectories(ctl, evaluation, folder);
  film_evaluation(ctl, evaluation);
}

#define HELD_OUT_COLUMNS                                                                           \
  "|>held out=[{held_out.mean:.4f}|–]|95 % interval=[{held_out.low:.4f} to {held_out.high:.4f}|–]"
#define CERTIFICATE_COLUMN "|certificate=[{certificate.id} ({certificate.class})|–]"

/* Returns how many items of the list have this object. */
static size_t count_with(const json_t *list, const char *name)
{
  const json_t *items = json_object_get(list, "items"), *item;
  size_t i, n = 0;
  json_array_foreach(items, i, item) n += json_is_object(json_object_get(item, name));
  return n;
}

void run_campaign_champions(struct ctl *ctl)
{
  const char *id = job_id(ctl->operands[0]), *folder = option_text(ctl, "output", NULL);
  const bool records = folder != NULL || option_is_set(ctl, "film");
  const int64_t count = option_number(ctl, "count", 1, 1000, 12),
                generation = option_number(ctl, "generation", 0, 1000000, -1);
  if (!records && (option_is_set(ctl, "record-stride") || option_is_set(ctl, "record")))
    fail(STATUS_USAGE, "--record and --record-stride need --output or --film");
  if (records && generation >= 0)
    fail(STATUS_USAGE, "--output and --film record the newest generation, so they cannot be "
                       "combined with --generation");
  film_check(ctl);
  const json_t *champions =
      get_json(ctl, "/v1/campaigns/%s/champions?count=%" PRId64 "%s", id, count,
               generation >= 0 ? path_to("&generation=%" PRId64, generation) : "");
  print_items(
      ctl, champions,
      keep(format_text(">number={number}|design={robot}|>voxels={voxels:,}|>footprint={footprint:,}"
                       "|>score={score:.4f}%s%s%s|>distinctness={distinctiveness:.4f}"
                       "|born={operator}|>generation={born:,}",
                       count_with(champions, "held_out") > 0 ? HELD_OUT_COLUMNS : "",
                       count_with(champions, "certificate") > 0 ? CERTIFICATE_COLUMN : "",
                       measure_columns(value_at(champions, "items.0.measures")))));
  if (!ctl->json && !ctl->quiet && *text_of(champions, "fresh_worlds") != '\0')
    print_plain_line(stderr, "held out: %s", text_of(champions, "fresh_worlds"));
  if (!ctl->json && !ctl->quiet && json_is_object(json_object_get(champions, "re_evaluated")) &&
      count_with(champions, "held_out") < json_array_size(json_object_get(champions, "items")))
    print_from(stderr, champions,
               "held out –: not in the re-evaluation of generation {re_evaluated.generation} (its "
               "best {re_evaluated.designs} and its {re_evaluated.champions} champions, without "
               "those that diverged), nor in an earlier one");
  if (records)
    record_champions(ctl, id, count, folder);
}

/* ---- export ---- */

/* Writes a population, best first, as designs that `eval` and `train start` can read. */
static void export_population(struct ctl *ctl, const char *id, const char *output)
{
  const int64_t generation = option_number(ctl, "generation", 0, 1000000, -1);
  const char *at = generation >= 0 ? path_to("?generation=%" PRId64, generation) : "";
  const json_t *items = collect(ctl, path_to("/v1/campaigns/%s/population%s", id, at), 0), *item;
  char *text = NULL;
  size_t size = 0, i;
  FILE *file = need(open_memstream(&text, &size));
  json_array_foreach(items, i, item)
  {
    fprintf(file, "{\"voxels\": \"%s\", \"name\": \"%" PRId64 "\"}\n", text_of(item, "genotype"),
            number_of(item, "number"));
  }
  close_text(file);
  save_output(output, "", 0, keep(text), size);
  if (!ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: %s", output, MO_COUNTED(json_array_size(items), "design"));
}

/* Lists the replicates that are not counted in any row of the exported table. */
static void name_left_out(struct ctl *ctl, const char *id)
{
  const json_t *page = get_json(ctl, "/v1/campaigns/%s/replicates?limit=1", id), *one;
  size_t i;
  json_array_foreach(json_object_get(page, "left_out"), i, one) print_from(
      stderr, one, "campaign {id} is left out because it [{state=failed}failed|was {state}]");
}

void run_campaign_export(struct ctl *ctl)
{
  static const struct {
    const char *option, *path, *accept;
  } tables[] = {
      {"curve", "generations", "text/csv"},
      {"learning", "learning", "text/csv"},
      {"replicates", "replicates", "text/csv"},
      {"phylogeny", "phylogeny?format=csv", "text/csv"},
      {"newick", "phylogeny?format=newick", "*/*"},
  };
  const char *id = job_id(ctl->operands[0]), *population = option_text(ctl, "population", NULL);
  int n_given = population != NULL;
  for (size_t i = 0; i < sizeof(tables) / sizeof(tables[0]); i++) {
    const char *output = option_text(ctl, tables[i].option, NULL);
    if (output == NULL)
      continue;
    n_given++;
    save_reply(ctl, path_to("/v1/campaigns/%s/%s", id, tables[i].path), tables[i].accept, output);
  }
  if (option_is_set(ctl, "replicates") && !ctl->quiet)
    name_left_out(ctl, id);
  if (population != NULL)
    export_population(ctl, id, population);
  if (n_given == 0)
    fail(STATUS_USAGE, "nothing to export: give --curve, --population, --phylogeny, "
                       "--newick, --learning or --replicates FILE");
}
