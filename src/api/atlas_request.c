/* atlas_request.c: the body of POST /v1/atlases. */
#include "api/atlas_request.h"

#include <stdio.h>
#include <string.h>

#include "base/words.h"
#include "rollout/physics.h"
#include "store/select_by.h"

#define PREFIX "morpho-12-" /* prefix of the names of the sets of the suite's tasks */

static void read_name(struct mo_json *json, void *value)
{
  const unsigned depth = json->depth;
  struct mo_json_slice name;
  char text[MO_ATLAS_NAME_MAX + 1] = "";
  if (!mo_json_string(json, &name))
    return;
  if (name.size <= MO_ATLAS_NAME_MAX)
    memcpy(text, name.bytes, name.size);
  if (strlen(text) == name.size && mo_atlas_name_is_valid(text))
    memcpy(value, text, sizeof(text));
  else
    mo_json_fault_at(json, depth, "", "must be " MO_ATLAS_NAME_WORDS);
}
static const struct mo_field_own name_field = {.read = read_name};

#define AT(member) offsetof(struct mo_parsed_atlas, member)
static const struct mo_field rows[] = {
    {"name", MO_FIELD_OWN, 0, AT(request.name), .own = &name_field, .unit = "",
     .help = "the name of the atlas"},
    {"voxels", MO_FIELD_COUNT, 0, AT(request.voxels), .min = 1, .max = MO_ATLAS_VOXELS_MAX,
     .unit = "voxels", .help = "largest number of voxels of a body"},
    {"task", MO_FIELD_WORD, 0, AT(task), .words = mo_suite_task_words, .unit = "",
     .help = "a task of the suite, in its ten worlds to select with"},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"physics", MO_FIELD_GROUP, 0, AT(request.physics), .group = &mo_physics_fields},
    {"orientations", MO_FIELD_WORD, 0, AT(request.orientations),
     .words = mo_atlas_orientation_words, .unit = "",
     .help = "whether a score is the mean over a body's images, or that of its canonical form"},
    {"measures", MO_FIELD_OWN, 0, AT(request.measures), .own = &mo_measures_field},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
};
#undef AT
const struct mo_fields mo_atlas_request_fields = MO_FIELDS(rows);

static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_atlas *parsed = any;
  struct mo_message message;
  if (mo_physics_check(&parsed->request.physics, &message) == MO_ERR_RANGE)
    mo_json_fault_at(json, 0, "/physics", "%s", message.text);
  else
    mo_parts_check_factors(json, &parsed->parts, &parsed->request.physics, NULL);
  if (parsed->request.voxels == 0 && json->faults->n == 0)
    mo_json_fault_at(
        json, 0, "",
        "voxels is missing; it must be the largest number of voxels of a body, 1 to %d",
        MO_ATLAS_VOXELS_MAX);
  if (parsed->task >= 0 && parsed->parts.has_environments)
    mo_json_fault_at(json, 0, "/task",
                     "cannot be combined with environments; give only one of "
                     "them");
  if (parsed->parts.no_controller)
    mo_json_fault_at(json, 0, "/controller", "must be a controller's name, got null");
  if (parsed->parts.job.priority == MO_INTERACTIVE)
    mo_json_fault_at(json, 0, "/priority",
                     "must be \"batch\": an atlas takes too long to run ahead of other work");
  return MO_OK;
}

/* Makes the base of a name, if the request does not specify one: walk-10, walk-10-canonical. */
static void make_base(struct mo_atlas_request *request)
{
  const char *set = request->environment_set != NULL ? request->environment_set : "atlas";
  if (strncmp(set, PREFIX, strlen(PREFIX)) == 0)
    set += strlen(PREFIX);
  snprintf(request->base, sizeof(request->base), "%s-%u%s", set, request->voxels,
           request->orientations == MO_ATLAS_CANONICAL ? "-canonical" : "");
}

int mo_atlas_parse(const char *text, size_t size, struct mo_parsed_atlas *parsed,
                   struct mo_faults *faults)
{
  struct mo_atlas_request *request = &parsed->request;
  *parsed = (struct mo_parsed_atlas){
      .request = {.physics = mo_default_physics(), .orientations = MO_ATLAS_IMAGES},
      .parts = {.job = {.priority = MO_BATCH, .weight = 1}, .controller = "default"},
      .task = -1};
  const int error =
      mo_read_body(text, size, &mo_atlas_request_fields, parsed, &parsed->parts, check, faults);
  request->controller = parsed->parts.controller;
  if (error != MO_OK)
    return error;
  if (parsed->task >= 0)
    parsed->parts.environment_set = mo_suite_set(0, (uint32_t)parsed->task);
  request->job = parsed->parts.job;
  request->environments = parsed->parts.environments;
  request->n_environments = parsed->parts.n_environments;
  request->environment_set = mo_parts_set(&parsed->parts);
  make_base(request);
  return MO_OK;
}
