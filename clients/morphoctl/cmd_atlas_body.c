/* cmd_atlas_body.c: atlas body, neighbors, ascent, similar, best and optima: bodies of an atlas. */
#include <stdlib.h>
#include <string.h>

#include "commands.h"

#define BODY_COLUMNS                                                                               \
  ">rank={rank:,}|>percentile={percentile:.2f}|>score=[{score:.4f}|diverged]|>voxels={voxels}"     \
  "|body={id}"

/* Makes the path of a query about the body in the second operand, or at --position, with the
 * options of the command that are parameters. */
static const char *body_path(struct ctl *ctl, const char *below)
{
  static const char *const parameters[] = {"position", "steps", "changes", "limit", NULL};
  const char *path = path_with(ctl, atlas_path(ctl, below), parameters);
  char voxels[VOXELS + 1];
  if (option_is_set(ctl, "position")) {
    if (ctl->n_operands > 1)
      fail(STATUS_USAGE, "give a DESIGN or --position, not both");
    return path;
  }
  if (ctl->n_operands < 2)
    fail(STATUS_USAGE, "give a DESIGN, as for eval, or --position N");
  const struct designs designs = given_designs(ctl, 1, NULL);
  const json_t *design = json_array_get(designs.list, 0);
  if (json_array_size(designs.list) != 1)
    fail(STATUS_USAGE, "give one design, not %zu", json_array_size(designs.list));
  if (!design_voxels(design, voxels) && !robot_voxels(text_of(design, "id"), voxels))
    fail(STATUS_USAGE, "the design does not fit the workspace of 6 × 6 × 4 voxels");
  return path_to("%s%cdesign=%s", path, strchr(path, '?') != NULL ? '&' : '?', voxels);
}

static void print_list(const struct ctl *ctl, const json_t *reply, const char *columns)
{
  print_table(stdout, ctl, json_object_get(reply, "items"), columns);
}

/* ---- one body ---- */

static void print_body(const struct ctl *ctl, const json_t *body)
{
  static const struct fact facts[] = {
      {"body", "{id}"},
      {"voxels", "{voxels}"},
      {"score", "[{score:.4f}|diverged]"},
      {"value", "[{value:.4g} {unit}]"},
      {"rank", "{rank:,}, better than {percentile:.2f} % of the others"},
      {"of its size", "{of_size.rank:,} of {of_size.bodies:,}, better than "
                      "{of_size.percentile:.2f} % of the others"},
      {"best of size", "{best_of_size.id}, score [{best_of_size.score:.4f}|diverged]"},
      {"ascent ends at", "[{optimum.id}, score {optimum.score:.4f}]"},
      {"basin", "[{basin>0:,} [{basin=1}body|bodies]]"},
      {NULL, NULL}};
  const char *genotype = text_of(body, "genotype"), *name;
  const json_t *measures = json_object_get(body, "measures"), *value;
  print_facts(ctl, body, facts);
  print_fact(ctl, "local optimum", "%s",
             json_is_true(json_object_get(body, "is_optimum")) ? "yes" : "no");
  json_object_foreach((json_t *)measures, name, value)
  {
    const json_t *of_size = json_object_get(json_object_get(body, "of_size"), "measures");
    if (json_is_null(value))
      print_fact(ctl, name, "no value");
    else
      print_fact(ctl, name, "%.6g, above %.2f %% of its size", json_number_value(value),
                 json_number_value(json_object_get(of_size, name)));
  }
  if (strlen(genotype) == VOXELS) {
    putchar('\n');
    draw_body(stdout, genotype, ctl->utf8);
  }
  if (json_array_size(json_object_get(body, "best_changes")) == 0)
    return;
  putchar('\n');
  print_table(stdout, ctl, json_object_get(body, "best_changes"),
              "best change={step}|" BODY_COLUMNS);
}

void run_atlas_body(struct ctl *ctl)
{
  show(ctl, body_path(ctl, "/body"), print_body);
}

static void print_neighbors(const struct ctl *ctl, const json_t *reply)
{
  print_list(ctl, reply, "step={step}|" BODY_COLUMNS);
}

void run_atlas_neighbors(struct ctl *ctl)
{
  show(ctl, body_path(ctl, "/neighbors"), print_neighbors);
}

static void print_ascent(const struct ctl *ctl, const json_t *reply)
{
  print_list(ctl, reply, BODY_COLUMNS);
  if (!ctl->quiet)
    print_from(
        stderr, reply,
        "{bodies_on_path:,} [{bodies_on_path=1}body|bodies]; the last one is a local optimum, "
        "{optimum.id}");
}

void run_atlas_ascent(struct ctl *ctl)
{
  show(ctl, body_path(ctl, "/ascent"), print_ascent);
}

static void print_similar(const struct ctl *ctl, const json_t *reply)
{
  print_list(ctl, reply, ">steps={distance}|" BODY_COLUMNS);
}

void run_atlas_similar(struct ctl *ctl)
{
  show(ctl, body_path(ctl, "/similar"), print_similar);
}

/* ---- many ---- */

void run_atlas_best(struct ctl *ctl)
{
  static const char *const filters[] = {"voxels", "measure",  "order",    "lo",
                                        "hi",     "score-lo", "score-hi", NULL};
  const char *measure = option_text(ctl, "measure", NULL);
  const int64_t limit = option_number(ctl, "limit", 1, 10000000, 20);
  json_t *items = collect(ctl, path_with(ctl, atlas_path(ctl, "/best"), filters), (size_t)limit);
  /* The server has checked the name. */
  const char *columns =
      measure != NULL
          ? keep(format_text(">%s=[{measures.%s:.6g}|no value]|" BODY_COLUMNS, measure, measure))
          : BODY_COLUMNS;
  print_items(ctl, keep(json_pack("{s:O, s:n}", "items", items, "next_cursor")), columns);
}

static void print_optima(const struct ctl *ctl, const json_t *reply)
{
  print_list(ctl, reply, ">basin={basin:,}|" BODY_COLUMNS);
  if (!ctl->quiet)
    print_from(stderr, reply, "{optima:,} local [{optima=1}optimum|optima] in total");
}

void run_atlas_optima(struct ctl *ctl)
{
  const int64_t limit = option_number(ctl, "limit", 1, 500, 20);
  show(ctl, path_to("%s?limit=%d", atlas_path(ctl, "/optima"), (int)limit), print_optima);
}
