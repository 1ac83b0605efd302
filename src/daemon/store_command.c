/* store_command.c: see store_command.h. Writes to standard output for a person, logs nothing. */
#include "store_command.h"

#include <ctype.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/service.h"
#include "daemon/settings.h"
#include "daemon/store_check.h"
#include "store/store.h"

#define SAMPLE     200 /* losses of each class that `check` computes again */
#define SAMPLE_MAX 1000000

struct command {
  bool checks, yes; /* check; otherwise clean */
  size_t n_sample;
};

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
  printf("%" PRIu64 " files, %" PRIu64 " bytes, that nothing refers to.\n", listed.n, listed.bytes);
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
    puts(yes ? "Removed." : "Nothing was removed; --yes does not ask.");
  return error;
}

static int run(const char *state_dir, const struct command *command)
{
  struct mo_store_config config = {.path = state_dir, .n_readers = 2, .must_exist = true};
  struct mo_message message = {{0}};
  struct mo_store *store = NULL;
  umask(077);
  int error = mo_store_open(&config, &store, &message);
  if (error == MO_OK)
    error = command->checks ? store_check(store, command->n_sample, &message)
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
  const char **flags = calloc((size_t)argc, sizeof(*flags));
  const bool is_clean = argc > 2 && strcmp(argv[2], "clean") == 0,
             is_check = argc > 2 && strcmp(argv[2], "check") == 0;
  struct command command = {.checks = is_check, .n_sample = SAMPLE};
  bool is_wrong = !is_clean && !is_check;
  int n = 0, status = EXIT_SYSTEM;
  if (flags == NULL || settings_init(&settings) != MO_OK)
    goto out;
  for (int i = is_wrong ? 1 : 2; i < argc; i++) /* flags[0] is the program's name */
    if (is_clean && strcmp(argv[i], "--yes") == 0)
      command.yes = true;
    else if (is_check && strncmp(argv[i], "--sample=", 9) == 0)
      is_wrong = !read_sample(argv[i] + 9, &command.n_sample);
    else
      flags[n++] = argv[i];
  settings_load(&settings, n, flags, (const char *const *)environ, &request, &faults);
  if (settings_complete(&settings, (const char *const *)environ) != MO_OK)
    settings_fault(&faults, true, "out of memory");
  settings_faults_print(&faults);
  status = faults.n_fatal > 0 ? EXIT_CONFIG : EXIT_OK;
  if (request.action == ACTION_HELP) {
    settings_print_help(stdout);
  } else if (is_wrong || request.usage_fault || request.action != ACTION_RUN) {
    fputs("Usage: morphod store clean [--yes] [FLAG]...\n"
          "       morphod store check [--sample=N] [FLAG]...; see --help\n",
          stderr);
    status = EXIT_USAGE;
  } else if (status == EXIT_OK) {
    status = run(settings.state_dir, &command);
  }
out:
  settings_faults_free(&faults);
  settings_request_free(&request);
  settings_free(&settings);
  free(flags);
  return status;
}
