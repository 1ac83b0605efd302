/* scores.c: blocks of scores. The input is the content of an archive (members.h); a second pass
 * reads it as the bytes of a file. What is accepted must be consistent. */
#include "members.h"
#include "target.h"

#include <math.h>
#include <stdlib.h>

#include "exchange/score_block.h"

static void check_block(const struct mo_score_block *block)
{
  for (uint32_t i = 0; i < block->n_scores; i++) {
    const struct mo_campaign_score *score = &block->scores[i];
    FUZZ_PROMISE(block->condition_of[i] < block->n_conditions);
    FUZZ_PROMISE(score->number < block->n_designs && score->n >= 1 && score->n <= MO_BLOCK_LANES);
    for (uint32_t k = 0; k < score->n; k++)
      FUZZ_PROMISE(score->environments[k] < block->n_environments && score->losses[k] >= 0 &&
                   isfinite(score->losses[k]) == (score->diverged_steps[k] == 0));
  }
  for (uint32_t i = 0; i < block->n_conditions; i++)
    FUZZ_PROMISE(mo_physics_check(&block->conditions[i].physics, NULL) == MO_OK);
  for (uint32_t i = 0; i < block->n_designs; i++)
    FUZZ_PROMISE(
        mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, block->designs[i].genotype.words) == 1);
  FUZZ_PROMISE((block->weights == NULL) == (block->controller == NULL));
}

static void read_block(const char *bytes, size_t size, struct mo_score_block *block)
{
  struct mo_message message = {""};
  const int error = mo_score_block_read(bytes, size, block, &message);
  FUZZ_PROMISE(error == MO_OK || error == MO_ERR_NO_MEMORY ||
               (error == MO_ERR_FORMAT && message.text[0] != '\0'));
  if (error == MO_OK)
    check_block(block);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  struct mo_score_block *block = mo_score_block_create();
  struct mo_text archive = {0};
  struct mo_message message = {""};
  size_t length = 0;
  FUZZ_PROMISE(block != NULL);
  if (mo_score_block_head((const char *)data, size, &length, &message) == MO_OK) {
    FUZZ_PROMISE(MO_SCORES_HEAD + length <= size);
    read_block((const char *)data + MO_SCORES_HEAD, length, block);
  }
  pack(data, size, &archive);
  read_block(archive.data, archive.size, block);
  mo_text_free(&archive);
  mo_score_block_free(block);
  return 0;
}
