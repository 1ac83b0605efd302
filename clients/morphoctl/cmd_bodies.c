/* cmd_bodies.c: design random, mutate, cross, canonical: bodies that the server makes. Each is
 * printed as a JSON design on a line of its own, for other commands to read. */
#include <string.h>

#include "commands.h"
#include "transport.h"

/* Prints the bodies; those that are not there are reported on standard error. as: "voxels" or
 * "id". */
static int print_bodies(const struct ctl *ctl, json_t *reply, const char *as)
{
  const json_t *items = json_object_get(reply, "items"), *item;
  size_t i;
  if (ctl->json) {
    print_json(reply);
    return STATUS_OK;
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
  return STATUS_OK;
}

/* Sends the options and what `request` has, and prints the reply. */
static int make(struct ctl *ctl, const char *path, json_t *request, const char *as)
{
  json_t *reply = NULL;
  int status = fill_fields(ctl, request);
  if (status == STATUS_OK)
    status = post_again(ctl, path, request, &reply);
  if (status == STATUS_OK)
    status = print_bodies(ctl, reply, as);
  json_decref(reply);
  return status;
}

int run_design_random(struct ctl *ctl)
{
  json_t *request = json_object();
  const int status = make(ctl, "/v1/bodies/random", request, "voxels");
  json_decref(request);
  return status;
}

/* Adds the pairs of neighbors: designs 0 and 1, 2 and 3, … */
static int fill_pairs(json_t *request, size_t n)
{
  json_t *pairs = json_array();
  if (n < 2 || n % 2 != 0) {
    json_decref(pairs);
    return complain(STATUS_USAGE, "%zu designs are given; pairs of designs are expected", n);
  }
  for (size_t i = 0; i + 1 < n; i += 2)
    json_array_append_new(pairs, json_pack("[I, I]", (json_int_t)i, (json_int_t)i + 1));
  json_object_set_new(request, "pairs", pairs);
  return STATUS_OK;
}

int run_design_made(struct ctl *ctl)
{
  const char *verb = ctl->command->name + strlen("design ");
  struct designs designs = {0};
  json_t *request = json_object();
  int status = add_designs(ctl, 0, 0, 0, &designs);
  if (status == STATUS_OK)
    json_object_set(request, "designs", designs.list);
  if (status == STATUS_OK && strcmp(verb, "cross") == 0)
    status = fill_pairs(request, designs.n);
  if (status == STATUS_OK)
    status = make(ctl, path_to("/v1/bodies/%s", verb), request,
                  strcmp(verb, "canonical") == 0 ? "id" : "voxels");
  json_decref(request);
  designs_free(&designs);
  return status;
}
