/* body.h: feeds bytes to a reader of request bodies. An accepted body must be valid, a refused one
 * must have a fault, and jansson decides what is JSON. Included after the target's definitions of
 * READER_PARSED, READER_PARSE and check_accepted, and, if they are others, of what to check and
 * what to free of a parsed body. */
#include <jansson.h>
#include <stdlib.h>
#include <string.h>

#ifndef READER_REQUEST
#define READER_REQUEST(parsed) (&(parsed)->request)
#define READER_FREE(parsed)    mo_parts_free(&(parsed)->parts)
#endif

/* The rest of the body was not checked. */
static bool ended_early(const struct mo_faults *faults)
{
  return strstr(faults->items[0].detail, "at most 64 levels deep") != NULL ||
         strstr(faults->items[0].detail, "at most 256 bytes") != NULL;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  READER_PARSED parsed;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  char *text = malloc(size + 1);
  if (faults == NULL || text == NULL) {
    free(faults);
    free(text);
    return 0;
  }
  if (size > 0)
    memcpy(text, data, size);
  text[size] = '\0';
  int code = READER_PARSE(text, size, &parsed, faults);
  if (code == MO_OK)
    check_accepted(READER_REQUEST(&parsed));
  else if (code != MO_ERR_NO_MEMORY)
    FUZZ_PROMISE(faults->n > 0 && faults->malformed == (code == MO_ERR_FORMAT));
  for (unsigned i = 0; i < faults->n; i++)
    FUZZ_PROMISE(faults->items[i].detail[0] != '\0');
  READER_FREE(&parsed);
  if (memchr(text, '\0', size) == NULL && size < 100000) {
    json_error_t error;
    json_t *tree = json_loadb(text, size, JSON_REJECT_DUPLICATES | JSON_DECODE_ANY, &error);
    if (code == MO_OK)
      FUZZ_PROMISE(tree != NULL || json_error_code(&error) == json_error_numeric_overflow);
    if (code == MO_ERR_FORMAT && !ended_early(faults))
      FUZZ_PROMISE(tree == NULL);
    json_decref(tree);
  }
  free(text);
  free(faults);
  return 0;
}
