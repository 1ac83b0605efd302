/* exchange.c: the messages between the daemon and a worker, both ways.
 *
 * Byte 0: bit 0 chooses leases or results, bit 1 completes the header (magic, version, size), and
 * the other bits choose the workspace. The rest is the message. A refusal must be explained; an
 * accepted message must respect every bound, and must encode to the same bytes. */
#include "target.h"

#include "fleet/wire.h"

#include <math.h>
#include <string.h>

static const struct mo_workspace workspaces[] = {
    {6, 6, 4}, {1, 1, 1}, {5, 3, 2}, {16, 8, 8}, {41, 5, 5}};

static void check_refused(int code, const struct mo_message *message)
{
  FUZZ_PROMISE(memchr(message->text, '\0', sizeof(message->text)) != NULL);
  FUZZ_PROMISE(code == MO_ERR_NO_MEMORY || message->text[0] != '\0');
  FUZZ_PROMISE(code == MO_ERR_FORMAT || code == MO_ERR_UNSUPPORTED || code == MO_ERR_LIMIT ||
               code == MO_ERR_NO_MEMORY);
}

static void check_same(const uint8_t *data, size_t size, int code, uint8_t *again,
                       size_t again_size)
{
  if (code == MO_OK)
    FUZZ_PROMISE(size == again_size && memcmp(data, again, size) == 0);
  else
    FUZZ_PROMISE(code == MO_ERR_NO_MEMORY);
  free(again);
}

static void read_leases(const uint8_t *data, size_t size, struct mo_workspace workspace)
{
  struct mo_wire_leases leases;
  struct mo_message message = {""};
  uint8_t *again = NULL;
  size_t again_size = 0;
  int code = mo_wire_get_leases(data, size, workspace, &leases, &message);
  if (code != MO_OK) {
    FUZZ_PROMISE(leases.n == 0);
    check_refused(code, &message);
    return;
  }
  FUZZ_PROMISE(leases.n <= MO_WIRE_LEASES_MAX);
  for (uint32_t i = 0; i < leases.n; i++) {
    const struct mo_wire_lease *lease = &leases.items[i];
    uint32_t rows = 0;
    FUZZ_PROMISE(lease->n_rows >= lease->n_blocks && lease->n_rows <= MO_WIRE_ROWS_MAX);
    FUZZ_PROMISE(mo_physics_check(&lease->physics, NULL) == MO_OK);
    FUZZ_PROMISE(lease->n_parameters <= MO_WIRE_PARAMETERS_MAX);
    FUZZ_PROMISE(lease->n_parameters == 0 || mo_gradient_options_check(&lease->gradient) == MO_OK);
    for (uint32_t e = 0; e < lease->n_environments; e++)
      FUZZ_PROMISE(mo_environment_check(&lease->environments[e], NULL) == MO_OK);
    for (uint32_t b = 0; b < lease->n_blocks; b++) {
      const struct mo_wire_block *block = &lease->blocks[b];
      FUZZ_PROMISE(lease->n_parameters == 0 || block->n_environments == 1);
      FUZZ_PROMISE(mo_genotype_is_contiguous(workspace, block->genotype) == 1);
      FUZZ_PROMISE(block->n_environments >= 1 && block->n_environments <= MO_BLOCK_LANES);
      for (uint32_t k = 0; k < block->n_environments; k++)
        FUZZ_PROMISE(block->environments[k] < lease->n_environments);
      rows += block->n_environments;
    }
    FUZZ_PROMISE(rows == lease->n_rows);
  }
  code = mo_wire_put_leases(&leases, workspace, &again, &again_size);
  check_same(data, size, code, again, again_size);
  mo_wire_free_leases(&leases);
}

static void read_results(const uint8_t *data, size_t size)
{
  struct mo_wire_results results;
  struct mo_message message = {""};
  uint8_t *again = NULL;
  size_t again_size = 0;
  int code = mo_wire_get_results(data, size, &results, &message);
  if (code != MO_OK) {
    FUZZ_PROMISE(results.n == 0);
    check_refused(code, &message);
    return;
  }
  FUZZ_PROMISE(results.n <= MO_WIRE_RESULTS_MAX);
  for (uint32_t i = 0; i < results.n; i++) {
    const struct mo_wire_result *result = &results.items[i];
    FUZZ_PROMISE((result->state == MO_RESULT_DONE) == (result->n_rows > 0));
    FUZZ_PROMISE(result->n_rows <= MO_WIRE_ROWS_MAX);
    FUZZ_PROMISE(result->n_parameters <= MO_WIRE_PARAMETERS_MAX);
    for (uint32_t k = 0; k < result->n_parameters; k++)
      FUZZ_PROMISE(isfinite(result->d_parameters[k]));
    FUZZ_PROMISE(result->busy_s >= 0 && result->wall_s >= 0);
    for (uint32_t row = 0; row < result->n_rows; row++)
      FUZZ_PROMISE(result->losses[row] >= 0 &&
                   isfinite(result->losses[row]) == (result->diverged_steps[row] == 0));
  }
  code = mo_wire_put_results(&results, &again, &again_size);
  check_same(data, size, code, again, again_size);
  mo_wire_free_results(&results);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  if (size == 0)
    return 0;
  const bool is_leases = data[0] % 2 == 0;
  const struct mo_workspace workspace =
      workspaces[(data[0] >> 2) % (sizeof(workspaces) / sizeof(workspaces[0]))];
  const uint64_t bytes = size - 1;
  uint8_t *exact = malloc(size);
  if (exact == NULL)
    return 0;
  memcpy(exact, data + 1, bytes);
  if (data[0] & 2 && bytes >= 24) {
    const uint32_t version = MO_WIRE_VERSION;
    memcpy(exact, is_leases ? "MOFLEETL" : "MOFLEETR", 8);
    memcpy(exact + 8, &version, sizeof(version));
    memcpy(exact + 16, &bytes, sizeof(bytes));
  }
  if (is_leases)
    read_leases(exact, bytes, workspace);
  else
    read_results(exact, bytes);
  free(exact);
  return 0;
}
