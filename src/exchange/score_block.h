/* score_block.h: files of scores, as described in docs/fleet.md: blocks, each with a head of 12
 * bytes and an archive. */
#ifndef MORPHO_EXCHANGE_SCORE_BLOCK_H
#define MORPHO_EXCHANGE_SCORE_BLOCK_H

#include "exchange/archive.h"
#include "store/score_blocks.h"

#define MO_SCORES_VERSION   1
#define MO_SCORES_HEAD      12
#define MO_SCORES_BLOCK_MAX ((size_t)96 << 20) /* bytes of an archive */

/* Appends a block to `out`. */
int mo_score_block_write(const struct mo_score_block *block, const char *program,
                         struct mo_text *out);
/* Reads the head at the beginning of the bytes. *size: the size of the archive after it, which is
 * complete. MO_ERR_FORMAT: the message says what is wrong. */
int mo_score_block_head(const char *bytes, size_t n, size_t *size, struct mo_message *message);
/* Reads an archive and checks all of it. `block` is cleared first. MO_ERR_FORMAT. */
int mo_score_block_read(const char *bytes, size_t size, struct mo_score_block *block,
                        struct mo_message *message);

#endif
