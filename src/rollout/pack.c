/* pack.c: lays out a controller for one instruction set and precision.
 *
 * Hidden layers become panels for the kernels' products. The first and the last layer stay float32,
 * in an order that lets a block quickly pack the columns and rows of its bodies, which are the only
 * ones that are multiplied. */
#include "rollout/carve.h"
#include "rollout/fast.h"

#include <stdlib.h>
#include <string.h>

static void lay_out(struct mo_pack *pack, bool for_gradients, struct carver *carver)
{
  const size_t square = (size_t)MO_HIDDEN * MO_HIDDEN;
  pack->input_weight = carve(carver, (size_t)pack->n_masses * MO_HIDDEN, sizeof(float));
  pack->output_weight = carve(carver, (size_t)pack->n_springs * MO_HIDDEN, sizeof(float));
  pack->output_bias = carve(carver, pack->n_springs, sizeof(float));
  pack->cpg_weight = carve(carver, (size_t)MO_CPG_INPUTS * MO_HIDDEN, pack->real_bytes);
  for (int l = 0; l < MO_HIDDEN_LAYERS - 1; l++) {
    pack->hidden_weight[l] = carve(carver, square, pack->real_bytes);
    if (for_gradients)
      pack->backward_weight[l] = carve(carver, square, sizeof(float));
  }
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    pack->bias[l] = carve(carver, MO_HIDDEN, pack->real_bytes);
    pack->gain[l] = carve(carver, MO_HIDDEN, pack->real_bytes);
    pack->shift[l] = carve(carver, MO_HIDDEN, pack->real_bytes);
  }
}

/* Stores a number + 0: a bias of −0 becomes 0, so that omitting products with 0 changes no bit
 (kernel_tiles.inc).
 */
static void put(const struct mo_pack *pack, void *array, size_t i, float value)
{
  if (pack->precision == MO_FLOAT64)
    ((double *)array)[i] = (double)value + 0.0;
  else
    ((float *)array)[i] = value + 0.0f;
}

/* Returns the index of the weight from input k to output o in the panels of a matrix with n
 * inputs. */
static size_t place(const struct mo_pack *pack, size_t n, size_t o, size_t k)
{
  return ((o / pack->panel) * n + k) * pack->panel + o % pack->panel;
}

static void fill_layer(struct mo_pack *pack, const struct mo_controller *controller, int l)
{
  for (size_t o = 0; o < MO_HIDDEN; o++) {
    put(pack, pack->bias[l], o, controller->bias[l][o]);
    put(pack, pack->gain[l], o, controller->norm_gain[l][o]);
    put(pack, pack->shift[l], o, controller->norm_shift[l][o]);
    const float *row = controller->weight[l] + o * MO_HIDDEN;
    for (size_t k = 0; l > 0 && k < MO_HIDDEN; k++) {
      put(pack, pack->hidden_weight[l - 1], place(pack, MO_HIDDEN, o, k), row[k]);
      if (pack->backward_weight[l - 1] != NULL)
        pack->backward_weight[l - 1][place(pack, MO_HIDDEN, k, o)] = row[k];
    }
  }
}

static void fill(struct mo_pack *pack, const struct mo_controller *controller)
{
  const size_t n_inputs = controller->n_inputs, n_masses = controller->n_masses,
               n_springs = controller->n_springs;
  for (size_t o = 0; o < MO_HIDDEN; o++) {
    const float *row = controller->weight[0] + o * n_inputs;
    for (size_t m = 0; m < n_masses; m++)
      pack->input_weight[place(pack, n_masses, o, m)] = row[m];
    for (size_t i = 0; i < MO_CPG_INPUTS; i++)
      put(pack, pack->cpg_weight, i * MO_HIDDEN + o, row[n_masses + i]);
  }
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    fill_layer(pack, controller, l);
  memcpy(pack->output_weight, controller->weight[MO_HIDDEN_LAYERS],
         n_springs * MO_HIDDEN * sizeof(float));
  for (size_t s = 0; s < n_springs; s++)
    pack->output_bias[s] = controller->bias[MO_HIDDEN_LAYERS][s] + 0.0f; /* as in put */
}

static int create(const struct mo_controller *controller, enum mo_isa isa,
                  enum mo_precision precision, bool for_gradients, struct mo_pack **ret)
{
  if ((unsigned)isa >= MO_ISA_COUNT || (precision != MO_FLOAT32 && precision != MO_FLOAT64))
    return MO_ERR_INVALID;
  if (isa > mo_isa_best())
    return MO_ERR_UNSUPPORTED;
  const size_t real_bytes = precision == MO_FLOAT64 ? sizeof(double) : sizeof(float);
  struct mo_pack pack = {.isa = isa,
                         .precision = precision,
                         .passive = controller == NULL,
                         .panel = (uint32_t)(2 * mo_isa_vector_bytes(isa) / real_bytes),
                         .real_bytes = real_bytes};
  struct carver carver = {NULL, mo_aligned(sizeof(pack))};
  if (controller != NULL) {
    pack.workspace = controller->workspace;
    pack.sensor = controller->sensor;
    pack.n_masses = controller->n_masses;
    pack.n_springs = controller->n_springs;
    pack.n_inputs = controller->n_inputs;
    pack.n_parameters = controller->n_parameters;
    lay_out(&pack, for_gradients, &carver);
  }
  struct mo_pack *made = aligned_alloc(MO_ALIGNMENT, carver.used);
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  if (controller != NULL) {
    carver = (struct carver){(char *)made, mo_aligned(sizeof(pack))};
    lay_out(&pack, for_gradients, &carver);
    fill(&pack, controller);
  }
  *made = pack;
  *ret = made;
  return MO_OK;
}

int mo_pack_create(const struct mo_controller *controller, enum mo_isa isa,
                   enum mo_precision precision, struct mo_pack **pack)
{
  return create(controller, isa, precision, false, pack);
}

int mo_pack_create_for_gradients(const struct mo_controller *controller, enum mo_isa isa,
                                 struct mo_pack **pack)
{
  return create(controller, isa, MO_FLOAT32, true, pack);
}

int mo_pack_update(struct mo_pack *pack, const struct mo_controller *controller)
{
  if (!mo_workspace_equal(pack->workspace, controller->workspace) ||
      pack->sensor != controller->sensor)
    return MO_ERR_UNSUPPORTED;
  fill(pack, controller);
  return MO_OK;
}

void mo_pack_free(struct mo_pack *pack)
{
  free(pack);
}
