/* internal.h: shared by the files of this room: the position of each tensor in the parameter
 * buffer. */
#ifndef MORPHO_CONTROLLER_INTERNAL_H
#define MORPHO_CONTROLLER_INTERNAL_H

#include <morpho/controller.h>

/* The format stores little-endian float32, and parameters are copied between file and memory
 * unchanged. */
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "safetensors files are little-endian");
_Static_assert(sizeof(float) == 4, "safetensors F32");

#define MO_METADATA_MAX       1024
#define MO_METADATA_BYTES_MAX ((size_t)64 << 10)

/* One tensor of the file, in parameter order. */
struct mo_tensor {
  const char *name;
  uint32_t n_dims;   /* 1 or 2 */
  uint64_t shape[2]; /* shape[1] is 1 for vectors */
  uint64_t offset;   /* into the parameters, floats */
  uint64_t count;    /* floats */
};

/* Fills in the table of a workspace and returns the number of parameters. */
uint64_t mo_controller_tensors(struct mo_workspace workspace,
                               struct mo_tensor tensors[MO_CONTROLLER_TENSORS]);

/* Each writes the value of a metadata entry, 64 bytes at most. */
void mo_controller_mass_order(struct mo_workspace workspace, char text[64]);
void mo_controller_workspace_text(struct mo_workspace workspace, char text[64]);
#define MO_SPRING_ORDER "lexicographic endpoint pairs"

/* Creates a controller with views and uninitialized parameters, without metadata. MO_ERR_NO_MEMORY,
 * and errors as in mo_workspace_check. */
int mo_controller_allocate(struct mo_workspace workspace, enum mo_sensor sensor,
                           struct mo_controller **controller);
/* Same as mo_controller_set_metadata, without the check of entries that describe the controller
 * itself. */
int mo_controller_put_metadata(struct mo_controller *controller, const char *key,
                               const char *value);
/* Adds the entries that every file has, if they are missing: both orders and the sensor. */
int mo_controller_complete_metadata(struct mo_controller *controller);

/* safetensors.c: a checked header. offsets[i]: byte of the file where tensor i of the table
 * starts. */
struct mo_safetensors {
  struct mo_controller *controller; /* allocated, metadata set, parameters not read yet */
  struct mo_tensor tensors[MO_CONTROLLER_TENSORS];
  uint64_t offsets[MO_CONTROLLER_TENSORS];
};
/* Reads the length of the JSON header from the first 8 bytes of a file of `size` bytes. */
int mo_safetensors_header_size(const uint8_t *prefix, uint64_t size, uint32_t *header_size,
                               struct mo_message *message);
/* Checks the header (without the 8 bytes) of a file of `size` bytes and allocates the controller
 * that it describes. */
int mo_safetensors_parse(const char *header, uint32_t header_size, uint64_t size,
                         struct mo_safetensors *file, struct mo_message *message);
/* MO_ERR_FORMAT at the first value that is not finite. */
int mo_safetensors_check_values(const struct mo_safetensors *file, struct mo_message *message);

#endif
