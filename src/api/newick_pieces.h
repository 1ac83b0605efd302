/* newick_pieces.h: the Newick text of a phylogeny, piece by piece.
 *
 * mo_newick pushes its output, a long reply pulls. So mo_newick runs on a thread of its own, which
 * sleeps while a piece waits to be read. A slow reader holds one piece and one sleeping thread. */
#ifndef MORPHO_API_NEWICK_PIECES_H
#define MORPHO_API_NEWICK_PIECES_H

#include <morpho/evolution.h>

#include "base/text.h"

struct mo_newick_pieces;

/* Starts the thread. Takes over both arrays (malloc, (n)), also on error. MO_ERR_NO_MEMORY. */
int mo_newick_pieces_start(struct mo_descent *descents, uint32_t *born, uint32_t n,
                           struct mo_newick_pieces **pieces);
/* A mo_download_more. */
int mo_newick_pieces_more(void *pieces, struct mo_text *text);
void mo_newick_pieces_free(void *pieces);    /* also before the end */
uint64_t mo_newick_pieces_bytes(uint32_t n); /* memory that they take, roughly */

#endif
