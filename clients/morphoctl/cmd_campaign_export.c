/* cmd_campaign_export.c: campaign champions, export. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "campaign.h"
#include "commands.h"
#include "table.h"
#include "transport.h"

/* ---- champions ---- */

static void print_champions(const struct ctl *ctl, const json_t *page)
{
  struct table table;
  size_t i;
  const json_t *item;
  table_open(&table, ">number|design|>voxels|>footprint|>score|>distinctness|born|>generation");
  json_array_foreach(json_object_get(page, "items"), i, item)
  {
    char number[32], voxels[32], footprint[32], score[32], distinct[32], born[32];
    snprintf(number, sizeof(number), "%" PRId64, number_of(item, "number"));
    const char *cells[] = {number,
                           text_of(item, "id"),
                           count_text(number_of(item, "voxels"), voxels),
                           count_text(number_of(item, "footprint"), footprint),
                           score_text(json_object_get(item, "score"), score),
                           score_text(json_object_get(item, "distinctiveness"), distinct),
                           text_of(item, "operator"),
                           count_text(number_of(item, "born"), born)};
    table_add(&table, cells);
  }
  table_print(&table, stdout, ctl);
}

/* Evaluates the champions again with recording, and saves their trajectories into a folder. */
static int record_champions(struct ctl *ctl, const char *id, int64_t count, const char *folder)
{
  int64_t stride = 10;
  char path[64];
  json_t *evaluation = NULL;
  if (!option_number(ctl, "record-stride", 1, 1000000, &stride))
    return STATUS_USAGE;
  snprintf(path, sizeof(path), "/v1/campaigns/%s/champions", id);
  json_t *request =
      json_pack("{s:I, s:I}", "count", (json_int_t)count, "stride", (json_int_t)stride);
  int status = request != NULL ? post_job(ctl, path, request, 0, &evaluation)
                               : complain(STATUS_ERROR, "out of memory");
  json_decref(request);
  if (status == STATUS_OK) {
    char evaluation_id[24];
    snprintf(evaluation_id, sizeof(evaluation_id), "%s", text_of(evaluation, "id"));
    json_decref(evaluation);
    evaluation = NULL;
    status = evaluation_wait(ctl, evaluation_id, &evaluation);
  }
  if (status == STATUS_OK)
    status = job_outcome("job", evaluation);
  if (status == STATUS_OK)
    status = save_trajectories(ctl, evaluation, folder);
  json_decref(evaluation);
  return status;
}

int run_campaign_champions(struct ctl *ctl)
{
  const char *id = ctl->operands[0], *folder = option_text(ctl, "output", NULL);
  int64_t count = 12, generation = -1;
  char path[128];
  if (!check_job_id(id) || !option_number(ctl, "count", 1, 1000, &count) ||
      !option_number(ctl, "generation", 0, 1000000, &generation))
    return STATUS_USAGE;
  if (folder == NULL && option_is_set(ctl, "record-stride"))
    return complain(STATUS_USAGE, "--record-stride is for --output");
  if (folder != NULL && generation >= 0)
    return complain(
        STATUS_USAGE,
        "paths are recorded of the newest generation: --output goes without --generation");
  int n = snprintf(path, sizeof(path), "/v1/campaigns/%s/champions?count=%" PRId64, id, count);
  if (generation >= 0)
    snprintf(path + n, sizeof(path) - (size_t)n, "&generation=%" PRId64, generation);
  json_t *page;
  int status = transport_get_json(ctl, path, 0, &page);
  if (status == STATUS_OK && ctl->json)
    print_json(page);
  else if (status == STATUS_OK)
    print_champions(ctl, page);
  json_decref(page);
  return status == STATUS_OK && folder != NULL ? record_champions(ctl, id, count, folder) : status;
}

/* ---- export ---- */

/* Writes a population, best first, as designs that `eval` and `train start` can read. */
static int export_population(struct ctl *ctl, const char *id, const char *output)
{
  int64_t generation = -1;
  char path[128];
  json_t *items;
  if (!option_number(ctl, "generation", 0, 1000000, &generation))
    return STATUS_USAGE;
  int n = snprintf(path, sizeof(path), "/v1/campaigns/%s/population", id);
  if (generation >= 0)
    snprintf(path + n, sizeof(path) - (size_t)n, "?generation=%" PRId64, generation);
  int status = collect(ctl, path, 0, &items);
  if (status != STATUS_OK)
    return status;
  char *text = NULL;
  size_t size = 0, i;
  FILE *file = open_memstream(&text, &size);
  const json_t *item;
  json_array_foreach(items, i, item)
  {
    if (file != NULL)
      fprintf(file, "{\"voxels\": \"%s\", \"name\": \"%" PRId64 "\"}\n", text_of(item, "genotype"),
              number_of(item, "number"));
  }
  if (file == NULL || fclose(file) != 0)
    status = complain(STATUS_ERROR, "out of memory");
  if (status == STATUS_OK)
    status = save_output(output, text, size);
  if (status == STATUS_OK && !ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: %zu designs", output, json_array_size(items));
  free(text);
  json_decref(items);
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
    char path[96];
    if (output == NULL)
      continue;
    n_given++;
    snprintf(path, sizeof(path), "/v1/campaigns/%s/%s", id, tables[i].path);
    status = save_reply(ctl, path, tables[i].accept, output);
  }
  if (status == STATUS_OK && population != NULL)
    status = export_population(ctl, id, population);
  if (n_given == 0)
    return complain(STATUS_USAGE, "what is to be exported? --curve, --population, --phylogeny, "
                                  "--newick, --learning or --replicates FILE");
  return status;
}
