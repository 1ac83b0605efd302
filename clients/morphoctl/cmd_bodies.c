/* cmd_bodies.c: design random, mutate, cross, canonical: bodies that the server makes. Each is
 * printed as a JSON design on a line of its own, for other commands to read. */
#include <string.h>

#include "commands.h"
#include "transport.h"

/* Prints the bodies; those that are not there are reported on standard error. as: "voxels" or
 * "id". */
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

/* Sends the options and what `request` has, and prints the reply. */
static void make(struct ctl *ctl, const char *path, json_t *request, const char *as)
{
  fill_fields(ctl, request);
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
    fail(STATUS_USAGE, "%zu designs are given; pairs of designs are expected", n);
  for (size_t i = 0; i + 1 < n; i += 2)
    json_array_append_new(pairs, json_pack("[I, I]", (json_int_t)i, (json_int_t)i + 1));
}

void run_design_made(struct ctl *ctl)
{
  const char *verb = ctl->command->name + strlen("design ");
  const struct designs designs = given_designs(ctl, 0, 0, 0);
  json_t *request = keep(json_pack("{s:O}", "designs", designs.list));
  if (strcmp(verb, "cross") == 0)
    fill_pairs(request, json_array_size(designs.list));
  make(ctl, path_to("/v1/bodies/%s", verb), request,
       strcmp(verb, "canonical") == 0 ? "id" : "voxels");
}
