/* cmd_design.c: design show, draw; random, mutate, cross, canonical: bodies that the server makes.
 * Each is printed as a JSON design on one line, for other commands to read. */
#include <string.h>

#include "commands.h"

static void print_orientation(const struct ctl *ctl, const json_t *orientation)
{
  const char *genotype = text_of(orientation, "genotype");
  const json_t *scores = json_object_get(orientation, "scores");
  if (is_voxels(genotype, strlen(genotype)))
    draw_body(stdout, genotype, ctl->utf8);
  if (json_array_size(scores) > 0) {
    putchar('\n');
    print_table(stdout, ctl, scores,
                ">score=[{lower_bound=true}≥ ]{score:.4f}|controller={controller:.12}"
                "|environments=[{environments:.30}|{environments:#} own]|physics={physics:.12}"
                "|precision={precision}|computed={computed_at:time}");
  }
}

static void print_design(const struct ctl *ctl, const json_t *design)
{
  static const struct fact facts[] = {{"design", "{id}"},
                                      {"voxels", "{voxels}"},
                                      {"masses", "{masses}"},
                                      {"springs", "{springs}"},
                                      {"first seen", "{first_seen_at:time}"},
                                      {NULL, NULL}};
  static const char birth[] = "{campaign}: number {number}, born in generation {born} by "
                              "{operator}";
  const json_t *orientations = json_object_get(design, "orientations"), *item;
  const size_t n = json_array_size(orientations);
  char voxels[VOXELS + 1];
  size_t i;
  print_facts(ctl, design, facts);
  json_array_foreach(json_object_get(design, "campaigns"), i, item)
  {
    print_facts(ctl, item, (const struct fact[]){{i == 0 ? "campaigns" : "", birth}, {NULL, NULL}});
  }
  if (json_is_true(json_object_get(design, "truncated")))
    print_fact(ctl, "scores", "only the first 1,000 rollouts are shown");
  if (n == 0 && robot_voxels(text_of(design, "id"), voxels)) {
    putchar('\n');
    draw_body(stdout, voxels, ctl->utf8);
  }
  json_array_foreach(orientations, i, item)
  {
    putchar('\n');
    print_from(stdout, item, "{robot}");
    print_orientation(ctl, item);
  }
}

void run_design_show(struct ctl *ctl)
{
  const char *id = ctl->operands[0];
  if (!is_robot(id, strlen(id)))
    fail(STATUS_USAGE,
         "\"%.60s\" is not an id: 36 hexadecimal digits, optionally followed by @0 to @7", id);
  show(ctl, path_to("/v1/designs/%s", id), print_design);
}

void run_design_draw(struct ctl *ctl)
{
  const struct designs designs = given_designs(ctl, 0, NULL);
  const json_t *design;
  size_t i;
  json_array_foreach(designs.list, i, design)
  {
    const char *name = json_string_value(json_array_get(designs.names, i));
    char voxels[VOXELS + 1];
    if (!design_voxels(design, voxels) && !robot_voxels(text_of(design, "id"), voxels))
      fail(STATUS_USAGE, "design %zu does not fit the workspace of 6 × 6 × 4 voxels", i);
    if (i > 0)
      putchar('\n');
    if (name != NULL)
      print_plain_line(stdout, "%s", name);
    draw_body(stdout, voxels, ctl->utf8);
  }
}

/* ---- bodies that the server makes ---- */

/* Prints the bodies, and reports missing ones on standard error. as: "voxels" or "id". */
static void print_bodies(const struct ctl *ctl, const json_t *reply, const char *as)
{
  const json_t *items = json_object_get(reply, "items"), *item;
  size_t i;
  if (ctl->json) {
    print_json(reply);
    return;
  }
  json_array_foreach(items, i, item)
  {
    const json_t *fault = json_object_get(item, "fault");
    if (json_is_object(fault) && !ctl->quiet)
      print_plain_line(stderr, "body %zu is left out: %s: %s", i, text_of(fault, "pointer"),
                       text_of(fault, "detail"));
    if (json_is_object(fault))
      continue;
    json_t *design =
        json_pack("{s:s}", as, text_of(item, strcmp(as, "id") == 0 ? "id" : "genotype"));
    put_json(design, JSON_COMPACT);
    json_decref(design);
  }
}

/* Sends the options and the members of `request`, and prints the reply. */
static void make(struct ctl *ctl, const char *path, json_t *request, const char *as)
{
  request_fill(ctl, request);
  print_bodies(ctl, post_again(ctl, path, request), as);
}

void run_design_random(struct ctl *ctl)
{
  make(ctl, "/v1/bodies/random", keep(json_object()), "voxels");
}

/* Adds the pairs of neighbors: designs 0 and 1, 2 and 3, … */
static void fill_pairs(json_t *request, size_t n)
{
  json_t *pairs = json_array();
  json_object_set_new(request, "pairs", pairs);
  if (n < 2 || n % 2 != 0)
    fail(STATUS_USAGE, "got %zu designs, expected pairs of designs", n);
  for (size_t i = 0; i + 1 < n; i += 2)
    json_array_append_new(pairs, json_pack("[I, I]", (json_int_t)i, (json_int_t)i + 1));
}

void run_design_made(struct ctl *ctl)
{
  const char *verb = ctl->command->name + strlen("design ");
  const struct designs designs = given_designs(ctl, 0, NULL);
  json_t *request = keep(json_pack("{s:O}", "designs", designs.list));
  if (strcmp(verb, "cross") == 0)
    fill_pairs(request, json_array_size(designs.list));
  make(ctl, path_to("/v1/bodies/%s", verb), request,
       strcmp(verb, "canonical") == 0 ? "id" : "voxels");
}
