/* replay.c: feeds every file in the folders on the command line to a fuzz target, in order of their
 * names, and each file also truncated at every length up to 64 bytes. Fails if a folder is
 * empty. */
#include "target.h"

#include <dirent.h>
#include <string.h>

#define INPUT_BYTES_MAX (1 << 20)
#define PREFIXES        64

/* An input in an allocation of exactly its size, so that a sanitizer notices a read beyond its
 * end. */
static int feed(const uint8_t *data, size_t size)
{
  uint8_t *exact = malloc(size > 0 ? size : 1);
  if (exact == NULL)
    return -1;
  memcpy(exact, data, size);
  LLVMFuzzerTestOneInput(exact, size);
  free(exact);
  return 0;
}

static int replay_file(const char *path, uint8_t *buffer)
{
  FILE *file = fopen(path, "rb");
  if (file == NULL) {
    perror(path);
    return -1;
  }
  size_t size = fread(buffer, 1, INPUT_BYTES_MAX, file);
  int code = ferror(file) ? -1 : 0;
  fclose(file);
  if (code == 0)
    code = feed(buffer, size);
  for (size_t cut = 0; code == 0 && cut < size && cut < PREFIXES; cut++)
    code = feed(buffer, cut);
  return code;
}

static int is_visible(const struct dirent *entry)
{
  return entry->d_name[0] != '.';
}

int main(int argc, char **argv)
{
  uint8_t *buffer = malloc(INPUT_BYTES_MAX);
  int failed = buffer == NULL || argc < 2;
  for (int i = 1; i < argc && !failed; i++) {
    struct dirent **entries = NULL;
    int n = scandir(argv[i], &entries, is_visible, alphasort);
    failed |= n <= 0;
    for (int k = 0; k < n; k++) {
      char path[4096];
      snprintf(path, sizeof(path), "%s/%s", argv[i], entries[k]->d_name);
      failed |= replay_file(path, buffer) != 0;
      free(entries[k]);
    }
    free(entries);
    printf("%s: %d inputs\n", argv[i], n);
  }
  free(buffer);
  return failed ? EXIT_FAILURE : EXIT_SUCCESS;
}
