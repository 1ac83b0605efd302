/* wire.c: encodes and decodes leases. Four leases need at most 100 MB, not counting their grids,
 * which are as large in memory as in the message. */
#include "fleet/wire.h"

#include "fleet/wire_codec.h"
#include "rollout/gradient_options.h"
#include "rollout/physics.h"
#include "world/environment.h"

struct lease {
  struct mo_lease_id id;
  uint32_t flags, n_environments, n_blocks, n_rows;
  struct mo_sha256 controller;
};
_Static_assert(sizeof(struct lease) == 64, "without padding");

#define ON_DEVICE         1u /* flags */
#define GRADIENT          2u
#define MEASURES          4u
#define PHYSICS_SHIFT     8  /* version of the packed physics, minus 1, in one byte */
#define GRADIENT_SHIFT    16 /* version of the packed options, minus 1 */
#define ENVIRONMENT_SHIFT 24 /* version of the packed environments, minus 1 */

static size_t genotype_bytes(struct mo_workspace workspace)
{
  return (mo_workspace_voxels(workspace) + 7) / 8;
}

static int check_workspace(struct mo_workspace workspace, struct mo_message *message)
{
  if (mo_workspace_check(workspace) != MO_OK || mo_workspace_words(workspace) > MO_WIRE_WORDS_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "bodies for workers may have at most %d voxels",
                   MO_WIRE_WORDS_MAX * 64);
  return MO_OK;
}

/* Limits of the counts of a lease, for encoding and decoding. */
static bool counts_fit(uint32_t n_environments, uint32_t n_blocks, uint32_t n_rows)
{
  return n_environments >= 1 && n_environments <= MO_WIRE_ENVIRONMENTS_MAX && n_blocks >= 1 &&
         n_rows >= n_blocks && n_rows <= MO_WIRE_ROWS_MAX &&
         n_rows <= (uint64_t)n_blocks * MO_BLOCK_LANES;
}

/* Limits of a lease with measures, also for both. */
static bool measures_fit(const struct mo_wire_lease *lease)
{
  return !lease->has_measures ||
         (lease->n_rows <= MO_WIRE_MEASURED_MAX && lease->n_parameters == 0);
}

/* Limits of a gradient, also for both. Robots are blocks of one environment. */
static bool gradient_fits(const struct mo_wire_lease *lease)
{
  return lease->n_parameters <= MO_WIRE_PARAMETERS_MAX && lease->n_blocks <= MO_GRADIENT_SHARD &&
         lease->n_rows == lease->n_blocks;
}

static unsigned gradient_version(const struct mo_wire_lease *lease)
{
  const struct mo_gradient_options defaults = mo_default_gradient_options();
  return mo_fields_version(&mo_gradient_packed_fields, &lease->gradient, &defaults);
}

static size_t gradient_bytes(const struct mo_wire_lease *lease)
{
  return mo_fields_packed_bytes(&mo_gradient_packed_fields, gradient_version(lease)) +
         sizeof(lease->n_parameters);
}

static unsigned environment_version(const struct mo_wire_lease *lease)
{
  unsigned version = 1;
  for (uint32_t e = 0; e < lease->n_environments; e++) {
    const unsigned needed = mo_environment_version(&lease->environments[e]);
    version = needed > version ? needed : version;
  }
  return version;
}

static size_t environments_bytes(const struct mo_wire_lease *lease)
{
  const unsigned version = environment_version(lease);
  size_t size = 0;
  for (uint32_t e = 0; e < lease->n_environments; e++)
    size += mo_environment_packed_bytes(&lease->environments[e], version);
  return size;
}

static size_t lease_bytes(const struct mo_wire_lease *lease, struct mo_workspace workspace)
{
  return sizeof(struct lease) +
         mo_fields_packed_bytes(&mo_physics_fields, mo_physics_version(&lease->physics)) +
         sizeof(uint32_t) + (lease->n_parameters > 0 ? gradient_bytes(lease) : 0) +
         environments_bytes(lease) + lease->n_blocks * (genotype_bytes(workspace) + 1) +
         lease->n_rows * sizeof(uint16_t);
}

static void put_lease(struct codec *codec, const struct mo_wire_lease *lease,
                      struct mo_workspace workspace)
{
  const uint32_t zero = 0;
  const unsigned physics = mo_physics_version(&lease->physics), gradient = gradient_version(lease);
  const unsigned environment = environment_version(lease);
  const struct lease head = {
      .id = lease->id,
      .flags = (lease->back_end == MO_ON_DEVICE ? ON_DEVICE : 0) | (physics - 1) << PHYSICS_SHIFT |
               (lease->n_parameters > 0 ? GRADIENT | (gradient - 1) << GRADIENT_SHIFT : 0) |
               (lease->has_measures ? MEASURES : 0) | (environment - 1) << ENVIRONMENT_SHIFT,
      .n_environments = lease->n_environments,
      .n_blocks = lease->n_blocks,
      .n_rows = lease->n_rows,
      .controller = lease->controller};
  put(codec, &head, sizeof(head));
  put_packed(codec, &mo_physics_fields, physics, &lease->physics);
  put(codec, &zero, sizeof(zero));
  if (lease->n_parameters > 0) {
    put_packed(codec, &mo_gradient_packed_fields, gradient, &lease->gradient);
    put(codec, &lease->n_parameters, sizeof(lease->n_parameters));
  }
  for (uint32_t e = 0; e < lease->n_environments; e++) {
    mo_environment_pack(&lease->environments[e], environment, codec->to + codec->at);
    codec->at += mo_environment_packed_bytes(&lease->environments[e], environment);
  }
  for (uint32_t b = 0; b < lease->n_blocks; b++) {
    const struct mo_wire_block *block = &lease->blocks[b];
    const uint8_t n = (uint8_t)block->n_environments;
    put(codec, block->genotype, genotype_bytes(workspace));
    put(codec, &n, sizeof(n));
    put(codec, block->environments, n * sizeof(uint16_t));
  }
}

int mo_wire_put_leases(const struct mo_wire_leases *leases, struct mo_workspace workspace,
                       uint8_t **bytes, size_t *size)
{
  struct codec codec = {.size = sizeof(struct header)};
  if (leases->n > MO_WIRE_LEASES_MAX || check_workspace(workspace, NULL) != MO_OK)
    return MO_ERR_LIMIT;
  for (uint32_t i = 0; i < leases->n; i++) {
    const struct mo_wire_lease *lease = &leases->items[i];
    uint64_t rows = 0;
    for (uint32_t b = 0; b < lease->n_blocks; b++) {
      const uint32_t n = lease->blocks[b].n_environments;
      rows += n;
      if (n < 1 || n > MO_BLOCK_LANES)
        return MO_ERR_LIMIT;
    }
    if (rows != lease->n_rows || (lease->n_parameters > 0 && !gradient_fits(lease)) ||
        !measures_fit(lease) || !counts_fit(lease->n_environments, lease->n_blocks, lease->n_rows))
      return MO_ERR_LIMIT;
    codec.size += lease_bytes(lease, workspace);
  }
  int error = open_message(WIRE_LEASES, leases->n, &codec);
  if (error != MO_OK)
    return error;
  for (uint32_t i = 0; i < leases->n; i++)
    put_lease(&codec, &leases->items[i], workspace);
  *bytes = codec.to;
  *size = codec.at;
  return MO_OK;
}

/* The robots of a gradient are as they were drawn; other bodies are placed. MO_ERR_FORMAT,
 * MO_ERR_NO_MEMORY. */
static int check_genotype(const uint64_t *genotype, struct mo_workspace workspace, bool is_placed,
                          struct mo_message *message, uint32_t i, uint32_t b)
{
  const uint32_t voxels = mo_workspace_voxels(workspace), words = mo_workspace_words(workspace);
  uint64_t placed[MO_WIRE_WORDS_MAX];
  if (voxels % 64 != 0 && genotype[words - 1] >> voxels % 64 != 0)
    return mo_fail(message, MO_ERR_FORMAT, "lease %u, block %u: bits are set beyond voxel %u", i, b,
                   voxels - 1);
  int contiguous = mo_genotype_is_contiguous(workspace, genotype);
  if (contiguous < 0)
    return contiguous;
  if (contiguous == 0)
    return mo_fail(message, MO_ERR_FORMAT,
                   "lease %u, block %u: the body must be one connected piece, and not empty", i, b);
  if (!is_placed)
    return MO_OK;
  memcpy(placed, genotype, words * sizeof(uint64_t));
  mo_genotype_place(workspace, placed);
  if (memcmp(placed, genotype, words * sizeof(uint64_t)) != 0)
    return mo_fail(message, MO_ERR_FORMAT,
                   "lease %u, block %u: the body must be in its canonical place", i, b);
  return MO_OK;
}

static int get_block(struct codec *codec, struct mo_workspace workspace,
                     const struct mo_wire_lease *lease, uint32_t i, uint32_t b,
                     struct mo_message *message)
{
  struct mo_wire_block *block = &lease->blocks[b];
  uint8_t n = 0;
  memset(block, 0, sizeof(*block));
  if (!get(codec, block->genotype, genotype_bytes(workspace)) || !get(codec, &n, sizeof(n)))
    return cut_off(message, "lease", i);
  if (n < 1 || n > MO_BLOCK_LANES)
    return mo_fail(message, MO_ERR_FORMAT,
                   "lease %u, block %u: a block must have 1 to %d environments, got %u", i, b,
                   MO_BLOCK_LANES, n);
  block->n_environments = n;
  if (!get(codec, block->environments, n * sizeof(uint16_t)))
    return cut_off(message, "lease", i);
  for (uint32_t k = 0; k < n; k++)
    if (block->environments[k] >= lease->n_environments)
      return mo_fail(message, MO_ERR_FORMAT,
                     "lease %u, block %u: environment %u is out of range; the lease has %u", i, b,
                     block->environments[k], lease->n_environments);
  return check_genotype(block->genotype, workspace, lease->n_parameters == 0, message, i, b);
}

static int get_packed(struct codec *codec, const struct mo_fields *fields, unsigned version,
                      void *settings, uint32_t i, struct mo_message *message)
{
  const size_t size = mo_fields_packed_bytes(fields, version);
  if (size > codec->size - codec->at)
    return cut_off(message, "lease", i);
  codec->at += size;
  return mo_fields_unpack(fields, version, codec->from + codec->at - size, settings)
             ? MO_OK
             : mo_fail(message, MO_ERR_FORMAT, "lease %u: unknown flags", i);
}

static int get_gradient(struct codec *codec, struct mo_wire_lease *lease, unsigned version,
                        uint32_t i, struct mo_message *message)
{
  lease->gradient = mo_default_gradient_options();
  int error = get_packed(codec, &mo_gradient_packed_fields, version, &lease->gradient, i, message);
  if (error != MO_OK)
    return error;
  if (!get(codec, &lease->n_parameters, sizeof(lease->n_parameters)))
    return cut_off(message, "lease", i);
  if (gradient_version(lease) != version)
    return mo_fail(message, MO_ERR_FORMAT, "lease %u: unknown flags", i);
  if (lease->n_parameters == 0 || !gradient_fits(lease) || lease->gradient.weight == 0 ||
      mo_gradient_options_check(&lease->gradient) != MO_OK)
    return mo_fail(
        message, MO_ERR_FORMAT,
        "lease %u: a gradient of %u robots and %u parameters with weight %g is out of range", i,
        lease->n_blocks, lease->n_parameters, lease->gradient.weight);
  return MO_OK;
}

/* environment: the version of the packed environments. */
static int get_head(struct codec *codec, struct mo_wire_lease *lease, unsigned *environment,
                    uint32_t i, struct mo_message *message)
{
  struct lease head;
  struct mo_message why = {""};
  uint32_t zero;
  if (!get(codec, &head, sizeof(head)))
    return cut_off(message, "lease", i);
  const unsigned physics = 1 + (head.flags >> PHYSICS_SHIFT & UINT8_MAX);
  const unsigned gradient = 1 + (head.flags >> GRADIENT_SHIFT & UINT8_MAX);
  *environment = 1 + (head.flags >> ENVIRONMENT_SHIFT);
  lease->physics = mo_paper_physics();
  int error = get_packed(codec, &mo_physics_fields, physics, &lease->physics, i, message);
  if (error != MO_OK)
    return error;
  if (!get(codec, &zero, sizeof(zero)))
    return cut_off(message, "lease", i);
  lease->id = head.id;
  lease->controller = head.controller;
  lease->back_end = head.flags & ON_DEVICE ? MO_ON_DEVICE : MO_ON_CPU;
  lease->n_environments = head.n_environments;
  lease->n_blocks = head.n_blocks;
  lease->n_rows = head.n_rows;
  lease->has_measures = (head.flags & MEASURES) != 0;
  if ((head.flags & UINT8_MAX) > (ON_DEVICE | GRADIENT | MEASURES) || zero != 0 ||
      (lease->has_measures && (head.flags & GRADIENT) != 0) ||
      (gradient != 1 && (head.flags & GRADIENT) == 0) ||
      mo_physics_version(&lease->physics) != physics)
    return mo_fail(message, MO_ERR_FORMAT, "lease %u: unknown flags", i);
  if (mo_physics_check(&lease->physics, &why) != MO_OK)
    return mo_fail(message, MO_ERR_FORMAT, "lease %u: %s", i, why.text);
  if (!counts_fit(head.n_environments, head.n_blocks, head.n_rows) || !measures_fit(lease))
    return mo_fail(message, MO_ERR_FORMAT,
                   "lease %u: %u environments, %u blocks, %u rows are out of range", i,
                   head.n_environments, head.n_blocks, head.n_rows);
  return head.flags & GRADIENT ? get_gradient(codec, lease, gradient, i, message) : MO_OK;
}

static int get_environment(struct codec *codec, unsigned version,
                           struct mo_environment *environment, uint32_t i,
                           struct mo_message *message)
{
  size_t used = 0;
  const int error = mo_environment_unpack(version, codec->from + codec->at, codec->size - codec->at,
                                          environment, &used);
  codec->at += used;
  if (error != MO_ERR_FORMAT)
    return error;
  if (used == 0 && version <= MO_ENVIRONMENT_VERSION)
    return cut_off(message, "lease", i);
  return mo_fail(message, MO_ERR_FORMAT, "lease %u: unknown flags, or an invalid grid", i);
}

static int get_environments(struct codec *codec, struct mo_wire_lease *lease, unsigned version,
                            uint32_t i, struct mo_message *message)
{
  struct mo_message why = {""};
  int error = MO_OK;
  for (uint32_t e = 0; e < lease->n_environments && error == MO_OK; e++) {
    struct mo_environment *environment = &lease->environments[e];
    uint32_t where = 0;
    error = get_environment(codec, version, environment, i, message);
    if (error == MO_OK && mo_environment_check(environment, &where) == MO_OK) {
      if (mo_physics_check_in(&lease->physics, environment, NULL, &why) != MO_OK)
        error = mo_fail(message, MO_ERR_FORMAT, "lease %u, environment %u: %s", i, e, why.text);
      continue;
    }
    if (error != MO_OK)
      continue;
    if (mo_task_check(&environment->task, &why) != MO_OK)
      error = mo_fail(message, MO_ERR_FORMAT, "lease %u, environment %u: %s", i, e, why.text);
    else if (where == MO_ENVIRONMENT_PROFILE)
      error =
          mo_fail(message, MO_ERR_FORMAT,
                  "lease %u, environment %u: the terrain is neither a grid nor a profile", i, e);
    else if (where > MO_ENVIRONMENT_PROFILE)
      error = mo_fail(message, MO_ERR_FORMAT,
                      "lease %u, environment %u: invalid damage, factors or drop", i, e);
    else
      error = mo_fail(message, MO_ERR_FORMAT,
                      "lease %u, environment %u: number %u must be finite and within its limit", i,
                      e, where);
  }
  if (error == MO_OK && environment_version(lease) != version)
    error = mo_fail(message, MO_ERR_FORMAT, "lease %u: unknown flags", i);
  return error;
}

static int get_lease(struct codec *codec, struct mo_workspace workspace,
                     struct mo_wire_lease *lease, uint32_t i, struct mo_message *message)
{
  unsigned environment = 1;
  int error = get_head(codec, lease, &environment, i, message);
  if (error != MO_OK)
    return error;
  lease->environments = calloc(lease->n_environments, sizeof(*lease->environments));
  lease->blocks = malloc(lease->n_blocks * sizeof(*lease->blocks));
  if (lease->environments == NULL || lease->blocks == NULL)
    return MO_ERR_NO_MEMORY;
  error = get_environments(codec, lease, environment, i, message);
  uint32_t rows = 0;
  for (uint32_t b = 0; b < lease->n_blocks && error == MO_OK; b++) {
    error = get_block(codec, workspace, lease, i, b, message);
    rows += lease->blocks[b].n_environments;
  }
  if (error == MO_OK && rows != lease->n_rows)
    error = mo_fail(message, MO_ERR_FORMAT,
                    "lease %u: its header gives %u rows, but its blocks have %u", i, rows,
                    lease->n_rows);
  return error;
}

int mo_wire_get_leases(const uint8_t *bytes, size_t size, struct mo_workspace workspace,
                       struct mo_wire_leases *leases, struct mo_message *message)
{
  struct codec codec = {.from = bytes, .size = size};
  uint32_t n = 0;
  memset(leases, 0, sizeof(*leases));
  int error = check_workspace(workspace, message);
  if (error == MO_OK)
    error = read_header(WIRE_LEASES, MO_WIRE_LEASES_MAX, &codec, &n, message);
  while (error == MO_OK && leases->n < n) {
    const uint32_t i = leases->n++;
    error = get_lease(&codec, workspace, &leases->items[i], i, message);
  }
  if (error == MO_OK)
    error = read_end(&codec, message);
  if (error != MO_OK)
    mo_wire_free_leases(leases);
  return error;
}

void mo_wire_free_lease(struct mo_wire_lease *lease)
{
  mo_environments_free(lease->environments, lease->n_environments);
  free(lease->blocks);
  lease->environments = NULL;
  lease->blocks = NULL;
}

void mo_wire_free_leases(struct mo_wire_leases *leases)
{
  for (uint32_t i = 0; i < leases->n; i++)
    mo_wire_free_lease(&leases->items[i]);
  memset(leases, 0, sizeof(*leases));
}
