/* scene.c: see scene.h. */
#include "api/scene.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"
#include "api/job_json.h"
#include "api/states.h"
#include "rollout/course.h"
#include "rollout/physics.h"
#include "rollout/window.h"
#include "world/environment.h"
#include "world/task_json.h"

/* ---- arrays ---- */

static void write_number(struct mo_text *text, const struct mo_scene_array *array, size_t i)
{
  const bool is_float = array->type[0] == 'f';
  if (is_float && array->width == sizeof(double))
    mo_text_json_number(text, ((const double *)array->numbers)[i]);
  else if (is_float)
    mo_text_json_float(text, ((const float *)array->numbers)[i]);
  else if (array->width == sizeof(uint16_t))
    mo_text_format(text, "%u", ((const uint16_t *)array->numbers)[i]);
  else if (array->type[0] == 'i')
    mo_text_format(text, "%d", ((const int8_t *)array->numbers)[i]);
  else
    mo_text_format(text, "%u", ((const uint8_t *)array->numbers)[i]);
}

/* Writes an array as JSON, with brackets where rows begin and end. */
static void write_rows(struct mo_text *text, const struct mo_scene_array *array)
{
  size_t n = 1;
  for (unsigned d = 0; d < array->dimensions; d++)
    n *= array->shape[d];
  if (n == 0)
    mo_text_add(text, "[]");
  for (size_t i = 0; i < n; i++) {
    size_t rest = i, end = i + 1;
    mo_text_add(text, i > 0 ? "," : "");
    for (unsigned d = array->dimensions; d-- > 0 && rest % array->shape[d] == 0;) {
      mo_text_add(text, "[");
      rest /= array->shape[d];
    }
    write_number(text, array, i);
    for (unsigned d = array->dimensions; d-- > 0 && end % array->shape[d] == 0;) {
      mo_text_add(text, "]");
      end /= array->shape[d];
    }
  }
}

bool mo_scene_channel(const struct mo_recording *recording, enum mo_channel channel,
                      uint32_t frames, uint32_t n_masses, uint32_t n_springs,
                      struct mo_scene_array *array)
{
  const void *numbers = mo_recording_array(recording, channel);
  const size_t width = mo_channel_width(channel);
  switch (channel) {
  case MO_RECORD_COM:
    *array = (struct mo_scene_array){"com_m", "float64", numbers, width, {frames, 3}, 2};
    break;
  case MO_RECORD_MASSES:
    *array =
        (struct mo_scene_array){"masses_m", "float32", numbers, width, {frames, n_masses, 3}, 3};
    break;
  case MO_RECORD_ACTUATION:
    *array = (struct mo_scene_array){"actuation", "int8", numbers, width, {frames, n_springs}, 2};
    break;
  case MO_RECORD_CONTACTS:
    *array = (struct mo_scene_array){"contacts", "uint8", numbers, width, {frames, n_masses}, 2};
  }
  return numbers != NULL;
}

void mo_scene_write_array(struct mo_text *text, struct mo_text *arrays,
                          const struct mo_scene_array *array)
{
  static const char zeros[8] = {0};
  size_t bytes = array->width;
  for (unsigned i = 0; i < array->dimensions; i++)
    bytes *= array->shape[i];
  mo_text_name(text, array->name);
  if (arrays == NULL) {
    write_rows(text, array);
    return;
  }
  mo_text_object(text);
  mo_text_member_count(text, "offset", arrays->size);
  mo_text_member(text, "type", array->type);
  mo_text_name(text, "shape");
  mo_text_counts(text, array->shape, array->dimensions);
  mo_text_add(text, "}");
  mo_text_bytes(arrays, array->numbers, bytes);
  mo_text_bytes(arrays, zeros, (8 - bytes % 8) % 8);
}

/* ---- bodies ---- */

/* The corners of each side of a voxel, counter-clockwise from outside. Corner c of a voxel is at
 * x = c >> 2, y = c >> 1 & 1, z = c & 1: its masses in ascending order. */
static const struct {
  int8_t step[3];
  uint8_t corners[4];
} sides[6] = {{{-1, 0, 0}, {0, 1, 3, 2}}, {{1, 0, 0}, {4, 6, 7, 5}},  {{0, -1, 0}, {0, 4, 5, 1}},
              {{0, 1, 0}, {2, 3, 7, 6}},  {{0, 0, -1}, {0, 2, 6, 4}}, {{0, 0, 1}, {1, 5, 7, 3}}};

/* Returns whether a genotype has a voxel at (x, y, z); false outside the workspace. */
static bool has_voxel(const struct mo_genotype *genotype, int x, int y, int z)
{
  const struct mo_workspace workspace = genotype->workspace;
  if (x < 0 || y < 0 || z < 0 || x >= workspace.nx || y >= workspace.ny || z >= workspace.nz)
    return false;
  const uint32_t voxel = ((uint32_t)x * workspace.ny + (uint32_t)y) * workspace.nz + (uint32_t)z;
  return genotype->words[voxel >> 6] >> (voxel & 63) & 1;
}

/* Returns the position of a lattice mass among the masses of the body. */
static uint16_t position_of(const struct mo_body *body, uint32_t mass)
{
  uint32_t low = 0, high = body->n_masses;
  while (high - low > 1) {
    const uint32_t middle = (low + high) / 2;
    if (body->mass_lattice[middle] <= mass)
      low = middle;
    else
      high = middle;
  }
  return (uint16_t)low;
}

struct geometry {
  uint16_t (*springs)[2], (*voxels)[8], (*faces)[5];
  float *rest_lengths_m;
  uint32_t n_voxels, n_faces;
};

static void add_voxel(const struct mo_lattice *lattice, const struct mo_body *body,
                      const struct mo_genotype *genotype, uint32_t voxel, struct geometry *geometry)
{
  const struct mo_workspace w = lattice->workspace;
  const int x = (int)(voxel / (w.ny * w.nz)), y = (int)(voxel / w.nz % w.ny),
            z = (int)(voxel % w.nz);
  uint16_t *masses = geometry->voxels[geometry->n_voxels];
  for (uint32_t c = 0; c < 8; c++)
    masses[c] = position_of(body, lattice->voxel_mass[voxel * 8 + c]);
  for (int side = 0; side < 6; side++) {
    const int8_t *step = sides[side].step;
    if (has_voxel(genotype, x + step[0], y + step[1], z + step[2]))
      continue;
    uint16_t *face = geometry->faces[geometry->n_faces++];
    for (int k = 0; k < 4; k++)
      face[k] = masses[sides[side].corners[k]];
    face[4] = (uint16_t)geometry->n_voxels;
  }
  geometry->n_voxels++;
}

int mo_scene_write_body(struct mo_text *text, struct mo_text *arrays,
                        const struct mo_lattice *lattice, const struct mo_body *body,
                        const struct mo_genotype *genotype)
{
  struct geometry geometry = {.springs = malloc(body->n_springs * sizeof(*geometry.springs)),
                              .voxels = malloc(body->n_voxels * sizeof(*geometry.voxels)),
                              .faces = malloc((size_t)body->n_voxels * 6 * sizeof(*geometry.faces)),
                              .rest_lengths_m =
                                  malloc(body->n_springs * sizeof(*geometry.rest_lengths_m))};
  const bool good = geometry.springs != NULL && geometry.voxels != NULL && geometry.faces != NULL &&
                    geometry.rest_lengths_m != NULL;
  for (uint32_t s = 0; good && s < body->n_springs; s++) {
    geometry.springs[s][0] = (uint16_t)body->spring_a[s];
    geometry.springs[s][1] = (uint16_t)body->spring_b[s];
    geometry.rest_lengths_m[s] = (float)body->spring_rest_m[s];
  }
  for (uint32_t v = 0; good && v < lattice->n_voxels; v++)
    if (genotype->words[v >> 6] >> (v & 63) & 1)
      add_voxel(lattice, body, genotype, v, &geometry);
  const struct mo_scene_array all[] = {
      {"masses", "uint16", body->mass_xyz, 2, {body->n_masses, 3}, 2},
      {"springs", "uint16", geometry.springs, 2, {body->n_springs, 2}, 2},
      {"rest_lengths_m", "float32", geometry.rest_lengths_m, 4, {body->n_springs}, 1},
      {"voxels", "uint16", geometry.voxels, 2, {geometry.n_voxels, 8}, 2},
      {"faces", "uint16", geometry.faces, 2, {geometry.n_faces, 5}, 2}};
  for (size_t i = 0; good && i < sizeof(all) / sizeof(all[0]); i++)
    mo_scene_write_array(text, arrays, &all[i]);
  free(geometry.springs);
  free(geometry.voxels);
  free(geometry.faces);
  free(geometry.rest_lengths_m);
  return good ? MO_OK : MO_ERR_NO_MEMORY;
}

/* ---- whole scenes ---- */

/* Positions that are at most this far from their midpoint have an error of at most 0.5 mm when
 * stored as int16. */
#define INT16_HALF_M 32.0

/* Writes rows of numbers as an array of float32. */
static void write_table(struct mo_text *text, struct mo_text *arrays, const struct mo_field *field,
                        const struct mo_environment *environment)
{
  const uint32_t side = field->side;
  const double *from = mo_environment_numbers(environment, field);
  float numbers[sizeof(*environment) / sizeof(double)] = {0};
  for (uint32_t i = 0; i < field->n; i++)
    numbers[i] = (float)from[i];
  mo_scene_write_array(
      text, arrays,
      &(struct mo_scene_array){field->name, "float32", numbers, 4, {field->n / side, side}, 2});
}

static void write_environment(struct mo_text *text, struct mo_text *arrays,
                              const struct mo_environment *environment)
{
  struct mo_sha256 hash;
  if (arrays == NULL) {
    mo_environment_write(text, environment);
    return;
  }
  mo_environment_hash(environment, &hash);
  mo_text_object(text);
  mo_member_hash(text, "sha256", &hash);
  for (size_t i = 0; i < mo_place_fields.n; i++) {
    const struct mo_fields field = {&mo_place_fields.rows[i], 1};
    if (!mo_place_has(environment, i))
      continue;
    if (field.rows->side > 0)
      write_table(text, arrays, field.rows, environment);
    else
      mo_fields_write(text, &field, environment);
  }
  mo_environment_write_tasks(text, environment);
  mo_text_add(text, "}");
}

/* The midpoint of the positions, and the length of one int16 unit, so that all positions fit. */
struct quantum {
  double origin_m[3], unit_m;
};

/* Returns false if positions are too far apart for the promised error. */
static bool quantum_of(const float (*positions_m)[3], size_t n, struct quantum *quantum)
{
  double half_m = 0;
  for (int axis = 0; axis < 3; axis++) {
    float low_m = positions_m[0][axis], high_m = low_m;
    for (size_t i = 1; i < n; i++) {
      low_m = fminf(low_m, positions_m[i][axis]);
      high_m = fmaxf(high_m, positions_m[i][axis]);
    }
    quantum->origin_m[axis] = ((double)low_m + (double)high_m) / 2;
    half_m = fmax(half_m, ((double)high_m - (double)low_m) / 2);
  }
  quantum->unit_m = fmax(half_m, 1e-3) / INT16_MAX;
  return half_m <= INT16_HALF_M;
}

/* Writes positions as int16 with their origin and unit. Returns false, and writes nothing, if they
 * are too far apart. *error: MO_ERR_NO_MEMORY, or unchanged. */
static bool write_int16(struct mo_text *text, struct mo_text *arrays,
                        const struct mo_scene_array *masses, int *error)
{
  const float(*positions_m)[3] = masses->numbers;
  const size_t n = (size_t)masses->shape[0] * masses->shape[1];
  struct quantum quantum;
  if (n == 0 || !quantum_of(positions_m, n, &quantum))
    return false;
  int16_t(*numbers)[3] = malloc(n * sizeof(*numbers));
  if (numbers == NULL) {
    *error = MO_ERR_NO_MEMORY;
    return true;
  }
  for (size_t i = 0; i < n; i++)
    for (int axis = 0; axis < 3; axis++)
      numbers[i][axis] =
          (int16_t)lrint(((double)positions_m[i][axis] - quantum.origin_m[axis]) / quantum.unit_m);
  struct mo_scene_array array = *masses;
  array.name = "masses_int16";
  array.type = "int16";
  array.numbers = numbers;
  array.width = sizeof(int16_t);
  mo_scene_write_array(text, arrays, &array);
  free(numbers);
  mo_text_open(text, "masses_origin_m", "[");
  for (int axis = 0; axis < 3; axis++) {
    mo_text_add(text, axis > 0 ? "," : "");
    mo_text_json_number(text, quantum.origin_m[axis]);
  }
  mo_text_add(text, "]");
  mo_text_member_number(text, "masses_unit_m", quantum.unit_m);
  return true;
}

static int write_recording(struct mo_text *text, struct mo_text *arrays,
                           const struct mo_rollouts *rollouts, const struct mo_rolled *rolled,
                           const struct mo_body *body, bool is_int16)
{
  struct mo_scene_array array;
  int error = MO_OK;
  for (unsigned i = 0; i < MO_CHANNELS; i++) {
    const enum mo_channel channel = (enum mo_channel)(1U << i);
    if (!mo_scene_channel(&rolled->recording, channel, rollouts->n_frames, body->n_masses,
                          body->n_springs, &array))
      continue;
    if (!is_int16 || channel != MO_RECORD_MASSES || !write_int16(text, arrays, &array, &error))
      mo_scene_write_array(text, arrays, &array);
  }
  return error;
}

/* Finds the center of mass in a frame. Returns false if no recorded channel contains it. */
static bool com_at(const struct mo_recording *recording, uint32_t frame, uint32_t n_masses,
                   double com_m[3])
{
  const float *masses = recording->mass_m;
  if (recording->com_m != NULL)
    memcpy(com_m, recording->com_m + (size_t)frame * 3, 3 * sizeof(double));
  else if (masses != NULL)
    for (int axis = 0; axis < 3; axis++) {
      double sum = 0;
      for (uint32_t m = 0; m < n_masses; m++)
        sum += (double)masses[((size_t)frame * n_masses + m) * 3 + (size_t)axis];
      com_m[axis] = sum / n_masses;
    }
  return recording->com_m != NULL || masses != NULL;
}

/* Writes the position of the light in each frame, computed from the task's guide and the recorded
 * centers of mass. May fail with MO_ERR_NO_MEMORY. */
static int write_lights(struct mo_text *text, struct mo_text *arrays,
                        const struct mo_rollouts *rollouts, uint32_t rollout, uint32_t n_masses)
{
  const struct mo_rolled *rolled = &rollouts->rollouts[rollout];
  const struct mo_environment *environment =
      &rollouts->environments[rollout % rollouts->n_environments];
  const struct mo_state *from = rollouts->from != NULL ? &rollouts->from[rollout].state : NULL;
  const struct mo_scheme *scheme = &rollouts->physics.scheme;
  const uint32_t n = rollouts->n_frames;
  struct mo_course course;
  struct mo_track track;
  double com_m[3], start_m[3], light_m[3];
  if (environment->task.guide.kind == MO_GUIDE_FIXED ||
      !com_at(&rolled->recording, 0, n_masses, com_m))
    return MO_OK;
  float(*lights_m)[3] = calloc(n, sizeof(*lights_m));
  if (lights_m == NULL)
    return MO_ERR_NO_MEMORY;
  const struct mo_window window = mo_window_of(scheme, from);
  const uint32_t first = window.first_step,
                 begun = mo_window_begin(&window, from, environment, com_m, start_m);
  mo_window_course(&window, from, begun, environment, scheme, start_m, &course, &track);
  for (uint32_t frame = 0; frame < n; frame++) {
    const double t_s = ((double)frame * rolled->recording.stride + (first - begun)) * scheme->dt_s;
    if ((frame > 0 || begun < first) && com_at(&rolled->recording, frame, n_masses, com_m))
      mo_course_advance(&course, t_s, com_m, &track);
    mo_course_light(&course, t_s, &track, light_m);
    for (int axis = 0; axis < 3; axis++)
      lights_m[frame][axis] = (float)light_m[axis];
  }
  mo_scene_write_array(text, arrays,
                       &(struct mo_scene_array){"lights_m", "float32", lights_m, 4, {n, 3}, 2});
  free(lights_m);
  return MO_OK;
}

static int write_designs(struct mo_text *text, struct mo_text *arrays,
                         const struct mo_lattice *lattice, const struct mo_rollouts *rollouts)
{
  int error = MO_OK;
  mo_text_open(text, "designs", "[");
  for (uint32_t i = 0; i < rollouts->n_designs && error == MO_OK; i++) {
    const struct mo_rolled_design *design = &rollouts->designs[i];
    mo_text_object(text);
    mo_member_form(text, "id", &design->form);
    mo_member_robot(text, &design->genotype);
    mo_member_orientation(text, design->orientation);
    mo_member_genotype(text, "genotype", &design->genotype);
    mo_text_member_count(text, "repaired", design->dropped);
    mo_text_member_number(text, "score", design->score);
    if (arrays != NULL)
      error = mo_scene_write_body(text, arrays, lattice, design->body, &design->genotype);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
  return error;
}

/* Writes the header of a scene or, if `arrays` is NULL, the same as JSON. */
static int write_scene(struct mo_text *text, struct mo_text *arrays,
                       const struct mo_lattice *lattice, const struct mo_rollouts *rollouts,
                       bool is_int16)
{
  const uint32_t n = rollouts->n_environments;
  struct mo_sha256 physics;
  struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX];
  uint32_t n_warnings = mo_warn_of_physics(&rollouts->physics, warnings), unstable = 0;
  for (uint32_t k = 0; k < n && unstable == 0; k++)
    unstable =
        mo_warn_of_world(&rollouts->physics, &rollouts->environments[k], k, &warnings[n_warnings]);
  /* Set only if the physics is stable without factors, so two warnings fit. */
  n_warnings += unstable;
  mo_physics_hash(&rollouts->physics, rollouts->precision, rollouts->sensor, &physics);
  mo_text_object(text);
  mo_member_hash(text, "controller", &rollouts->controller);
  mo_member_hash(text, "physics_sha256", &physics);
  mo_text_name(text, "physics");
  mo_fields_write_object(text, &mo_physics_fields, &rollouts->physics);
  mo_text_member(text, "precision", rollouts->precision == MO_FLOAT64 ? "float64" : "float32");
  mo_member_warnings(text, warnings, n_warnings);
  if (arrays != NULL)
    mo_text_member_number(text, "frame_s",
                          rollouts->rollouts[0].recording.stride * rollouts->physics.scheme.dt_s);
  mo_text_open(text, "environments", "[");
  for (uint32_t k = 0; k < n; k++)
    write_environment(text, arrays, &rollouts->environments[k]);
  mo_text_add(text, "]");
  int error = write_designs(text, arrays, lattice, rollouts);
  mo_text_open(text, "rollouts", "[");
  for (uint32_t i = 0; i < rollouts->n_designs && error == MO_OK; i++)
    for (uint32_t k = 0; k < n && error == MO_OK; k++) {
      const struct mo_rolled *rolled = &rollouts->rollouts[i * n + k];
      mo_text_object(text);
      mo_text_member_count(text, "design", i);
      mo_text_member_count(text, "environment", k);
      mo_text_member_number(text, "loss", rolled->outcome.loss);
      mo_members_value(text, &rollouts->environments[k].task, rolled->outcome.loss);
      mo_text_member_count(text, "diverged_step", (uint64_t)rolled->outcome.diverged_step);
      const struct mo_body *body = rollouts->designs[i].body;
      if (arrays != NULL) {
        error = write_recording(text, arrays, rollouts, rolled, body, is_int16);
        error = error != MO_OK ? error
                               : write_lights(text, arrays, rollouts, i * n + k, body->n_masses);
      }
      if (rollouts->ends != NULL)
        mo_member_state(text, &rollouts->ends[i * n + k], &rollouts->designs[i].genotype,
                        &rollouts->environments[k].task, &rollouts->physics);
      mo_text_add(text, "}");
    }
  mo_text_add(text, "]}");
  return error;
}

void mo_reply_rollouts(struct mo_request *request, const struct mo_rollouts *rollouts,
                       enum mo_rollouts_form form)
{
  const bool as_scene = form != MO_ROLLOUTS_JSON;
  struct mo_text header = {0}, arrays = {0};
  size_t size = 0;
  int error = write_scene(&header, as_scene ? &arrays : NULL, mo_api_of(request)->lattice, rollouts,
                          form == MO_ROLLOUTS_INT16);
  if (error == MO_OK && !as_scene) {
    mo_reply_json(request, 200, &header);
    return;
  }
  char *joined = error == MO_OK ? mo_scene_join(&header, &arrays, &size) : NULL;
  mo_text_free(&header);
  mo_text_free(&arrays);
  if (joined == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "scene");
  else
    mo_reply_bytes(request, 200, MO_SCENE_TYPE, joined, size);
}

char *mo_scene_join(struct mo_text *header, struct mo_text *arrays, size_t *size)
{
  /* Spaces after the header align the arrays to 8 bytes. */
  while (!header->failed && (4 + header->size) % 8 != 0)
    mo_text_bytes(header, " ", 1);
  char *joined = header->failed || arrays->failed ? NULL : malloc(4 + header->size + arrays->size);
  if (joined != NULL) {
    const uint32_t length = (uint32_t)header->size;
    memcpy(joined, &length, 4);
    memcpy(joined + 4, header->data, header->size);
    if (arrays->size > 0)
      memcpy(joined + 4 + header->size, arrays->data, arrays->size);
    *size = 4 + header->size + arrays->size;
  }
  mo_text_free(header);
  mo_text_free(arrays);
  return joined;
}
