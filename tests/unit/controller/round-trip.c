/* round-trip.c: reads a controller and writes it again: for interop.py. */
#include <stdio.h>

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
  if (r == MO_OK)
    r = mo_controller_write(controller, argv[2], &message);
  if (r < 0)
    fprintf(stderr, "%s: %s\n", argv[1], message.text);
  mo_controller_free(controller);
  return r < 0;
}
