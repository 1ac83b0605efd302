/* controller.c: the controller in memory. All parameters are in one buffer in file order; the named
 * views point into it, so that an optimizer, a file and a hash can treat the controller as one
 * array. */
#include "controller/internal.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <jansson.h>

#include <morpho/random.h>

#include "base/text.h"
#include "base/words.h"

const char *const mo_sensor_words[] = {"inverse_sqrt", "inverse_square", NULL};

const char *mo_sensor_name(enum mo_sensor sensor)
{
  return mo_word(mo_sensor_words, (unsigned)sensor);
}

void mo_controller_mass_order(struct mo_workspace workspace, char text[64])
{
  snprintf(text, 64, "x-major lattice (x*%u+y)*%u+z", workspace.ny + 1U, workspace.nz + 1U);
}

void mo_controller_workspace_text(struct mo_workspace workspace, char text[64])
{
  snprintf(text, 64, "%ux%ux%u", workspace.nx, workspace.ny, workspace.nz);
}

uint64_t mo_controller_tensors(struct mo_workspace workspace,
                               struct mo_tensor tensors[MO_CONTROLLER_TENSORS])
{
  const uint64_t n_inputs = (uint64_t)mo_workspace_masses(workspace) + MO_CPG_INPUTS;
  const uint64_t n_springs = mo_workspace_springs(workspace);
  const struct mo_tensor table[MO_CONTROLLER_TENSORS] = {
      {"net.0.weight", 2, {MO_HIDDEN, n_inputs}},  {"net.0.bias", 1, {MO_HIDDEN, 1}},
      {"net.1.weight", 1, {MO_HIDDEN, 1}},         {"net.1.bias", 1, {MO_HIDDEN, 1}},
      {"net.3.weight", 2, {MO_HIDDEN, MO_HIDDEN}}, {"net.3.bias", 1, {MO_HIDDEN, 1}},
      {"net.4.weight", 1, {MO_HIDDEN, 1}},         {"net.4.bias", 1, {MO_HIDDEN, 1}},
      {"net.6.weight", 2, {MO_HIDDEN, MO_HIDDEN}}, {"net.6.bias", 1, {MO_HIDDEN, 1}},
      {"net.7.weight", 1, {MO_HIDDEN, 1}},         {"net.7.bias", 1, {MO_HIDDEN, 1}},
      {"net.9.weight", 2, {n_springs, MO_HIDDEN}}, {"net.9.bias", 1, {n_springs, 1}},
  };
  uint64_t offset = 0;
  for (int i = 0; i < MO_CONTROLLER_TENSORS; i++) {
    tensors[i] = table[i];
    tensors[i].offset = offset;
    tensors[i].count = table[i].shape[0] * table[i].shape[1];
    offset += tensors[i].count;
  }
  return offset;
}

int mo_controller_allocate(struct mo_workspace workspace, enum mo_sensor sensor,
                           struct mo_controller **ret)
{
  const int r = mo_workspace_check(workspace);
  if (r < 0)
    return r;
  struct mo_tensor tensors[MO_CONTROLLER_TENSORS];
  const uint64_t n_parameters = mo_controller_tensors(workspace, tensors);
  if (n_parameters * sizeof(float) > MO_CONTROLLER_FILE_MAX - MO_SAFETENSORS_HEADER_MAX - 8)
    return MO_ERR_LIMIT;
  struct mo_controller *c = calloc(1, sizeof(*c));
  if (c == NULL)
    return MO_ERR_NO_MEMORY;
  c->workspace = workspace;
  c->sensor = sensor;
  c->n_masses = mo_workspace_masses(workspace);
  c->n_springs = mo_workspace_springs(workspace);
  c->n_inputs = c->n_masses + MO_CPG_INPUTS;
  c->n_parameters = n_parameters;
  c->parameters = aligned_alloc(64, (n_parameters * sizeof(float) + 63) / 64 * 64);
  if (c->parameters == NULL) {
    free(c);
    return MO_ERR_NO_MEMORY;
  }
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const struct mo_tensor *layer = tensors + 4 * l;
    c->weight[l] = c->parameters + layer[0].offset;
    c->bias[l] = c->parameters + layer[1].offset;
    if (l < MO_HIDDEN_LAYERS) {
      c->norm_gain[l] = c->parameters + layer[2].offset;
      c->norm_shift[l] = c->parameters + layer[3].offset;
    }
  }
  *ret = c;
  return MO_OK;
}

/* Sets the LayerNorm gain to 1, and everything else to 0. */
static void clear_parameters(struct mo_controller *c)
{
  memset(c->parameters, 0, c->n_parameters * sizeof(float));
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    for (int i = 0; i < MO_HIDDEN; i++)
      c->norm_gain[l][i] = 1.0F;
}

int mo_controller_create(struct mo_workspace workspace, enum mo_sensor sensor,
                         struct mo_controller **controller)
{
  if (sensor != MO_SENSOR_INVERSE_SQRT && sensor != MO_SENSOR_INVERSE_SQUARE)
    return MO_ERR_INVALID;
  struct mo_controller *c = NULL;
  int r = mo_controller_allocate(workspace, sensor, &c);
  if (r < 0)
    return r;
  clear_parameters(c);
  char size[64];
  mo_controller_workspace_text(workspace, size);
  r = mo_controller_complete_metadata(c);
  if (r == MO_OK)
    r = mo_controller_put_metadata(c, "workspace", size);
  if (r == MO_OK)
    *controller = c;
  else
    mo_controller_free(c);
  return r;
}

void mo_controller_free(struct mo_controller *controller)
{
  if (controller == NULL)
    return;
  for (size_t i = 0; i < controller->n_metadata; i++) {
    free(controller->metadata[i].key);
    free(controller->metadata[i].value);
  }
  free(controller->metadata);
  free(controller->parameters);
  free(controller);
}

int mo_controller_set_period(struct mo_controller *controller, double period_s)
{
  if (!(period_s > 0 && period_s <= MO_CONTROL_PERIOD_MAX_S))
    return MO_ERR_RANGE;
  char text[MO_NUMBER_BYTES];
  mo_number_text(period_s, text);
  const int r = mo_controller_put_metadata(controller, "control_period_s", text);
  if (r == MO_OK)
    controller->control_period_s = period_s;
  return r;
}

void mo_controller_randomize(struct mo_controller *controller, uint64_t seed)
{
  clear_parameters(controller);
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t fan_in = l == 0 ? controller->n_inputs : MO_HIDDEN;
    const size_t fan_out = l == MO_HIDDEN_LAYERS ? controller->n_springs : MO_HIDDEN;
    const double bound = sqrt(6.0 / (double)(fan_in + fan_out));
    struct mo_random random;
    mo_random_init(&random, seed, MO_PURPOSE_WEIGHTS, (uint32_t)l, 0);
    for (size_t i = 0; i < fan_in * fan_out; i++)
      controller->weight[l][i] = (float)((2.0 * mo_random_uniform(&random) - 1.0) * bound);
  }
}

static struct mo_metadata_entry *find_metadata(const struct mo_controller *controller,
                                               const char *key)
{
  for (size_t i = 0; i < controller->n_metadata; i++)
    if (strcmp(controller->metadata[i].key, key) == 0)
      return &controller->metadata[i];
  return NULL;
}

const char *mo_controller_get_metadata(const struct mo_controller *controller, const char *key)
{
  const struct mo_metadata_entry *entry = find_metadata(controller, key);
  return entry != NULL ? entry->value : NULL;
}

int mo_controller_put_metadata(struct mo_controller *controller, const char *key, const char *value)
{
  if (strlen(key) > MO_METADATA_BYTES_MAX || strlen(value) > MO_METADATA_BYTES_MAX)
    return MO_ERR_LIMIT;
  struct mo_metadata_entry *entry = find_metadata(controller, key);
  if (entry == NULL && controller->n_metadata >= MO_METADATA_MAX)
    return MO_ERR_LIMIT;
  char *value_copy = strdup(value);
  if (value_copy == NULL)
    return MO_ERR_NO_MEMORY;
  if (entry != NULL) {
    free(entry->value);
    entry->value = value_copy;
    return MO_OK;
  }
  char *key_copy = strdup(key);
  struct mo_metadata_entry *grown =
      key_copy != NULL ? realloc(controller->metadata,
                                 (controller->n_metadata + 1) * sizeof(struct mo_metadata_entry))
                       : NULL;
  if (grown == NULL) {
    free(key_copy);
    free(value_copy);
    return MO_ERR_NO_MEMORY;
  }
  controller->metadata = grown;
  grown[controller->n_metadata++] = (struct mo_metadata_entry){key_copy, value_copy};
  return MO_OK;
}

int mo_controller_complete_metadata(struct mo_controller *controller)
{
  char mass_order[64];
  mo_controller_mass_order(controller->workspace, mass_order);
  const char *const entries[][2] = {{"mass_order", mass_order},
                                    {"spring_order", MO_SPRING_ORDER},
                                    {"sensor", mo_sensor_name(controller->sensor)}};
  int r = MO_OK;
  for (size_t i = 0; i < sizeof(entries) / sizeof(entries[0]) && r == MO_OK; i++)
    if (find_metadata(controller, entries[i][0]) == NULL)
      r = mo_controller_put_metadata(controller, entries[i][0], entries[i][1]);
  return r;
}

int mo_controller_set_metadata(struct mo_controller *controller, const char *key, const char *value)
{
  if (key == NULL || value == NULL || /* only UTF-8 can be written into a JSON header */
      !mo_utf8_is_valid(key) || !mo_utf8_is_valid(value))
    return MO_ERR_INVALID;
  /* These entries describe the parameters, which any other value would contradict. */
  static const char *const fixed[] = {"mass_order", "spring_order", "sensor", "control_period_s",
                                      "workspace"};
  for (size_t i = 0; i < sizeof(fixed) / sizeof(fixed[0]); i++) {
    if (strcmp(key, fixed[i]) != 0)
      continue;
    char size[64];
    const char *current = mo_controller_get_metadata(controller, key);
    if (current == NULL && strcmp(key, "control_period_s") == 0)
      return MO_ERR_CONFLICT;
    if (current == NULL) { /* a file without "workspace" */
      mo_controller_workspace_text(controller->workspace, size);
      current = size;
    }
    if (strcmp(value, current) != 0)
      return MO_ERR_CONFLICT;
  }
  return mo_controller_put_metadata(controller, key, value);
}

int mo_controller_get_metadata_number(const struct mo_controller *controller, const char *key,
                                      const char *member, uint64_t *number)
{
  const char *text = mo_controller_get_metadata(controller, key);
  json_error_t why;
  if (text == NULL)
    return MO_ERR_NOT_FOUND;
  json_t *object = json_loads(text, JSON_REJECT_DUPLICATES, &why);
  if (object == NULL)
    return json_error_code(&why) == json_error_out_of_memory ? MO_ERR_NO_MEMORY : MO_ERR_FORMAT;
  const json_t *value = json_object_get(object, member);
  const bool found = json_is_integer(value) && json_integer_value(value) >= 0;
  if (found)
    *number = (uint64_t)json_integer_value(value);
  json_decref(object);
  return found ? MO_OK : MO_ERR_FORMAT;
}
