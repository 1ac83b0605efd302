/* store_check.c: see store_check.h. Writes to standard output for a person. */
#include "daemon/store_check.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/check.h"

static void print_finding(void *context, const char *finding)
{
  (void)context;
  puts(finding);
}

/* A controller that is ready to compute; samples with the same one come one after the other. */
struct loaded {
  struct mo_sha256 sha256;
  struct mo_controller *controller;
  struct mo_compute_controller *ready;
};

static void unload(struct loaded *loaded)
{
  mo_compute_controller_free(loaded->ready);
  mo_controller_free(loaded->controller);
  *loaded = (struct loaded){.ready = NULL};
}

static int load(struct mo_store *store, struct mo_compute *compute, const struct mo_sha256 *sha256,
                struct loaded *loaded)
{
  struct mo_message message;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error;
  if (loaded->ready != NULL && mo_sha256_equal(&loaded->sha256, sha256))
    return MO_OK;
  unload(loaded);
  error = mo_store_controller_bytes(store, sha256, &bytes, &size);
  if (error == MO_OK)
    error = mo_controller_decode(bytes, size, &loaded->controller, &message);
  free(bytes);
  if (error == MO_OK)
    error = mo_compute_controller_create(compute, loaded->controller, &loaded->ready);
  loaded->sha256 = *sha256;
  return error;
}

/* Computes one loss again. *agrees: bit for bit. */
static int compute_again(struct mo_compute *compute, const struct mo_lattice *lattice,
                         const struct mo_score_sample *sample, struct mo_compute_controller *ready,
                         bool *agrees)
{
  struct mo_block block = {.lattice = lattice,
                           .genotype = sample->genotype.words,
                           .controller = ready,
                           .environments = {&sample->environment},
                           .n_environments = 1,
                           .physics = sample->physics,
                           .precision = sample->precision};
  uint64_t bits[2];
  int error = mo_compute_run(compute, &block, 1);
  memcpy(&bits[0], &block.outcomes[0].loss, sizeof(bits[0]));
  memcpy(&bits[1], &sample->loss, sizeof(bits[1]));
  *agrees = error == MO_OK && bits[0] == bits[1] &&
            block.outcomes[0].diverged_step == sample->diverged_step;
  return error;
}

/* Computes a sample of one class again. Prints what differs; *n_differ grows. */
static int check_class(struct mo_store *store, struct mo_compute *compute,
                       const struct mo_lattice *lattice, const char *fingerprint, size_t n,
                       uint64_t *n_differ)
{
  struct mo_score_sample *samples = calloc(n > 0 ? n : 1, sizeof(*samples));
  struct loaded loaded = {.ready = NULL};
  uint64_t before = *n_differ;
  int64_t found = samples != NULL ? mo_store_sample(store, fingerprint,
                                                    (uint64_t)mo_clock_wall_us(), samples, n)
                                  : MO_ERR_NO_MEMORY;
  int error = found < 0 ? (int)found : MO_OK;
  for (int64_t i = 0; i < found && error == MO_OK; i++) {
    bool agrees = false;
    error = load(store, compute, &samples[i].controller_sha256, &loaded);
    if (error == MO_OK)
      error = compute_again(compute, lattice, &samples[i], loaded.ready, &agrees);
    if (error == MO_OK && !agrees) {
      char id[MO_DEFAULT_ID_DIGITS + 1];
      mo_genotype_id(MO_DEFAULT_WORKSPACE, samples[i].genotype.words, id);
      printf("a loss of the body %s is not what is computed again: %.17g is stored\n", id,
             samples[i].loss);
      (*n_differ)++;
    }
  }
  if (found > 0 && error == MO_OK)
    printf("%" PRId64 " losses of the class \"%s\" computed again, %" PRIu64 " differ.\n", found,
           fingerprint, *n_differ - before);
  unload(&loaded);
  free(samples);
  return error;
}

/* Computes samples of all classes that this processor has: those of its instruction sets. */
static int check_classes(struct mo_store *store, size_t n, uint64_t *n_differ)
{
  struct mo_lattice *lattice = NULL;
  int error = mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice);
  for (int isa = 0; isa <= (int)mo_isa_best() && error == MO_OK; isa++) {
    const struct mo_compute_config config = {.n_workers = 1, .isa = (enum mo_isa)isa};
    struct mo_compute *compute = NULL;
    error = mo_compute_create_cpu(&config, &compute);
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64 && error == MO_OK; precision++)
      error =
          check_class(store, compute, lattice,
                      mo_compute_fingerprint(compute, (enum mo_precision)precision), n, n_differ);
    mo_compute_free(compute);
  }
  mo_lattice_free(lattice);
  return error;
}

int store_check(struct mo_store *store, size_t n, struct mo_message *message)
{
  struct mo_check_counts counts;
  uint64_t n_differ = 0;
  int error = mo_store_check(store, message);
  if (error == MO_OK)
    error = mo_store_check_contents(store, print_finding, NULL, &counts);
  if (error != MO_OK)
    return error;
  printf("%" PRIu64 " rows and %" PRIu64 " files read, %" PRIu64 " findings.\n", counts.rows,
         counts.files, counts.findings);
  if (n > 0)
    error = check_classes(store, n, &n_differ);
  if (error == MO_OK && counts.findings + n_differ > 0)
    error = mo_fail(message, MO_ERR_CORRUPT,
                    "what is stored does not agree with itself: restore a backup");
  return error;
}
