/* morphospace.h: voxel genotypes, their identity, and the mass-spring bodies they express (paper,
 * section 2.1).
 *
 * Orders, the same in every array, file and weight matrix, for a workspace of nx × ny × nz voxels:
 *   voxel  (x·ny + y)·nz + z
 *   mass   (x·(ny+1) + y)·(nz+1) + z in lattice coordinates
 *   spring rank of its endpoints (a, b), a < b, in lexicographic order over the whole lattice
 * Springs: the 12 edges and 12 face diagonals of each voxel, shared with its neighbors.
 *
 * A genotype is a bit array of mo_workspace_words() 64-bit words owned by the caller; voxel v is
 * bit v & 63 of word v >> 6; bits past the last voxel are 0. "Valid" below means: not empty and
 * contiguous through voxel faces. Functions take the workspace and the words: those of one struct
 * mo_genotype, or of a list with one workspace for all. */
#ifndef MORPHO_MORPHOSPACE_H
#define MORPHO_MORPHOSPACE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>
#include <morpho/random.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_VOXEL_M           0.1                                   /* edge of a voxel, meters */
#define MO_DIAGONAL_M        (MO_VOXEL_M * 1.41421356237309504880) /* diagonal of a face */
#define MO_VOXELS_MAX        (UINT32_C(1) << 20)
#define MO_DEFAULT_WORKSPACE ((struct mo_workspace){6, 6, 4})
#define MO_DEFAULT_VOXELS    144
#define MO_DEFAULT_WORDS     3 /* words of a genotype of the default workspace */
#define MO_DEFAULT_MASSES    245
#define MO_DEFAULT_SPRINGS   1648
#define MO_DEFAULT_ID_DIGITS 36 /* hexadecimal digits of an id in the default workspace */

struct mo_workspace {
  uint16_t nx, ny, nz; /* voxels along each axis, each ≥ 1 */
};

/* MO_OK; MO_ERR_RANGE for a side of 0; MO_ERR_LIMIT above MO_VOXELS_MAX voxels. */
int mo_workspace_check(struct mo_workspace workspace);
bool mo_workspace_equal(struct mo_workspace a, struct mo_workspace b);
uint32_t mo_workspace_voxels(struct mo_workspace workspace);
uint32_t mo_workspace_words(struct mo_workspace workspace);
uint32_t mo_workspace_masses(struct mo_workspace workspace);
uint32_t mo_workspace_springs(struct mo_workspace workspace);

/* ---- genotypes ---- */

/* A genotype and its workspace, which has at most MO_DEFAULT_WORDS words; words beyond those of the
 * workspace are 0. All zero: no genotype. */
struct mo_genotype {
  struct mo_workspace workspace;
  uint64_t words[MO_DEFAULT_WORDS];
};
/* An element of a list of genotypes whose workspace the list's owner knows: a million of them take
 * 24 bytes each, and the words of a list lie one after another. */
struct mo_bits {
  uint64_t words[MO_DEFAULT_WORDS];
};
struct mo_genotype mo_genotype_of(struct mo_workspace workspace, const struct mo_bits *bits);
bool mo_genotype_equal(const struct mo_genotype *a, const struct mo_genotype *b);
struct mo_genotype mo_genotype_form(const struct mo_genotype *genotype); /* the canonical form */

/* Why a list of cells is not a body: the first invalid cell in the list. */
struct mo_cell_fault {
  size_t cell;  /* index into the list */
  size_t other; /* MO_ERR_DUPLICATE: the earlier equal cell */
  int axis;     /* MO_ERR_RANGE: 0, 1, 2 for x, y, z */
};

/* Reads n cells (x, y, z each) as given, without placing them. MO_ERR_EMPTY, MO_ERR_RANGE,
 * MO_ERR_DUPLICATE, or MO_ERR_NOT_CONTIGUOUS (fault->cell: the first cell, in list order, that is
 * not connected to cell 0; `bits` has all cells). `fault` nullable; written only on those errors.
 * MO_ERR_NO_MEMORY. */
int mo_genotype_from_cells(struct mo_workspace workspace, const int64_t (*cells)[3], size_t n,
                           uint64_t *bits, struct mo_cell_fault *fault);

/* Reads '0' and '1', exactly one per voxel, in voxel order. MO_ERR_FORMAT (fault->cell: offset of
 * the first other character), MO_ERR_RANGE (wrong length: fault->cell is the length), MO_ERR_EMPTY,
 * MO_ERR_NOT_CONTIGUOUS (fault->cell: a voxel index that is not connected to the first set voxel;
 * `bits` has all voxels). */
int mo_genotype_from_text(struct mo_workspace workspace, const char *text, size_t length,
                          uint64_t *bits, struct mo_cell_fault *fault);
/* Writes one '0' or '1' per voxel and a NUL: voxels + 1 bytes. */
void mo_genotype_to_text(struct mo_workspace workspace, const uint64_t *bits, char *text);

uint32_t mo_genotype_count(struct mo_workspace workspace, const uint64_t *bits); /* voxels */
int mo_genotype_is_contiguous(struct mo_workspace workspace,
                              const uint64_t *bits); /* 1, 0 (also if empty), MO_ERR_NO_MEMORY */

/* Keeps the largest 6-connected component (ties: the one that holds the lowest voxel index). Empty
 * stays empty. */
int mo_genotype_keep_largest(struct mo_workspace workspace, uint64_t *bits);

/* Places a genotype: lowest layer at z = 0, voxel centroid as near as possible to the middle of the
 * workspace; ties: the lowest x, then the lowest y. Idempotent. Exact integer arithmetic. Empty
 * stays empty. */
void mo_genotype_place(struct mo_workspace workspace, uint64_t *bits);

/* Computes the canonical form, aligned to the origin: of the images under z-rotations by 90° and
 * reflections in x and y that fit the workspace, the lexicographically smallest of (dimensions,
 * then bits in voxel order). `form` must not overlap `bits`; the form of an empty genotype is
 * empty. */
void mo_genotype_canonical(struct mo_workspace workspace, const uint64_t *bits, uint64_t *form);

/* Writes the id: the canonical form as lower-case hexadecimal digits, first voxel in the top bit:
 * ceil(voxels / 4) digits + NUL. MO_ERR_NO_MEMORY, but only above MO_SMALL_VOXELS. */
#define MO_SMALL_VOXELS 4096
int mo_genotype_id(struct mo_workspace workspace, const uint64_t *bits, char *id);
/* Reads an id (either case) into the canonical form that it spells. MO_ERR_FORMAT: wrong length or
 * digit, stray bits, or not a canonical form; MO_ERR_EMPTY; MO_ERR_NOT_CONTIGUOUS. */
int mo_genotype_from_id(struct mo_workspace workspace, const char *id, size_t length,
                        uint64_t *form);

/* Writes the notation of a robot: a design in one orientation, which is what a score belongs to. In
 * ID@K, K is the orientation: the genotype is image K of the canonical form, placed. The bits of K
 * are applied in this order: 4 swaps x and y, 1 mirrors in x, 2 mirrors in y. If several of the 8
 * images are the genotype, K is the lowest. Two genotypes that differ only in their place have the
 * same notation. Digits of the id + 3 bytes. MO_ERR_EMPTY; MO_ERR_NO_MEMORY, but only above
 * MO_SMALL_VOXELS. */
#define MO_ORIENTATIONS         8
#define MO_DEFAULT_ROBOT_DIGITS (MO_DEFAULT_ID_DIGITS + 2) /* characters */
int mo_genotype_robot(struct mo_workspace workspace, const uint64_t *bits, char *robot);
/* Reads the notation of a robot, or an id, into the placed genotype. *orientation: K, or −1 for an
 * id without an orientation, which is read as orientation 0. Errors as in mo_genotype_from_id, and
 * MO_ERR_FORMAT for an orientation that does not fit the workspace. */
int mo_genotype_from_robot(struct mo_workspace workspace, const char *robot, size_t length,
                           uint64_t *bits, int *orientation);

/* Moves a genotype to a different workspace and places it there; turns it by 90° if it fits only
 * that way. MO_ERR_RANGE: it does not fit. `moved` must not overlap `bits`. Empty stays empty. */
int mo_genotype_move(struct mo_workspace from, const uint64_t *bits, struct mo_workspace to,
                     uint64_t *moved);

/* ---- sampling and variation: children are valid and placed ---- */

/* Draws one random body (paper, appendix A.1) from `random`. */
int mo_genotype_random(struct mo_workspace workspace, struct mo_random *random, uint64_t *bits);

/* Flips each voxel with probability `rate`, keeps the largest component, and places it.
 * MO_ERR_EMPTY if nothing is left; MO_ERR_RANGE for a rate outside 0 … 1. */
int mo_genotype_mutate(struct mo_workspace workspace, const uint64_t *parent, double rate,
                       struct mo_random *random, uint64_t *child);

/* Computes the XOR of two parents, keeps the largest component, and places it. MO_ERR_EMPTY if
 * nothing is left (as for a parent with itself). */
int mo_genotype_crossover(struct mo_workspace workspace, const uint64_t *a, const uint64_t *b,
                          uint64_t *child);

/* An exact set of canonical forms (of one workspace). Not for concurrent use. */
struct mo_form_set;
int mo_form_set_create(struct mo_workspace workspace, struct mo_form_set **set);
void mo_form_set_free(struct mo_form_set *set);
/* 1: added; 0: already present; negative: MO_ERR_NO_MEMORY or, for an empty form, MO_ERR_EMPTY; the
 * set did not change. `form` must be canonical. */
int mo_form_set_add(struct mo_form_set *set, const uint64_t *form);
int mo_form_set_has(const struct mo_form_set *set, const uint64_t *form); /* 1 or 0 */
uint64_t mo_form_set_count(const struct mo_form_set *set);
size_t mo_form_set_bytes(const struct mo_form_set *set); /* memory held */
size_t
mo_form_set_estimate(struct mo_workspace workspace,
                     uint64_t n); /* bytes that a set of n forms needs, at most while it grows */

/* A stream of random bodies, no two with the same canonical form: draw i is mo_genotype_random of
 * (seed, BODY, 0, i); draws whose form occurred before are skipped. MO_ERR_EXHAUSTED after 2^20
 * draws in a row without a new form (small workspaces run out). */
struct mo_body_stream;
int mo_body_stream_create(struct mo_workspace workspace, uint64_t seed,
                          struct mo_body_stream **stream);
void mo_body_stream_free(struct mo_body_stream *stream);
/* form: the body's canonical form; nullable. */
int mo_body_stream_next(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form);
/* Sets how many threads draw bodies ahead (initially 1, which means that none are drawn ahead); a
 * body takes a thread about 10 µs. They stop at the end of each call. The bodies do not depend on
 * the number. Setting the current number has no effect. MO_ERR_NO_MEMORY: nothing changed. */
int mo_body_stream_set_threads(struct mo_body_stream *stream, uint32_t n_threads);
uint64_t mo_body_stream_draws(
    const struct mo_body_stream *stream); /* draws so far, including skipped ones */

/* ---- phenotype ---- */

/* The full lattice of a workspace: const after creation, shared by all bodies and threads. */
struct mo_lattice {
  struct mo_workspace workspace;
  uint32_t n_voxels, n_masses, n_springs;
  const uint32_t *spring_a;     /* (n_springs) lower mass index */
  const uint32_t *spring_b;     /* (n_springs) higher mass index */
  const double *spring_rest_m;  /* (n_springs) without actuation: MO_VOXEL_M, or MO_DIAGONAL_M */
  const uint32_t *voxel_mass;   /* (n_voxels, 8) ascending */
  const uint32_t *voxel_spring; /* (n_voxels, 24) ascending */
};
int mo_lattice_create(struct mo_workspace workspace, struct mo_lattice **lattice);
void mo_lattice_free(struct mo_lattice *lattice); /* NULL-safe */

/* The masses and springs of one genotype as given (callers place it first). Const after
 * creation. */
struct mo_body {
  struct mo_workspace workspace;
  uint32_t n_voxels, n_masses, n_springs;
  const uint32_t *mass_lattice;        /* (n_masses) lattice mass index, ascending */
  const uint16_t *mass_xyz;            /* (n_masses, 3) lattice coordinates */
  const uint32_t *spring_lattice;      /* (n_springs) lattice spring index, ascending */
  const uint32_t *spring_a, *spring_b; /* (n_springs) positions in the mass arrays, a < b */
  const double *spring_rest_m;         /* (n_springs) as in the lattice */
  const uint32_t *voxel_mass;          /* (n_voxels, 8) positions in the mass arrays, ascending */
};
/* MO_ERR_EMPTY, MO_ERR_NO_MEMORY. */
int mo_body_create(const struct mo_lattice *lattice, const uint64_t *bits, struct mo_body **body);
void mo_body_free(struct mo_body *body); /* NULL-safe */

#ifdef __cplusplus
}
#endif
#endif
