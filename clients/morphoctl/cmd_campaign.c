/* cmd_campaign.c: campaign start, list, extend, champions, export. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "campaign.h"
#include "commands.h"
#include "table.h"
#include "template.h"
#include "transport.h"

/* ---- start ---- */

/* Adds --workspace X,Y,Z. */
static int fill_workspace(const struct ctl *ctl, json_t *request)
{
  const char *text = option_text(ctl, "workspace", NULL);
  int x, y, z, end = 0;
  if (text == NULL)
    return STATUS_OK;
  /* NOLINTNEXTLINE(cert-err34-c): 5 digits fit */
  if (sscanf(text, "%5d,%5d,%5d%n", &x, &y, &z, &end) != 3 || text[end] != 0)
    return complain(STATUS_USAGE, "--workspace: \"%s\" is not X,Y,Z, e.g. 6,6,4", text);
  json_object_set_new(request, "workspace", json_pack("[i, i, i]", x, y, z));
  return STATUS_OK;
}

/* Adds the initial population: the operands, or that of another campaign. */
static int fill_initial(struct ctl *ctl, json_t *request)
{
  const char *from = option_text(ctl, "from", NULL);
  if (from != NULL && ctl->n_operands > 1)
    return complain(
        STATUS_USAGE,
        "an initial population comes from designs or --from a campaign: give one of the two");
  if (from != NULL) {
    if (!check_job_id(from))
      return STATUS_USAGE;
    json_object_set_new(request, "initial", json_pack("{s:s}", "campaign", from));
  }
  if (ctl->n_operands < 2)
    return STATUS_OK;
  struct designs designs = {0};
  int status = add_designs(ctl, 1, 0, 0, &designs);
  if (status == STATUS_OK)
    json_object_set_new(request, "initial", json_pack("{s:O}", "designs", designs.list));
  designs_free(&designs);
  return status;
}

static int fill_request(struct ctl *ctl, json_t *request)
{
  int status = fill_workspace(ctl, request);
  if (status == STATUS_OK)
    status = fill_schedule(ctl, request, "learning.schedule");
  if (status == STATUS_OK)
    status = fill_initial(ctl, request);
  if (status == STATUS_OK)
    status = fill_fields(ctl, request);
  if (status == STATUS_OK)
    status = request_fill(ctl, request); /* controller, environments, physics */
  const char *controller = option_text(ctl, "controller", NULL);
  if (status == STATUS_OK && controller != NULL && strcmp(controller, "random") == 0)
    json_object_set_new(request, "controller", json_null());
  if (status == STATUS_OK && option_is_set(ctl, "no-exclusions"))
    json_object_set_new(request, "exclude_pretraining", json_false());
  return status;
}

int run_campaign_start(struct ctl *ctl)
{
  json_t *request = json_pack("{s:s}", "mode", ctl->operands[0]);
  int status = request != NULL ? fill_request(ctl, request)
                               : complain(STATUS_USAGE, "the mode is not UTF-8");
  if (status == STATUS_OK)
    status = live_start(ctl, request);
  json_decref(request);
  return status;
}

int run_campaign_list(struct ctl *ctl)
{
  return list_items(ctl, "/v1/campaigns", 50,
                    ">campaign={id}|mode={mode}|state={state}|>designs={settings.population:,}"
                    "|>generation=[{newest.generation:,}|–]|>of={progress.generations:,}"
                    "|>mean={newest.score.mean:.4f}|>best={newest.score.quantiles.p0:.4f}"
                    "|>diversity={newest.diversity:.4f}|created={created_at:time}|label={label}");
}

/* ---- extend ---- */

int run_campaign_extend(struct ctl *ctl)
{
  const char *id = ctl->operands[0], *more = ctl->operands[1];
  char *end;
  long long generations = strtoll(more, &end, 10);
  if (!check_job_id(id))
    return STATUS_USAGE;
  if (*more == 0 || *end != 0 || generations < 1 || generations > 1000000)
    return complain(STATUS_USAGE, "\"%s\" is not a number of further generations", more);
  json_t *request = json_pack("{sI}", "generations", (json_int_t)generations), *campaign = NULL;
  int status = post_job(ctl, path_to("/v1/campaigns/%s/extend", id), request, 0, &campaign);
  if (campaign != NULL)
    tell(ctl, campaign, "campaign {id} is {state}, to generation {progress.generations}");
  json_decref(request);
  json_decref(campaign);
  return status;
}

/* ---- champions ---- */

/* Evaluates the champions again with recording; saves their trajectories into a folder (nullable),
 * and films them with --film. */
static int record_champions(struct ctl *ctl, const char *id, int64_t count, const char *folder)
{
  int64_t stride = 10;
  json_t *evaluation = NULL;
  if (!option_number(ctl, "record-stride", 1, 1000000, &stride))
    return STATUS_USAGE;
  json_t *request =
      json_pack("{s:I, s:I}", "count", (json_int_t)count, "stride", (json_int_t)stride);
  int status = request_fill_record(ctl, request, folder != NULL ? "com" : NULL);
  if (status == STATUS_OK)
    status = evaluate(ctl, path_to("/v1/campaigns/%s/champions", id), request, true, &evaluation);
  json_decref(request);
  if (status == STATUS_OK)
    status = job_outcome("job", evaluation);
  if (status == STATUS_OK && folder != NULL)
    status = save_trajectories(ctl, evaluation, folder);
  if (status == STATUS_OK)
    status = film_evaluation(ctl, evaluation);
  json_decref(evaluation);
  return status;
}

int run_campaign_champions(struct ctl *ctl)
{
  const char *id = ctl->operands[0], *folder = option_text(ctl, "output", NULL);
  const bool records = folder != NULL || option_is_set(ctl, "film");
  int64_t count = 12, generation = -1;
  if (!check_job_id(id) || !option_number(ctl, "count", 1, 1000, &count) ||
      !option_number(ctl, "generation", 0, 1000000, &generation))
    return STATUS_USAGE;
  if (!records && (option_is_set(ctl, "record-stride") || option_is_set(ctl, "record")))
    return complain(STATUS_USAGE, "--record and --record-stride are for --output and --film");
  if (records && generation >= 0)
    return complain(STATUS_USAGE, "the newest generation is recorded: --output and --film go "
                                  "without --generation");
  const int checked = film_check(ctl);
  if (checked != STATUS_OK)
    return checked;
  json_t *page;
  int status = get_json(ctl, &page, "/v1/campaigns/%s/champions?count=%" PRId64 "%s", id, count,
                        generation >= 0 ? path_to("&generation=%" PRId64, generation) : "");
  if (status == STATUS_OK && ctl->json)
    print_json(page);
  else if (status == STATUS_OK)
    print_table(stdout, ctl, json_object_get(page, "items"),
                ">number={number}|design={id}|>voxels={voxels:,}|>footprint={footprint:,}"
                "|>score={score:.4f}|>distinctness={distinctiveness:.4f}|born={operator}"
                "|>generation={born:,}");
  json_decref(page);
  return status == STATUS_OK && records ? record_champions(ctl, id, count, folder) : status;
}

/* ---- export ---- */

/* Writes a population, best first, as designs that `eval` and `train start` can read. */
static int export_population(struct ctl *ctl, const char *id, const char *output)
{
  int64_t generation = -1;
  json_t *items;
  if (!option_number(ctl, "generation", 0, 1000000, &generation))
    return STATUS_USAGE;
  const char *at = generation >= 0 ? path_to("?generation=%" PRId64, generation) : "";
  int status = collect(ctl, path_to("/v1/campaigns/%s/population%s", id, at), 0, &items);
  if (status != STATUS_OK)
    return status;
  char *text = NULL;
  size_t size = 0, i;
  FILE *file = need(open_memstream(&text, &size));
  const json_t *item;
  json_array_foreach(items, i, item)
  {
    fprintf(file, "{\"voxels\": \"%s\", \"name\": \"%" PRId64 "\"}\n", text_of(item, "genotype"),
            number_of(item, "number"));
  }
  close_text(file);
  status = save_output(output, "", 0, text, size);
  if (status == STATUS_OK && !ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: %zu designs", output, json_array_size(items));
  free(text);
  json_decref(items);
  return status;
}

/* Names the replicates that no row of the exported table counts. */
static int name_left_out(struct ctl *ctl, const char *id)
{
  json_t *page, *one;
  size_t i;
  int status = get_json(ctl, &page, "/v1/campaigns/%s/replicates?limit=1", id);
  json_array_foreach(json_object_get(page, "left_out"), i, one) print_from(
      stderr, one, "campaign {id} is left out: it has [{state=failed}failed|been {state}]");
  json_decref(page);
  return status;
}

int run_campaign_export(struct ctl *ctl)
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
  const char *id = ctl->operands[0], *population = option_text(ctl, "population", NULL);
  int status = STATUS_OK, n_given = population != NULL;
  if (!check_job_id(id))
    return STATUS_USAGE;
  for (size_t i = 0; i < sizeof(tables) / sizeof(tables[0]) && status == STATUS_OK; i++) {
    const char *output = option_text(ctl, tables[i].option, NULL);
    if (output == NULL)
      continue;
    n_given++;
    status = save_reply(ctl, path_to("/v1/campaigns/%s/%s", id, tables[i].path), tables[i].accept,
                        output);
  }
  if (status == STATUS_OK && option_is_set(ctl, "replicates") && !ctl->quiet)
    status = name_left_out(ctl, id);
  if (status == STATUS_OK && population != NULL)
    status = export_population(ctl, id, population);
  if (n_given == 0)
    return complain(STATUS_USAGE, "what is to be exported? --curve, --population, --phylogeny, "
                                  "--newick, --learning or --replicates FILE");
  return status;
}
