/* routes.c: the table of routes, from routes.inc. */
#include "api/handlers.h"

static const struct mo_route table[] = {
#define ROUTE(PATH, METHOD, HANDLER, FLAGS, BODY, QUERY)                                           \
  {PATH, MO_##METHOD, mo_api_##HANDLER, FLAGS, MO_BODY_##BODY, QUERY},
#include "api/routes.inc"
};
_Static_assert(sizeof(table) / sizeof(table[0]) <= MO_ROUTES_MAX, "metrics count by route");

const struct mo_routes mo_api_routes = {table, sizeof(table) / sizeof(table[0])};
