/* wire.h: the messages of an exchange between the daemon and a worker.
 *
 * A worker sends one message of results and receives one message of leases. A lease has the
 * genotypes of bodies, the environments and physics to score them in, and the hash of the weights;
 * or it is a gradient shard, in which each robot is a block of one environment. A result has the
 * rows of one lease, and the sum of a shard. Numbers are little-endian, and floats are transferred
 * bit for bit.
 *
 *   message    header, then the items one after another
 *   header     "MOFLEET" and kind ('L' leases, 'R' results); u32 version; u32 items; u64 bytes of
 *              the whole message
 *   lease      u64 epoch; u64 number; u32 flags; u32 environments; u32 blocks; u32 rows; 32 bytes
 *              SHA-256 of the weights (zeros: passive bodies); physics; u32 0; for a gradient its
 *              options; environments (66 f64 each); blocks
 *   flags      1: on a device; 2: a gradient; 4: with measures; second, third and fourth byte: the
 *              versions of the packed physics, options and environments, minus 1
 *   physics    packed; in version 1: 9 f64; u32 steps, impact, bisections
 *   options    f64 bound of the adjoint, weight, weight of restarts; u32 rule, parameters
 *   block      genotype (⌈voxels / 8⌉ bytes); u8 n; n × u16 environment
 *   result     u64 epoch; u64 number; u32 state; u32 rows; f64 CPU seconds; f64 elapsed
 *              seconds; rows × f64 loss; rows × u32 step of divergence; in state 3 (done with a
 *              gradient): u64 parameters; counts (6 u64, f64); parameters × f64 sum; in state 5
 *              (done with measures): u32 measures; u32 0; rows × measures × f64 (NaN: no value)
 *
 * Physics, options and environments are packed by their rows (base/fields.h); version 1 is shown.
 *
 * A decoder accepts exactly what an encoder writes: every size is bounded, no data follows the last
 * item, and values pass the API's checks. */
#ifndef MORPHO_FLEET_WIRE_H
#define MORPHO_FLEET_WIRE_H

#include <morpho/compute.h>
#include <morpho/measure.h>

#include "base/sha256.h"

#define MO_WIRE_VERSION     1
#define MO_WIRE_LEASES_MAX  4      /* in a message */
#define MO_WIRE_RESULTS_MAX 8      /* in a message */
#define MO_WIRE_ROWS_MAX    131072 /* in a lease */
#define MO_WIRE_MEASURED_MAX                                                                       \
  16384 /* in a lease with measures, whose rows are MO_WIRE_MEASURED_ROWS times as large */
#define MO_WIRE_ENVIRONMENTS_MAX 4096      /* in a lease */
#define MO_WIRE_WORDS_MAX        16        /* in a genotype: 1024 voxels */
#define MO_WIRE_PARAMETERS_MAX   (1 << 20) /* in a gradient */
/* Bytes of a row of a result without and with measures, and how many rows without measures a row
 * with measures counts as. */
#define MO_WIRE_ROW_BYTES      12
#define MO_WIRE_MEASURED_BYTES (MO_WIRE_ROW_BYTES + 8 * MO_MEASURES)
#define MO_WIRE_MEASURED_ROWS  (1 + (MO_WIRE_MEASURED_BYTES - 1) / MO_WIRE_ROW_BYTES)

/* The epoch counts how often the store was opened. A restarted daemon therefore cannot mistake a
 * result of a lease from its previous run for a result of one of its own. */
struct mo_lease_id {
  uint64_t epoch, number;
};

struct mo_wire_block {
  uint64_t genotype[MO_WIRE_WORDS_MAX]; /* in its canonical place */
  uint32_t n_environments;              /* 1 … MO_BLOCK_LANES */
  uint16_t environments[MO_BLOCK_LANES];
};
struct mo_wire_lease {
  struct mo_lease_id id;
  struct mo_sha256 controller; /* hash of the file from mo_controller_encode; zeros: passive
                                * bodies */
  struct mo_physics physics;
  enum mo_back_end back_end; /* flag 1: on a device */
  uint32_t n_parameters;     /* flag 2: a gradient; 0: scores */
  struct mo_gradient_options gradient;
  bool has_measures; /* flag 4: all measures of each row are computed, too */
  uint32_t n_environments, n_blocks, n_rows;
  struct mo_environment *environments; /* (n_environments) */
  struct mo_wire_block *blocks;        /* (n_blocks) */
};

enum mo_wire_state {
  MO_RESULT_DONE = 0,
  MO_RESULT_GIVEN_BACK = 1, /* not computed: the worker is leaving, or the lease was cancelled */
  MO_RESULT_FAILED = 2,     /* the worker failed */
  MO_RESULT_UNSUPPORTED = 4 /* no worker of its class computes this; not used for CPU shards */
};
struct mo_wire_result {
  struct mo_lease_id id;
  enum mo_wire_state state;
  uint32_t n_rows; /* of the blocks, in their order; 0 unless MO_RESULT_DONE */
  double busy_s;   /* CPU (or device) seconds */
  double wall_s;
  double *losses;                  /* (n_rows) +infinity: diverged */
  uint32_t *diverged_steps;        /* (n_rows) 0: did not diverge */
  double (*measures)[MO_MEASURES]; /* (n_rows) NULL: none */
  uint32_t n_parameters;           /* of a gradient; 0: scores */
  double *d_parameters;            /* (n_parameters) */
  struct mo_gradient_counts counts;
};

struct mo_wire_leases {
  uint32_t n;
  struct mo_wire_lease items[MO_WIRE_LEASES_MAX];
};
struct mo_wire_results {
  uint32_t n;
  struct mo_wire_result items[MO_WIRE_RESULTS_MAX];
};

/* Encode a message (malloc). MO_ERR_NO_MEMORY, MO_ERR_LIMIT. */
int mo_wire_put_leases(const struct mo_wire_leases *leases, struct mo_workspace workspace,
                       uint8_t **bytes, size_t *size);
int mo_wire_put_results(const struct mo_wire_results *results, uint8_t **bytes, size_t *size);
/* Decode a message and check every value. MO_ERR_FORMAT: the message says what is wrong, and in
 * which item; MO_ERR_UNSUPPORTED: a different version; MO_ERR_NO_MEMORY. After an error, there is
 * nothing to free. */
int mo_wire_get_leases(const uint8_t *bytes, size_t size, struct mo_workspace workspace,
                       struct mo_wire_leases *leases, struct mo_message *message);
int mo_wire_get_results(const uint8_t *bytes, size_t size, struct mo_wire_results *results,
                        struct mo_message *message);
void mo_wire_free_lease(struct mo_wire_lease *lease); /* frees its arrays */
void mo_wire_free_leases(struct mo_wire_leases *leases);
void mo_wire_free_results(struct mo_wire_results *results);

#endif
