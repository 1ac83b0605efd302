/* gradient_block.c: packs, the scratch of one worker, and the code between mo_gradient_block and
 * the kernels. */
#include "rollout/carve.h"
#include "rollout/fast.h"
#include "rollout/gradient_fast.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#define HUGE_PAGE ((size_t)2 << 20)

/* ---- packs ---- */

/* Places the arrays of `pack` from `base` on (NULL: only counts). Returns the bytes. */
static size_t lay_out(struct mo_gradient_pack *pack, char *base)
{
  struct carver carver = {base, 0};
  pack->input_weight = carve(&carver, (size_t)pack->n_masses * MO_HIDDEN, sizeof(float));
  pack->cpg_weight = carve(&carver, (size_t)MO_CPG_INPUTS * MO_HIDDEN, sizeof(float));
  for (int l = 0; l < MO_HIDDEN_LAYERS - 1; l++) {
    pack->forward_weight[l] = carve(&carver, (size_t)MO_HIDDEN * MO_HIDDEN, sizeof(float));
    pack->backward_weight[l] = carve(&carver, (size_t)MO_HIDDEN * MO_HIDDEN, sizeof(float));
  }
  pack->output_weight = carve(&carver, (size_t)pack->n_springs * MO_HIDDEN, sizeof(float));
  pack->output_bias = carve(&carver, pack->n_springs, sizeof(float));
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    pack->bias[l] = carve(&carver, MO_HIDDEN, sizeof(float));
    pack->gain[l] = carve(&carver, MO_HIDDEN, sizeof(float));
    pack->shift[l] = carve(&carver, MO_HIDDEN, sizeof(float));
  }
  return carver.used;
}

/* Packs (256 outputs, n inputs), row-major, into panels of outputs: (256 / panel, n, panel). */
static void pack_panels(const float *weight, size_t row, size_t n, size_t panel, float *panels)
{
  for (size_t o = 0; o < MO_HIDDEN; o++)
    for (size_t k = 0; k < n; k++)
      panels[((o / panel) * n + k) * panel + o % panel] = weight[o * row + k];
}

/* The same with inputs and outputs exchanged. */
static void pack_transposed(const float *weight, size_t panel, float *panels)
{
  for (size_t o = 0; o < MO_HIDDEN; o++)
    for (size_t k = 0; k < MO_HIDDEN; k++)
      panels[((k / panel) * MO_HIDDEN + o) * panel + k % panel] = weight[o * MO_HIDDEN + k];
}

/* + 0: a bias of −0 becomes 0, so that leaving out products of 0 cannot be seen (kernel_tiles.inc).
 */
static void pack_plain(const float *values, size_t n, float *to)
{
  for (size_t i = 0; i < n; i++)
    to[i] = values[i] + 0.0f;
}

static void fill(struct mo_gradient_pack *pack, const struct mo_controller *controller)
{
  const size_t n_inputs = controller->n_inputs, n_masses = controller->n_masses,
               panel = pack->panel;
  pack_panels(controller->weight[0], n_inputs, n_masses, panel, pack->input_weight);
  for (size_t i = 0; i < MO_CPG_INPUTS; i++)
    for (size_t o = 0; o < MO_HIDDEN; o++)
      pack->cpg_weight[i * MO_HIDDEN + o] = controller->weight[0][o * n_inputs + n_masses + i];
  for (int l = 0; l < MO_HIDDEN_LAYERS - 1; l++) {
    pack_panels(controller->weight[l + 1], MO_HIDDEN, MO_HIDDEN, panel, pack->forward_weight[l]);
    pack_transposed(controller->weight[l + 1], panel, pack->backward_weight[l]);
  }
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    pack_plain(controller->bias[l], MO_HIDDEN, pack->bias[l]);
    pack_plain(controller->norm_gain[l], MO_HIDDEN, pack->gain[l]);
    pack_plain(controller->norm_shift[l], MO_HIDDEN, pack->shift[l]);
  }
  memcpy(pack->output_weight, controller->weight[MO_HIDDEN_LAYERS],
         (size_t)controller->n_springs * MO_HIDDEN * sizeof(float));
  pack_plain(controller->bias[MO_HIDDEN_LAYERS], controller->n_springs, pack->output_bias);
}

int mo_gradient_pack_create(const struct mo_controller *controller, enum mo_isa isa,
                            struct mo_gradient_pack **ret)
{
  if ((unsigned)isa >= MO_ISA_COUNT || isa > mo_isa_best())
    return MO_ERR_UNSUPPORTED;
  struct mo_gradient_pack pack = {.isa = isa,
                                  .workspace = controller->workspace,
                                  .sensor = controller->sensor,
                                  .n_masses = controller->n_masses,
                                  .n_springs = controller->n_springs,
                                  .n_inputs = controller->n_inputs,
                                  .n_parameters = controller->n_parameters,
                                  .panel = 2 * mo_isa_vector_bytes(isa) / (uint32_t)sizeof(float)};
  const size_t head = mo_aligned(sizeof(pack));
  pack.bytes = head + lay_out(&pack, NULL);
  struct mo_gradient_pack *made = aligned_alloc(MO_ALIGNMENT, pack.bytes);
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  lay_out(&pack, (char *)made + head);
  fill(&pack, controller);
  *made = pack;
  *ret = made;
  return MO_OK;
}

int mo_gradient_pack_update(struct mo_gradient_pack *pack, const struct mo_controller *controller)
{
  if (!mo_workspace_equal(pack->workspace, controller->workspace) ||
      pack->sensor != controller->sensor)
    return MO_ERR_UNSUPPORTED;
  fill(pack, controller);
  return MO_OK;
}

void mo_gradient_pack_free(struct mo_gradient_pack *pack)
{
  free(pack);
}

size_t mo_gradient_pack_bytes(const struct mo_gradient_pack *pack)
{
  return pack->bytes;
}

/* ---- scratch ---- */

int mo_gradient_memory_create(size_t budget_bytes, struct mo_gradient_memory **memory)
{
  struct mo_gradient_memory *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->budget_bytes = budget_bytes;
  *memory = made;
  return MO_OK;
}

static void release(struct mo_gradient_buffer *buffer)
{
  if (buffer->mapped)
    munmap(buffer->base, buffer->size);
  else
    free(buffer->base);
  *buffer = (struct mo_gradient_buffer){0};
}

/* Reserves huge pages, because a tape is long. When the buffer grows, its pages move along and need
 * not be cleared again. */
static int reserve_pages(struct mo_gradient_buffer *buffer, size_t bytes)
{
  const size_t size = (bytes + HUGE_PAGE - 1) / HUGE_PAGE * HUGE_PAGE;
  void *base;
  if (buffer->mapped) {
    base = mremap(buffer->base, buffer->size, size, MREMAP_MAYMOVE);
  } else {
    release(buffer);
    base = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  }
  if (base == MAP_FAILED)
    return MO_ERR_NO_MEMORY;
  (void)madvise(base, size, MADV_HUGEPAGE); /* only a hint */
  *buffer = (struct mo_gradient_buffer){base, size, true};
  return MO_OK;
}

int mo_gradient_reserve(struct mo_gradient_buffer *buffer, size_t bytes)
{
  if (bytes <= buffer->size)
    return MO_OK;
  if (bytes > SIZE_MAX / 2)
    return MO_ERR_NO_MEMORY;
  if (bytes >= HUGE_PAGE)
    return reserve_pages(buffer, bytes);
  release(buffer);
  const size_t size = mo_aligned(bytes);
  char *base = aligned_alloc(MO_ALIGNMENT, size);
  if (base == NULL)
    return MO_ERR_NO_MEMORY;
  *buffer = (struct mo_gradient_buffer){base, size, false};
  return MO_OK;
}

void mo_gradient_memory_free(struct mo_gradient_memory *memory)
{
  if (memory == NULL)
    return;
  release(&memory->block);
  release(&memory->tiling);
  release(&memory->work);
  free(memory);
}

size_t mo_gradient_memory_bytes(const struct mo_gradient_memory *memory)
{
  return sizeof(*memory) + memory->block.size + memory->tiling.size + memory->work.size;
}

/* ---- blocks ---- */

mo_gradient_function *mo_gradient_find(enum mo_isa isa)
{
  static mo_gradient_function *const functions[MO_ISA_COUNT] = {
      mo_gradient_baseline, mo_gradient_avx2, mo_gradient_avx512};
  return functions[isa];
}

int mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_gradient_pack *pack,
                      const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                      const struct mo_gradient_options *options, const struct mo_pause_point *pause,
                      struct mo_outcome *outcomes, float *d_parameters,
                      struct mo_gradient_counts *counts)
{
  if (n < 1 || n > MO_GRADIENT_ROBOTS || mo_gradient_options_check(options) != MO_OK)
    return MO_ERR_INVALID;
  for (uint32_t i = 0; i < n; i++)
    if (!mo_workspace_equal(robots[i].body->workspace, pack->workspace))
      return MO_ERR_INVALID;
  struct mo_gradient_counts block = {0};
  struct mo_gradient_run run = {.memory = memory,
                                .pack = pack,
                                .robots = robots,
                                .n = n,
                                .physics = physics,
                                .options = options,
                                .pause = pause,
                                .outcomes = outcomes,
                                .d_parameters = d_parameters,
                                .counts = &block};
  const int status = mo_gradient_find(pack->isa)(&run);
  if (status == MO_OK && counts != NULL)
    mo_gradient_counts_add(counts, &block);
  return status;
}

/* ---- arrangement ---- */

struct place {
  uint32_t n_springs, robot;
};

/* Sorts robots with more springs first. */
static int by_size(const void *a, const void *b)
{
  const struct place *x = a, *y = b;
  if (x->n_springs != y->n_springs)
    return x->n_springs > y->n_springs ? -1 : 1;
  return x->robot < y->robot ? -1 : 1;
}

/* Groups bodies of similar size: small ones share the few springs that all of them have, instead of
 * adding their own springs to the blocks of large ones. Measured on 256 random bodies: 108 tiles
 * per block instead of 172. Searching for the pairs that overlap most gains almost nothing more.
 * The largest come first, so that no worker is left with one at the end. */
int mo_gradient_arrange(const struct mo_robot *robots, size_t n, uint32_t *order)
{
  struct place *places = malloc((n > 0 ? n : 1) * sizeof(*places));
  if (places == NULL)
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < n; i++)
    places[i] = (struct place){robots[i].body->n_springs, (uint32_t)i};
  qsort(places, n, sizeof(*places), by_size);
  for (size_t i = 0; i < n; i++)
    order[i] = places[i].robot;
  free(places);
  return MO_OK;
}
