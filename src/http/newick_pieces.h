/* newick_pieces.h: the Newick text of a phylogeny, piece by piece.
 *
 * mo_newick pushes, a long reply pulls: a thread runs the one and sleeps while a piece waits for
 * the other, so that a slow reader holds one piece and a thread, but no processor. */
#ifndef MORPHO_HTTP_NEWICK_PIECES_H
#define MORPHO_HTTP_NEWICK_PIECES_H

#include <morpho/evolution.h>

#include "http/text.h"

struct mo_newick_pieces;

/* Takes over both arrays (malloc, (n)), also on error. MO_ERR_NO_MEMORY. */
int mo_newick_pieces_start(struct mo_descent *descents, uint32_t *born, uint32_t n,
                           struct mo_newick_pieces **pieces);
/* A mo_download_more. */
int mo_newick_pieces_more(void *pieces, struct mo_text *text);
void mo_newick_pieces_free(void *pieces);    /* also before the end */
uint64_t mo_newick_pieces_bytes(uint32_t n); /* what they hold, roughly */

#endif
