/* clients.c: what one client has in flight. */
#include "http/client.h"

#include "unit/check.h"

/* A client is remembered while one of its requests waits, no matter how long. */
static void parked_clients_are_kept(void)
{
  static const unsigned char key[16] = "parked";
  struct mo_clients clients = {.lock = PTHREAD_MUTEX_INITIALIZER};
  bool refused;
  struct mo_client *client = mo_client_enter(&clients, key, 1, &refused);
  REQUIRE(client != NULL);
  CHECK(mo_client_enter(&clients, key, 1, &refused) == NULL && refused);
  mo_client_park(&clients, client, true);
  mo_clients_sweep(&clients, INT64_MAX);
  CHECK(mo_client_enter(&clients, key, 1, &refused) == client);
  mo_client_park(&clients, client, false); /* two of one: a resumed one is not refused */
  mo_client_leave(&clients, client, 0);
  CHECK(mo_client_enter(&clients, key, 1, &refused) == NULL && refused);
  mo_client_leave(&clients, client, 0);
  mo_clients_free(&clients);
}

static const struct check_case cases[] = {{"waiting clients are kept", parked_clients_are_kept}};
CHECK_MAIN(cases)
