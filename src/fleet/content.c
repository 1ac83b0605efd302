/* content.c: see content.h. Blocks of one job point to the same environments, so environments are
 * distinguished by their addresses. Comparing their contents, at least 528 bytes for each row,
 * would cost more than sending some environments twice. */
#include "fleet/content.h"

#include <stdlib.h>
#include <string.h>

/* Bodies and controllers belong to the service's workspace. */
#define GENOTYPE_BYTES (MO_DEFAULT_WORDS * sizeof(uint64_t))

/* Maps addresses of environments to their numbers, with open addressing. */
struct numbers {
  uint32_t mask;
  struct number {
    const struct mo_environment *environment; /* NULL: empty */
    uint16_t number;
  } * slots;
};

/* Returns the number of an environment, and adds it if it is new. MO_ERR_LIMIT: there are too
 * many. */
static int number_of(struct numbers *numbers, struct mo_wire_lease *content,
                     const struct mo_environment *environment)
{
  uint64_t hash = ((uint64_t)(uintptr_t)environment >> 4) * UINT64_C(0x9e3779b97f4a7c15);
  uint32_t at = (uint32_t)(hash >> 32) & numbers->mask;
  while (numbers->slots[at].environment != NULL && numbers->slots[at].environment != environment)
    at = (at + 1) & numbers->mask;
  if (numbers->slots[at].environment == NULL) {
    if (content->n_environments == MO_WIRE_ENVIRONMENTS_MAX)
      return MO_ERR_LIMIT;
    content->environments[content->n_environments] = *environment;
    mo_environments_hold(environment, 1);
    numbers->slots[at].environment = environment;
    numbers->slots[at].number = (uint16_t)content->n_environments++;
  }
  return numbers->slots[at].number;
}

static int copy_blocks(const struct mo_taken *taken, struct numbers *numbers,
                       struct mo_wire_lease *content)
{
  for (uint32_t b = 0; b < taken->n_blocks; b++) {
    const struct mo_block *from = taken->blocks[b];
    struct mo_wire_block *to = &content->blocks[b];
    *to = (struct mo_wire_block){.n_environments = from->n_environments};
    memcpy(to->genotype, from->genotype, GENOTYPE_BYTES);
    for (uint32_t k = 0; k < from->n_environments; k++) {
      int number = number_of(numbers, content, from->environments[k]);
      if (number < 0)
        return number;
      to->environments[k] = (uint16_t)number;
    }
  }
  return MO_OK;
}

/* Each robot of a shard is a block. */
static int copy_robots(const struct mo_gradient_batch *shard, struct numbers *numbers,
                       struct mo_wire_lease *content)
{
  content->n_parameters = (uint32_t)shard->controller->n_parameters;
  content->gradient = shard->options;
  for (uint32_t i = 0; i < shard->n; i++) {
    struct mo_wire_block *to = &content->blocks[i];
    int number = number_of(numbers, content, shard->robots[i].environment);
    if (number < 0)
      return number;
    *to = (struct mo_wire_block){.n_environments = 1, .environments = {(uint16_t)number}};
    memcpy(to->genotype, shard->robots[i].genotype, GENOTYPE_BYTES);
  }
  return MO_OK;
}

int mo_content_of(const struct mo_taken *taken, struct mo_wire_lease *content)
{
  const struct mo_gradient_batch *shard = taken->shard;
  const uint32_t rows = taken->n_rows;
  const uint32_t most = rows < MO_WIRE_ENVIRONMENTS_MAX ? rows : MO_WIRE_ENVIRONMENTS_MAX;
  struct numbers numbers = {.mask = 1};
  *content =
      (struct mo_wire_lease){.physics = shard != NULL ? shard->physics : taken->blocks[0]->physics,
                             .back_end = taken->back_end,
                             .has_measures = shard == NULL && taken->blocks[0]->measuring != NULL,
                             .n_blocks = shard != NULL ? rows : taken->n_blocks,
                             .n_rows = rows};
  if (rows > (content->has_measures ? MO_WIRE_MEASURED_MAX : MO_WIRE_ROWS_MAX))
    return MO_ERR_LIMIT;
  while (numbers.mask < 2 * most)
    numbers.mask = 2 * numbers.mask + 1;
  numbers.slots = calloc(numbers.mask + 1, sizeof(*numbers.slots));
  content->environments = malloc(most * sizeof(*content->environments));
  content->blocks = malloc(content->n_blocks * sizeof(*content->blocks));
  int error = MO_ERR_NO_MEMORY;
  if (numbers.slots != NULL && content->environments != NULL && content->blocks != NULL)
    error = shard != NULL ? copy_robots(shard, &numbers, content)
                          : copy_blocks(taken, &numbers, content);
  free(numbers.slots);
  if (error != MO_OK) {
    mo_wire_free_lease(content);
    return error;
  }
  struct mo_environment *fitted =
      realloc(content->environments, content->n_environments * sizeof(*fitted));
  if (fitted != NULL)
    content->environments = fitted;
  return MO_OK;
}

uint32_t mo_content_cut(struct mo_wire_lease *content, uint32_t first, uint32_t n)
{
  uint32_t row = 0;
  for (uint32_t b = 0; b < first; b++)
    row += content->blocks[b].n_environments;
  memmove(content->blocks, content->blocks + first, n * sizeof(*content->blocks));
  content->n_blocks = n;
  content->n_rows = 0;
  for (uint32_t b = 0; b < n; b++)
    content->n_rows += content->blocks[b].n_environments;
  return row;
}
