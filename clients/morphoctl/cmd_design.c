/* cmd_design.c: design show, list, draw, random. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

int run_design_show(struct ctl *ctl)
{
  char path[80], voxels[VOXELS + 1], time[32];
  const char *id = ctl->operands[0];
  if (!is_id(id, strlen(id)))
    return complain(STATUS_USAGE, "\"%.60s\" is not an id: 36 hexadecimal digits", id);
  snprintf(path, sizeof(path), "/v1/designs/%s", id);
  if (ctl->json)
    return show_json(ctl, path);
  json_t *design;
  int status = transport_get_json(ctl, path, 0, &design);
  if (status == STATUS_OK) {
    print_fact(ctl, "design", "%s", text_of(design, "id"));
    print_fact(ctl, "voxels", "%" PRId64, number_of(design, "voxels"));
    print_fact(ctl, "masses", "%" PRId64, number_of(design, "masses"));
    print_fact(ctl, "springs", "%" PRId64, number_of(design, "springs"));
    print_fact(ctl, "first seen", "%s", time_text(json_object_get(design, "first_seen_at"), time));
    size_t i;
    const json_t *campaign;
    json_array_foreach(json_object_get(design, "campaigns"), i, campaign)
    {
      print_fact(ctl, i == 0 ? "campaigns" : "",
                 "%s: number %" PRId64 ", born in generation %" PRId64 " by %s",
                 text_of(campaign, "campaign"), number_of(campaign, "number"),
                 number_of(campaign, "born"), text_of(campaign, "operator"));
    }
    if (json_is_true(json_object_get(design, "truncated")))
      print_fact(ctl, "scores", "only the first 1,000 rollouts are shown");
    const json_t *orientations = json_object_get(design, "orientations"), *orientation;
    if (json_array_size(orientations) == 0 && id_voxels(text_of(design, "id"), voxels)) {
      putchar('\n');
      draw_body(stdout, voxels, ctl->utf8);
    }
    json_array_foreach(orientations, i, orientation)
    {
      const char *genotype = text_of(orientation, "genotype");
      if (json_array_size(orientations) > 1)
        printf("\norientation %zu of %zu\n", i + 1, json_array_size(orientations));
      else
        putchar('\n');
      if (is_voxels(genotype, strlen(genotype))) {
        memcpy(voxels, genotype, VOXELS + 1);
        draw_body(stdout, voxels, ctl->utf8);
      }
      struct table table;
      size_t k;
      const json_t *score;
      table_open(&table, ">score|controller|environments|physics|precision|computed");
      json_array_foreach(json_object_get(orientation, "scores"), k, score)
      {
        char number[32], controller[16], environments[32], physics[16];
        const json_t *set = json_object_get(score, "environments");
        snprintf(controller, sizeof(controller), "%.12s", text_of(score, "controller"));
        snprintf(physics, sizeof(physics), "%.12s", text_of(score, "physics"));
        if (json_is_string(set))
          snprintf(environments, sizeof(environments), "%.30s", json_string_value(set));
        else
          snprintf(environments, sizeof(environments), "%zu own", json_array_size(set));
        const char *cells[] = {score_text(json_object_get(score, "score"), number),
                               controller,
                               environments,
                               physics,
                               text_of(score, "precision"),
                               time_text(json_object_get(score, "computed_at"), time)};
        table_add(&table, cells);
      }
      if (table.n_rows > 0) {
        putchar('\n');
        table_print(&table, stdout, ctl);
      }
    }
  }
  json_decref(design);
  return status;
}

int run_design_list(struct ctl *ctl)
{
  const char *sort = option_text(ctl, "sort", "id"),
             *controller = option_text(ctl, "controller", NULL);
  int64_t limit = 100;
  if (!option_number(ctl, "limit", 1, 1000000, &limit))
    return STATUS_USAGE;
  if (option_is_set(ctl, "all"))
    limit = 0;
  if (strcmp(sort, "id") != 0 && strcmp(sort, "score") != 0)
    return complain(STATUS_USAGE, "--sort: \"%s\" is not id or score", sort);
  char *escaped = controller != NULL ? escape(controller) : NULL, *path = NULL;
  json_t *items = NULL;
  int status = STATUS_ERROR;
  if (asprintf(&path, "/v1/designs?sort=%s%s%s", sort, escaped != NULL ? "&controller=" : "",
               escaped != NULL ? escaped : "") >= 0)
    status = collect(ctl, path, (size_t)limit, &items);
  free(escaped);
  free(path);
  if (status != STATUS_OK)
    return status;
  if (!print_page(ctl, items)) {
    struct table table;
    size_t i;
    const json_t *design;
    table_open(&table, "design|>voxels|>masses|>springs|>score|first seen");
    json_array_foreach(items, i, design)
    {
      char voxels[24], masses[24], springs[24], score[32], time[32];
      snprintf(voxels, sizeof(voxels), "%" PRId64, number_of(design, "voxels"));
      snprintf(masses, sizeof(masses), "%" PRId64, number_of(design, "masses"));
      snprintf(springs, sizeof(springs), "%" PRId64, number_of(design, "springs"));
      const char *cells[] = {text_of(design, "id"),
                             voxels,
                             masses,
                             springs,
                             score_text(json_object_get(design, "score"), score),
                             time_text(json_object_get(design, "first_seen_at"), time)};
      table_add(&table, cells);
    }
    if (strcmp(sort, "score") != 0)
      table_drop(&table, 4);
    table_print(&table, stdout, ctl);
  }
  json_decref(items);
  return STATUS_OK;
}

int run_design_draw(struct ctl *ctl)
{
  struct designs designs = {0};
  int status = STATUS_OK;
  for (size_t i = 0; i < ctl->n_operands && status == STATUS_OK; i++)
    status = designs_add_operand(&designs, ctl->operands[i]);
  if (ctl->n_operands == 0)
    status = designs_add_operand(&designs, "-");
  for (size_t i = 0; i < designs.n && status == STATUS_OK; i++) {
    const json_t *design = json_array_get(designs.list, i);
    char voxels[VOXELS + 1];
    if (!design_voxels(design, voxels) && !id_voxels(text_of(design, "id"), voxels)) {
      status =
          complain(STATUS_USAGE, "design %zu does not fit the workspace of 6 × 6 × 4 voxels", i);
      break;
    }
    if (i > 0)
      putchar('\n');
    if (designs.names[i] != NULL)
      print_plain_line(stdout, "%s", designs.names[i]);
    draw_body(stdout, voxels, ctl->utf8);
  }
  designs_free(&designs);
  return status;
}

int run_design_random(struct ctl *ctl)
{
  struct designs designs = {0};
  int64_t n = 1, seed = 1;
  if (!option_number(ctl, "count", 1, DESIGNS_MAX, &n) ||
      !option_number(ctl, "seed", 0, INT64_MAX, &seed))
    return STATUS_USAGE;
  int status = designs_add_random(&designs, (uint64_t)seed, (size_t)n);
  for (size_t i = 0; i < designs.n && status == STATUS_OK; i++) {
    json_dumpf(json_array_get(designs.list, i), stdout, JSON_COMPACT);
    putchar('\n');
  }
  designs_free(&designs);
  return status;
}
