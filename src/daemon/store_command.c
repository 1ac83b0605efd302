/* store_command.c: `morphod store`. Writes to standard output for people, and logs nothing. */
#include "daemon/commands.h"

#include <ctype.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/text.h"
#include "daemon/memory.h"
#include "daemon/service.h"
#include "daemon/settings.h"
#include "jobs/controllers.h"
#include "store/check.h"
#include "store/scores.h"
#include "store/store.h"

#define SAMPLE     200 /* losses of each class that `check` recomputes */
#define SAMPLE_MAX 1000000

/* ---- check: reads everything stored, and recomputes a sample ---- */

static void print_finding(void *context, const char *finding)
{
  (void)context;
  puts(finding);
}

/* Recomputes one loss. *agrees: the bits are equal. */
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
  const int error = mo_compute_run(compute, &block, 1);
  *agrees = error == MO_OK && mo_same_bits(block.outcomes[0].loss, sample->loss) &&
            block.outcomes[0].diverged_step == sample->diverged_step;
  return error;
}

/* Recomputes a sample of one class. Prints the differences; *n_differ grows. */
static int check_class(struct mo_store *store, struct mo_compute *compute,
                       const struct mo_lattice *lattice, const char *fingerprint, size_t n,
                       uint64_t *n_differ)
{
  struct mo_score_sample *samples = enough(calloc(n > 0 ? n : 1, sizeof(*samples)));
  struct mo_controller_cache controllers = {
      .store = store, .compute = compute, .mutex = PTHREAD_MUTEX_INITIALIZER};
  uint64_t before = *n_differ;
  const int64_t found =
      mo_store_sample(store, fingerprint, (uint64_t)mo_clock_wall_us(), samples, n);
  int error = found < 0 ? (int)found : MO_OK;
  for (int64_t i = 0; i < found && error == MO_OK; i++) {
    struct mo_loaded *loaded = NULL;
    bool agrees = false;
    error = mo_loaded_acquire(&controllers, &samples[i].controller_sha256, &loaded);
    if (error == MO_OK)
      error = compute_again(compute, lattice, &samples[i], loaded->ready, &agrees);
    mo_loaded_release(&controllers, loaded);
    if (error == MO_OK && !agrees) {
      char robot[MO_DEFAULT_ROBOT_DIGITS + 1] = "";
      (void)mo_genotype_robot(samples[i].genotype.workspace, samples[i].genotype.words, robot);
      printf("a stored loss of body %s differs from the recomputed one: %.17g is stored\n", robot,
             samples[i].loss);
      (*n_differ)++;
    }
  }
  if (found > 0 && error == MO_OK)
    printf("%" PRId64 " %s of class \"%s\" recomputed, %" PRIu64 " differ.\n", found,
           found == 1 ? "loss" : "losses", fingerprint, *n_differ - before);
  mo_loaded_free_all(&controllers);
  for (int64_t i = 0; i < (int64_t)n; i++)
    mo_environments_drop(&samples[i].environment, 1);
  free(samples);
  return error;
}

/* Computes samples of all classes that this CPU supports, which are the classes of its instruction
 * sets. */
static int check_classes(struct mo_store *store, size_t n, uint64_t *n_differ)
{
  struct mo_lattice *lattice = NULL;
  int error = mo_lattice_create(MO_STORE_WORKSPACE, &lattice);
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

/* Prints the contradictions, and a summary. n: number of stored losses to recompute in each class.
 * MO_ERR_CORRUPT: there are contradictions. */
static int check(struct mo_store *store, size_t n, struct mo_message *message)
{
  struct mo_check_counts counts;
  uint64_t n_differ = 0;
  int error = mo_store_check(store, message);
  if (error == MO_OK)
    error = mo_store_check_contents(store, print_finding, NULL, &counts);
  if (error != MO_OK)
    return error;
  printf("%s and %s read, %s.\n", MO_COUNTED(counts.rows, "row"), MO_COUNTED(counts.files, "file"),
         MO_COUNTED(counts.findings, "finding"));
  if (n > 0)
    error = check_classes(store, n, &n_differ);
  if (error == MO_OK && counts.findings + n_differ > 0)
    error = mo_fail(message, MO_ERR_CORRUPT, "the store is inconsistent; restore a backup");
  return error;
}

/* ---- clean ---- */

struct listed {
  uint64_t n, bytes;
};

/* Prints one file. A name may contain anything, so control characters are replaced. */
static void print_file(void *context, const char *name, uint64_t bytes)
{
  struct listed *listed = context;
  listed->n++;
  listed->bytes += bytes;
  printf("%14" PRIu64 "  ", bytes);
  for (const char *c = name; *c != '\0'; c++)
    putchar(iscntrl((unsigned char)*c) ? '?' : *c);
  putchar('\n');
}

static int clean(struct mo_store *store, bool yes)
{
  struct listed listed = {0, 0};
  char answer[16] = "";
  int error = mo_store_clean(store, print_file, &listed);
  if (error != MO_OK)
    return error;
  printf("%s, %s.\n", MO_COUNTED(listed.n, "unused file"), MO_COUNTED(listed.bytes, "byte"));
  if (listed.n == 0)
    return MO_OK;
  if (!yes) {
    fputs("Remove them? [y/N] ", stdout);
    fflush(stdout);
    yes = fgets(answer, sizeof(answer), stdin) != NULL && (answer[0] == 'y' || answer[0] == 'Y');
  }
  if (yes)
    error = mo_store_clean(store, NULL, NULL);
  if (error == MO_OK)
    puts(yes ? "Removed." : "Nothing was removed; --yes removes without asking.");
  return error;
}

/* ---- the command ---- */

static int accept_clock(struct mo_store *store)
{
  char text[32];
  const time_t now = (time_t)(mo_clock_wall_us() / 1000000);
  struct tm utc;
  const int error = mo_store_accept_clock(store);
  if (error == MO_OK && gmtime_r(&now, &utc) != NULL &&
      strftime(text, sizeof(text), "%Y-%m-%d %H:%M:%S", &utc) > 0)
    printf(
        "The time %s UTC was accepted. After the next start, jobs will again be deleted by age.\n",
        text);
  return error;
}

struct command {
  bool checks, accepts_clock, yes; /* check; accept-clock; otherwise clean */
  size_t n_sample;
};

static int run(const char *state_dir, const struct command *command)
{
  struct mo_store_config config = {.path = state_dir, .n_readers = 2, .must_exist = true};
  struct mo_message message = {{0}};
  struct mo_store *store = NULL;
  umask(077);
  int error = mo_store_open(&config, &store, &message);
  if (error == MO_OK)
    error = command->checks          ? check(store, command->n_sample, &message)
            : command->accepts_clock ? accept_clock(store)
                                     : clean(store, command->yes);
  mo_store_close(store);
  if (error == MO_OK)
    return EXIT_OK;
  fprintf(stderr, "morphod: %s\n", message.text[0] != '\0' ? message.text : mo_error_text(error));
  return service_store_status(error);
}

static bool read_sample(const char *text, size_t *n)
{
  char *end = NULL;
  const unsigned long long value = strtoull(text, &end, 10);
  *n = (size_t)value;
  return text[0] >= '0' && text[0] <= '9' && *end == '\0' && value <= SAMPLE_MAX;
}

int store_command(int argc, const char *const *argv)
{
  struct settings settings = {0};
  struct settings_request request = {0};
  struct settings_faults faults = {0};
  const char **flags = enough(calloc((size_t)argc, sizeof(*flags)));
  const bool is_clean = argc > 2 && strcmp(argv[2], "clean") == 0,
             is_check = argc > 2 && strcmp(argv[2], "check") == 0,
             is_clock = argc > 2 && strcmp(argv[2], "accept-clock") == 0;
  struct command command = {.checks = is_check, .accepts_clock = is_clock, .n_sample = SAMPLE};
  bool is_wrong = !is_clean && !is_check && !is_clock;
  int n = 0;
  settings_init(&settings);
  for (int i = is_wrong ? 1 : 2; i < argc; i++) /* flags[0] is the program's name */
    if (is_clean && strcmp(argv[i], "--yes") == 0)
      command.yes = true;
    else if (is_check && strncmp(argv[i], "--sample=", 9) == 0)
      is_wrong = !read_sample(argv[i] + 9, &command.n_sample);
    else
      flags[n++] = argv[i];
  settings_load(&settings, n, flags, (const char *const *)environ, &request, &faults);
  settings_complete(&settings, (const char *const *)environ);
  settings_faults_print(&faults);
  int status = faults.n_fatal > 0 ? EXIT_CONFIG : EXIT_OK;
  if (request.action == ACTION_HELP) {
    settings_print_help(stdout);
  } else if (is_wrong || request.usage_fault || request.action != ACTION_RUN) {
    fputs("Usage: morphod store clean [--yes] [FLAG]...\n"
          "       morphod store check [--sample=N] [FLAG]...\n"
          "       morphod store accept-clock [FLAG]...; see --help\n",
          stderr);
    status = EXIT_USAGE;
  } else if (status == EXIT_OK) {
    status = run(settings.state_dir, &command);
  }
  settings_faults_free(&faults);
  settings_request_free(&request);
  settings_free(&settings);
  free(flags);
  return status;
}
