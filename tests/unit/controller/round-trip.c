/* round-trip.c: reads a controller and writes it back, for interop.py. */
#include <stdio.h>
#include <stdlib.h>

#include <morpho/controller.h>

int main(int argc, char **argv)
{
  if (argc != 3) {
    fprintf(stderr, "usage: %s IN OUT\n", argv[0]);
    return 2;
  }
  struct mo_controller *controller = NULL;
  struct mo_message message = {""};
  int r = mo_controller_read(argv[1], &controller, &message);
  uint8_t *bytes = NULL;
  size_t size = 0;
  if (r == MO_OK)
    r = mo_controller_encode(controller, &bytes, &size);
  if (r < 0)
    fprintf(stderr, "%s: %s\n", argv[1], message.text);
  FILE *out = r == MO_OK ? fopen(argv[2], "wb") : NULL;
  const int failed = out == NULL || fwrite(bytes, 1, size, out) != size || fclose(out) != 0;
  free(bytes);
  mo_controller_free(controller);
  return failed;
}
