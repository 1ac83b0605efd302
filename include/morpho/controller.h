/* controller.h: the universal controller (paper, section 2.3): weights and files.
 *
 * MLP  (n_masses + 5) → 256 → 256 → 256 → n_springs
 * LayerNorm (ε 1e-5) and ReLU follow each hidden layer, tanh the last one. Inputs: one sensor
 * per lattice mass (0 where the mass is absent), then sin(10 t dt + 2πk/5), k = 0 … 4.
 * Parameters are float32, in one buffer in file order. Matrices are row-major (out, in), as
 * PyTorch writes them: net.0.weight .bias, net.1.weight .bias (LayerNorm), net.3.*, net.4.*,
 * net.6.*, net.7.*, net.9.* */
#ifndef MORPHO_CONTROLLER_H
#define MORPHO_CONTROLLER_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>
#include <morpho/morphospace.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_CPG_INPUTS           5
#define MO_CPG_RAD_PER_S        10.0
#define MO_HIDDEN               256
#define MO_HIDDEN_LAYERS        3
#define MO_LAYERNORM_EPSILON    1e-5
#define MO_CONTROLLER_TENSORS   14
#define MO_CONTROL_PERIOD_MAX_S 10.0
#define MO_CONTROLLER_FILE_MAX                                                                     \
  (UINT64_C(4) << 30) /* bytes of a file that mo_controller_read accepts */
#define MO_SAFETENSORS_HEADER_MAX (UINT32_C(1) << 20)
/* Largest |value| of a parameter that a file may hold. Within this limit no sum in the network
 * exceeds float32's range, for any sensor value (at most 1e4): the largest sum, LayerNorm's sum of
 * squares, stays under 1e34. */
#define MO_WEIGHT_LIMIT 1e6f

enum mo_sensor {
  MO_SENSOR_INVERSE_SQRT =
      0, /* 1/(sqrt(d + 1e-8) + 1e-8): the authors' published code, the default */
  MO_SENSOR_INVERSE_SQUARE = 1 /* 1/(d² + 1e-4): the paper's text */
};
extern const char *const mo_sensor_words[]; /* "inverse_sqrt", "inverse_square", NULL */
const char *mo_sensor_name(enum mo_sensor sensor);

struct mo_metadata_entry {
  char *key, *value;
};

/* Const while rollouts run. Create, read and free it only through the functions below. */
struct mo_controller {
  struct mo_workspace workspace;
  enum mo_sensor sensor;
  double control_period_s;      /* the period at which it was trained to compute its outputs; 0:
                                   every step */
  uint32_t n_masses, n_springs; /* of the workspace's lattice */
  uint32_t n_inputs;            /* n_masses + MO_CPG_INPUTS */
  size_t n_parameters;
  float *parameters; /* (n_parameters), 64-byte aligned; the views below point into it */
  float
      *weight[MO_HIDDEN_LAYERS + 1]; /* (256, n_inputs), (256, 256), (256, 256), (n_springs, 256) */
  float *bias[MO_HIDDEN_LAYERS + 1]; /* (256) × 3, (n_springs) */
  float *norm_gain[MO_HIDDEN_LAYERS];  /* (256) LayerNorm weight */
  float *norm_shift[MO_HIDDEN_LAYERS]; /* (256) LayerNorm bias */
  struct mo_metadata_entry *metadata;  /* the file's __metadata__, in its order; includes "sensor",
                                          the orders and, unless it is 0, "control_period_s" */
  size_t n_metadata;
};

/* Creates a controller with zero weights, LayerNorm gain 1, and metadata that state the orders, the
 * sensor and the workspace. */
int mo_controller_create(struct mo_workspace workspace, enum mo_sensor sensor,
                         struct mo_controller **controller);
void mo_controller_free(struct mo_controller *controller); /* NULL-safe */

/* Sets the control period and its metadata entry. MO_ERR_RANGE: not above 0 and at most
 * MO_CONTROL_PERIOD_MAX_S; MO_ERR_NO_MEMORY, MO_ERR_LIMIT. */
int mo_controller_set_period(struct mo_controller *controller, double period_s);

/* Sets Xavier-uniform weights, zero biases, LayerNorm gain 1 and shift 0; layer l draws from stream
 * (seed, WEIGHTS, l, 0). */
void mo_controller_randomize(struct mo_controller *controller, uint64_t seed);

/* Sets or replaces a metadata entry. MO_ERR_INVALID (not UTF-8), MO_ERR_CONFLICT ("sensor",
 * "control_period_s", "workspace" and the orders describe the weights and cannot be changed),
 * MO_ERR_NO_MEMORY, MO_ERR_LIMIT (1024 entries, 64 KiB each). */
int mo_controller_set_metadata(struct mo_controller *controller, const char *key,
                               const char *value);
const char *mo_controller_get_metadata(const struct mo_controller *controller,
                                       const char *key); /* NULL if absent */
/* Reads an integer ≥ 0 that is a member of an entry whose value is a JSON object. MO_ERR_NOT_FOUND:
 * no such entry; MO_ERR_FORMAT: the entry is not an object, or has no such number;
 * MO_ERR_NO_MEMORY. */
int mo_controller_get_metadata_number(const struct mo_controller *controller, const char *key,
                                      const char *member, uint64_t *number);

/* Reads a safetensors file (path) or its bytes, and checks all of it: header length and JSON,
 * exactly the expected tensors, dtype F32, shapes that agree with one workspace (metadata
 * "workspace" = "6x6x4" names it; if absent, the default is assumed), offsets that tile the data
 * without gap or overlap, finite values within MO_WEIGHT_LIMIT, a known "sensor" (default
 * inverse_sqrt), a "control_period_s" within its bounds, and known orders if stated. MO_ERR_FORMAT,
 * MO_ERR_LIMIT, MO_ERR_IO, MO_ERR_NOT_FOUND, MO_ERR_NO_MEMORY. */
int mo_controller_read(const char *path, struct mo_controller **controller,
                       struct mo_message *message);
int mo_controller_decode(const uint8_t *bytes, size_t size, struct mo_controller **controller,
                         struct mo_message *message);

/* Encodes the file (malloc; the caller frees it). Equal controllers encode to equal bytes.
 * MO_ERR_NO_MEMORY; MO_ERR_LIMIT: the metadata exceeds MO_SAFETENSORS_HEADER_MAX. */
int mo_controller_encode(const struct mo_controller *controller, uint8_t **bytes, size_t *size);

#ifdef __cplusplus
}
#endif
#endif
