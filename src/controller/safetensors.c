/* safetensors.c: parses and checks the header of a safetensors file, which is untrusted.
 *
 *   8 bytes  length of the header, little-endian
 *   header   JSON object {"__metadata__": {text: text}, tensor: {"dtype", "shape",
 *            "data_offsets": [begin, end]}, …}, padded with spaces
 *   data     the tensors, row-major, at their offsets
 *
 * A file is a controller only if it has exactly the expected tensors, in float32, in the shapes of
 * one workspace, and they tile the data without gap or overlap. Header and data may list them in
 * any order, because common writers sort by name. Memory proportional to the file's size is
 * allocated only after the header has been found to agree with the actual number of bytes. Messages
 * quote text from the file only after `printable` has shortened it and replaced everything but
 * plain ASCII. */
#include "controller/internal.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#include <jansson.h>

#include "base/text.h"
#include "base/words.h"

struct printable {
  char text[49];
};

/* Returns at most 48 characters of a text, with '?' for everything but plain ASCII. */
static struct printable printable(const char *text)
{
  struct printable p;
  size_t n = 0;
  for (; text[n] != '\0' && n < sizeof(p.text) - 1; n++)
    p.text[n] = text[n] >= ' ' && text[n] <= '~' ? text[n] : '?';
  p.text[n] = '\0';
  return p;
}

int mo_safetensors_header_size(const uint8_t *prefix, uint64_t size, uint32_t *header_size,
                               struct mo_message *message)
{
  if (size < 8)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the file has %" PRIu64
                   " bytes; a safetensors file starts with an 8-byte header length",
                   size);
  uint64_t length;
  memcpy(&length, prefix, sizeof(length));
  if (length > MO_SAFETENSORS_HEADER_MAX)
    return mo_fail(message, MO_ERR_LIMIT,
                   "the header claims %" PRIu64 " bytes; at most %u are accepted", length,
                   MO_SAFETENSORS_HEADER_MAX);
  if (length > size - 8)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the header claims %" PRIu64 " bytes, but only %" PRIu64 " follow: truncated?",
                   length, size - 8);
  *header_size = (uint32_t)length;
  return MO_OK;
}

static int parse_json(const char *header, uint32_t header_size, json_t **ret,
                      struct mo_message *message)
{
  if (header_size == 0 || header[0] != '{')
    return mo_fail(message, MO_ERR_FORMAT,
                   "the header is not a JSON object: its first byte must be '{'");
  json_error_t error;
  json_t *root = json_loadb(header, header_size, JSON_REJECT_DUPLICATES, &error);
  if (root == NULL) { /* or deeper than 2048 levels, because the parser recurses. It does not
                         distinguish lack of memory from invalid text */
    return mo_fail(message, MO_ERR_FORMAT, "the header is not valid JSON: %s",
                   printable(error.text).text);
  }
  *ret = root;
  return MO_OK;
}

/* "6x6x4": plain decimal numbers, no signs, no leading zeros. */
static int parse_workspace(const char *text, struct mo_workspace *workspace)
{
  uint32_t side[3];
  for (int axis = 0; axis < 3; axis++) {
    if (*text < '1' || *text > '9')
      return MO_ERR_FORMAT;
    uint32_t n = 0;
    for (; *text >= '0' && *text <= '9'; text++) {
      n = n * 10 + (uint32_t)(*text - '0');
      if (n > UINT16_MAX)
        return MO_ERR_FORMAT;
    }
    side[axis] = n;
    if (*text != (axis < 2 ? 'x' : '\0'))
      return MO_ERR_FORMAT;
    text++;
  }
  *workspace = (struct mo_workspace){(uint16_t)side[0], (uint16_t)side[1], (uint16_t)side[2]};
  return mo_workspace_check(*workspace);
}

/* Checks a metadata entry that must have a certain value if it is present. */
static int check_entry(const json_t *metadata, const char *key, const char *expected,
                       struct mo_message *message)
{
  const char *value = json_string_value(json_object_get(metadata, key));
  if (value != NULL && strcmp(value, expected) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "metadata \"%s\" is \"%s\"; expected \"%s\"", key,
                   printable(value).text, expected);
  return MO_OK;
}

/* Reads the entry "control_period_s", a number as JSON writes it. *period_s: 0 without it. */
static int read_period(const json_t *metadata, double *period_s, struct mo_message *message)
{
  const char *text = json_string_value(json_object_get(metadata, "control_period_s"));
  *period_s = 0;
  if (text == NULL)
    return MO_OK;
  json_t *value = json_loads(text, JSON_DECODE_ANY, NULL);
  *period_s = json_number_value(value);
  json_decref(value);
  if (*period_s > 0 && *period_s <= MO_CONTROL_PERIOD_MAX_S)
    return MO_OK;
  return mo_fail(message, MO_ERR_FORMAT,
                 "metadata \"control_period_s\" is \"%s\"; expected seconds above 0, at most %g",
                 printable(text).text, MO_CONTROL_PERIOD_MAX_S);
}

/* The controller as described by the metadata. */
struct described {
  struct mo_workspace workspace;
  enum mo_sensor sensor;
  double control_period_s;
};

static int check_metadata(json_t *metadata, struct described *described, struct mo_message *message)
{
  *described = (struct described){MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, 0};
  if (metadata == NULL)
    return MO_OK;
  if (!json_is_object(metadata))
    return mo_fail(message, MO_ERR_FORMAT, "\"__metadata__\" is not an object of strings");
  /* Leaves room for the entries that will be added. */
  if (json_object_size(metadata) > MO_METADATA_MAX - 4)
    return mo_fail(message, MO_ERR_LIMIT,
                   "\"__metadata__\" has %zu entries; at most %d are accepted",
                   json_object_size(metadata), MO_METADATA_MAX - 4);
  const char *key;
  json_t *value;
  json_object_foreach(metadata, key, value)
  {
    if (!json_is_string(value))
      return mo_fail(message, MO_ERR_FORMAT, "metadata \"%s\" is not a string",
                     printable(key).text);
    if (strlen(key) > MO_METADATA_BYTES_MAX || json_string_length(value) > MO_METADATA_BYTES_MAX)
      return mo_fail(message, MO_ERR_LIMIT, "metadata \"%s\" is longer than %zu bytes",
                     printable(key).text, MO_METADATA_BYTES_MAX);
  }
  const char *text = json_string_value(json_object_get(metadata, "workspace"));
  if (text != NULL) {
    const int r = parse_workspace(text, &described->workspace);
    if (r < 0)
      return mo_fail(message, r == MO_ERR_LIMIT ? r : MO_ERR_FORMAT,
                     "metadata \"workspace\" is \"%s\"; expected voxels along each axis, as in "
                     "\"6x6x4\", at most %u in all",
                     printable(text).text, MO_VOXELS_MAX);
  }
  text = json_string_value(json_object_get(metadata, "sensor"));
  const int word = text != NULL ? mo_word_index(mo_sensor_words, text) : MO_SENSOR_INVERSE_SQRT;
  if (word < 0)
    return mo_fail(message, MO_ERR_FORMAT,
                   "metadata \"sensor\" is \"%s\"; expected \"inverse_sqrt\" or \"inverse_square\"",
                   printable(text).text);
  described->sensor = (enum mo_sensor)word;
  char mass_order[64];
  mo_controller_mass_order(described->workspace, mass_order);
  int r = check_entry(metadata, "mass_order", mass_order, message);
  if (r == MO_OK)
    r = check_entry(metadata, "spring_order", MO_SPRING_ORDER, message);
  return r == MO_OK ? read_period(metadata, &described->control_period_s, message) : r;
}

/* Formats a shape as in the header, shortened: "[256, 250]". */
static struct printable shape_text(const json_t *shape)
{
  struct printable p = {"["};
  size_t used = 1, i;
  json_t *n;
  json_array_foreach(shape, i, n)
  {
    char item[32];
    if (json_is_integer(n))
      snprintf(item, sizeof(item), "%s%" JSON_INTEGER_FORMAT, i > 0 ? ", " : "",
               json_integer_value(n));
    else
      snprintf(item, sizeof(item), "%s?", i > 0 ? ", " : "");
    if (used + strlen(item) + 5 > sizeof(p.text)) {
      used += (size_t)snprintf(p.text + used, sizeof(p.text) - used, ", ...");
      break;
    }
    used += (size_t)snprintf(p.text + used, sizeof(p.text) - used, "%s", item);
  }
  snprintf(p.text + used, sizeof(p.text) - used, "]");
  return p;
}

static bool shape_is(const json_t *shape, const struct mo_tensor *tensor)
{
  if (json_array_size(shape) != tensor->n_dims)
    return false;
  for (uint32_t d = 0; d < tensor->n_dims; d++) {
    const json_t *n = json_array_get(shape, d);
    if (!json_is_integer(n) || json_integer_value(n) < 0 ||
        (uint64_t)json_integer_value(n) != tensor->shape[d])
      return false;
  }
  return true;
}

static int check_tensor(const json_t *entry, const struct mo_tensor *tensor, const char *workspace,
                        uint64_t data_size, uint64_t *begin, struct mo_message *message)
{
  const char *name = tensor->name;
  const json_t *dtype = json_object_get(entry, "dtype"), *shape = json_object_get(entry, "shape");
  const json_t *range = json_object_get(entry, "data_offsets");
  if (!json_is_object(entry) || json_object_size(entry) != 3 || !json_is_string(dtype) ||
      !json_is_array(shape) || !json_is_array(range))
    return mo_fail(message, MO_ERR_FORMAT,
                   "tensor %s: expected {\"dtype\": text, \"shape\": [], \"data_offsets\": []}",
                   name);
  if (strcmp(json_string_value(dtype), "F32") != 0)
    return mo_fail(message, MO_ERR_FORMAT, "tensor %s has dtype \"%s\"; expected \"F32\"", name,
                   printable(json_string_value(dtype)).text);
  if (!shape_is(shape, tensor)) {
    char expected[48];
    if (tensor->n_dims == 1)
      snprintf(expected, sizeof(expected), "[%" PRIu64 "]", tensor->shape[0]);
    else
      snprintf(expected, sizeof(expected), "[%" PRIu64 ", %" PRIu64 "]", tensor->shape[0],
               tensor->shape[1]);
    return mo_fail(message, MO_ERR_FORMAT,
                   "tensor %s has shape %s; expected %s in a workspace of %s voxels", name,
                   shape_text(shape).text, expected, workspace);
  }
  const json_t *first = json_array_get(range, 0), *last = json_array_get(range, 1);
  if (json_array_size(range) != 2 || !json_is_integer(first) || !json_is_integer(last) ||
      json_integer_value(first) < 0 || json_integer_value(last) < json_integer_value(first))
    return mo_fail(message, MO_ERR_FORMAT,
                   "tensor %s: data_offsets must be [begin, end] with 0 <= begin <= end", name);
  const uint64_t from = (uint64_t)json_integer_value(first),
                 to = (uint64_t)json_integer_value(last);
  if (to > data_size)
    return mo_fail(message, MO_ERR_FORMAT,
                   "tensor %s ends at byte %" PRIu64 " of the data, which has %" PRIu64
                   ": truncated?",
                   name, to, data_size);
  if (to - from != tensor->count * sizeof(float))
    return mo_fail(message, MO_ERR_FORMAT, "tensor %s spans %" PRIu64 " bytes; expected %" PRIu64,
                   name, to - from, tensor->count * sizeof(float));
  *begin = from;
  return MO_OK;
}

/* Checks that the tensors tile the data: sorted by offset, each starts where the previous one
 * ends. */
static int check_tiling(const struct mo_tensor *tensors, const uint64_t *begins, uint64_t data_size,
                        struct mo_message *message)
{
  bool used[MO_CONTROLLER_TENSORS] = {false};
  uint64_t end = 0;
  for (int n = 0; n < MO_CONTROLLER_TENSORS; n++) {
    int next = -1;
    for (int i = 0; i < MO_CONTROLLER_TENSORS; i++)
      if (!used[i] && (next < 0 || begins[i] < begins[next]))
        next = i;
    if (begins[next] != end)
      return mo_fail(message, MO_ERR_FORMAT,
                     "tensor %s starts at byte %" PRIu64 " of the data; expected %" PRIu64 ": %s",
                     tensors[next].name, begins[next], end,
                     begins[next] < end ? "tensors overlap" : "there is a gap between tensors");
    end += tensors[next].count * sizeof(float);
    used[next] = true;
  }
  if (end != data_size)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the tensors end at byte %" PRIu64 " of the data, which has %" PRIu64, end,
                   data_size);
  return MO_OK;
}

static int check_tensors(json_t *root, struct mo_workspace workspace, uint64_t data_size,
                         struct mo_safetensors *file, struct mo_message *message)
{
  char size[64];
  mo_controller_workspace_text(workspace, size);
  mo_controller_tensors(workspace, file->tensors);
  const char *key;
  json_t *entry;
  json_object_foreach(root, key, entry)
  {
    int i = 0;
    while (i < MO_CONTROLLER_TENSORS && strcmp(key, file->tensors[i].name) != 0)
      i++;
    if (i == MO_CONTROLLER_TENSORS && strcmp(key, "__metadata__") != 0)
      return mo_fail(message, MO_ERR_FORMAT,
                     "unexpected tensor \"%s\": a controller has net.0.weight … net.9.bias only",
                     printable(key).text);
  }
  for (int i = 0; i < MO_CONTROLLER_TENSORS; i++) {
    entry = json_object_get(root, file->tensors[i].name);
    if (entry == NULL)
      return mo_fail(message, MO_ERR_FORMAT, "tensor %s is missing", file->tensors[i].name);
    const int r =
        check_tensor(entry, &file->tensors[i], size, data_size, &file->offsets[i], message);
    if (r < 0)
      return r;
  }
  return check_tiling(file->tensors, file->offsets, data_size, message);
}

/* Copies the file's metadata in its order, then adds missing entries. */
static int copy_metadata(struct mo_controller *controller, json_t *metadata)
{
  const char *key;
  json_t *value;
  json_object_foreach(metadata, key, value)
  {
    const int r = mo_controller_put_metadata(controller, key, json_string_value(value));
    if (r < 0)
      return r;
  }
  return mo_controller_complete_metadata(controller);
}

int mo_safetensors_parse(const char *header, uint32_t header_size, uint64_t size,
                         struct mo_safetensors *file, struct mo_message *message)
{
  json_t *root = NULL;
  int r = parse_json(header, header_size, &root, message);
  if (r < 0)
    return r;
  json_t *metadata = json_object_get(root, "__metadata__");
  struct described described;
  file->controller = NULL;
  r = check_metadata(metadata, &described, message);
  if (r == MO_OK)
    r = check_tensors(root, described.workspace, size - 8 - header_size, file, message);
  if (r == MO_OK) {
    r = mo_controller_allocate(described.workspace, described.sensor, &file->controller);
    if (r == MO_OK) {
      file->controller->control_period_s = described.control_period_s;
      r = copy_metadata(file->controller, metadata);
    }
    if (r < 0)
      mo_fail(message, r, "the controller does not fit in memory");
  }
  json_decref(root);
  if (r < 0) {
    mo_controller_free(file->controller);
    file->controller = NULL;
    return r;
  }
  for (int i = 0; i < MO_CONTROLLER_TENSORS; i++)
    file->offsets[i] += 8 + (uint64_t)header_size;
  return MO_OK;
}

int mo_safetensors_check_values(const struct mo_safetensors *file, struct mo_message *message)
{
  for (int i = 0; i < MO_CONTROLLER_TENSORS; i++) {
    const float *values = file->controller->parameters + file->tensors[i].offset;
    for (uint64_t k = 0; k < file->tensors[i].count; k++) {
      if (!isfinite(values[k]))
        return mo_fail(message, MO_ERR_FORMAT,
                       "tensor %s: value %" PRIu64 " is %s; all values must be finite",
                       file->tensors[i].name, k, isnan(values[k]) ? "NaN" : "infinite");
      if (fabsf(values[k]) > MO_WEIGHT_LIMIT)
        return mo_fail(message, MO_ERR_FORMAT,
                       "tensor %s: value %" PRIu64 " is %s; values must lie within ±%s",
                       file->tensors[i].name, k, MO_NUMBER((double)values[k]),
                       MO_NUMBER((double)MO_WEIGHT_LIMIT));
    }
  }
  return MO_OK;
}
