/* pack.c: lays out a controller for one instruction set and precision.
 *
 * Hidden layers become panels for the kernels' products. The first and the last layer stay float32,
 * in an order from which a block quickly packs its body's own columns and rows: only those are
 * multiplied. */
#include "rollout/carve.h"
#include "rollout/fast.h"

#include <stdlib.h>
#include <string.h>

static void lay_out(struct mo_pack *pack, struct carver *carver)
{
  pack->input_weight = carve(carver, (size_t)pack->n_masses * MO_HIDDEN, sizeof(float));
  pack->output_weight = carve(carver, (size_t)pack->n_springs * MO_HIDDEN, sizeof(float));
  pack->output_bias = carve(carver, pack->n_springs, sizeof(float));
  pack->cpg_weight = carve(carver, (size_t)MO_CPG_INPUTS * MO_HIDDEN, pack->real_bytes);
  for (int l = 0; l < MO_HIDDEN_LAYERS - 1; l++)
    pack->hidden_weight[l] = carve(carver, (size_t)MO_HIDDEN * MO_HIDDEN, pack->real_bytes);
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    pack->bias[l] = carve(carver, MO_HIDDEN, pack->real_bytes);
    pack->gain[l] = carve(carver, MO_HIDDEN, pack->real_bytes);
    pack->shift[l] = carve(carver, MO_HIDDEN, pack->real_bytes);
  }
}

static void put(const struct mo_pack *pack, void *array, size_t i, float value)
{
  /* + 0: a bias of −0 becomes 0, so that leaving out products of 0 changes no bit
   * (kernel_network.inc). */
  if (pack->precision == MO_FLOAT64)
    ((double *)array)[i] = (double)value + 0.0;
  else
    ((float *)array)[i] = value + 0.0f;
}

static void fill(struct mo_pack *pack, const struct mo_controller *controller)
{
  const uint32_t n_inputs = controller->n_inputs, n_masses = controller->n_masses;
  for (uint32_t o = 0; o < MO_HIDDEN; o++) {
    const float *row = controller->weight[0] + (size_t)o * n_inputs;
    for (uint32_t m = 0; m < n_masses; m++)
      pack->input_weight[(size_t)m * MO_HIDDEN + o] = row[m];
    for (uint32_t i = 0; i < MO_CPG_INPUTS; i++)
      put(pack, pack->cpg_weight, (size_t)i * MO_HIDDEN + o, row[n_masses + i]);
  }
  for (int l = 0; l < MO_HIDDEN_LAYERS - 1; l++)
    for (uint32_t o = 0; o < MO_HIDDEN; o++)
      for (uint32_t k = 0; k < MO_HIDDEN; k++) {
        const size_t panel = o / pack->panel, column = o % pack->panel;
        put(pack, pack->hidden_weight[l], (panel * MO_HIDDEN + k) * pack->panel + column,
            controller->weight[l + 1][(size_t)o * MO_HIDDEN + k]);
      }
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    for (uint32_t o = 0; o < MO_HIDDEN; o++) {
      put(pack, pack->bias[l], o, controller->bias[l][o]);
      put(pack, pack->gain[l], o, controller->norm_gain[l][o]);
      put(pack, pack->shift[l], o, controller->norm_shift[l][o]);
    }
  memcpy(pack->output_weight, controller->weight[MO_HIDDEN_LAYERS],
         (size_t)controller->n_springs * MO_HIDDEN * sizeof(float));
  memcpy(pack->output_bias, controller->bias[MO_HIDDEN_LAYERS],
         controller->n_springs * sizeof(float));
}

int mo_pack_create(const struct mo_controller *controller, enum mo_isa isa,
                   enum mo_precision precision, struct mo_pack **ret)
{
  if ((unsigned)isa >= MO_ISA_COUNT || (precision != MO_FLOAT32 && precision != MO_FLOAT64))
    return MO_ERR_INVALID;
  if (isa > mo_isa_best())
    return MO_ERR_UNSUPPORTED;
  const size_t real_bytes = precision == MO_FLOAT64 ? sizeof(double) : sizeof(float);
  struct mo_pack pack = {.isa = isa,
                         .precision = precision,
                         .passive = controller == NULL,
                         .vector = (uint32_t)(mo_isa_vector_bytes(isa) / real_bytes),
                         .real_bytes = real_bytes};
  pack.panel = 2 * pack.vector;
  struct carver carver = {NULL, mo_aligned(sizeof(pack))};
  if (controller != NULL) {
    pack.workspace = controller->workspace;
    pack.sensor = controller->sensor;
    pack.n_masses = controller->n_masses;
    pack.n_springs = controller->n_springs;
    lay_out(&pack, &carver);
  }
  pack.bytes = carver.used;
  struct mo_pack *made = aligned_alloc(MO_ALIGNMENT, carver.used);
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  if (controller != NULL) {
    carver = (struct carver){(char *)made, mo_aligned(sizeof(pack))};
    lay_out(&pack, &carver);
    fill(&pack, controller);
  }
  *made = pack;
  *ret = made;
  return MO_OK;
}

void mo_pack_free(struct mo_pack *pack)
{
  free(pack);
}
