/* route.h: finds the route of a request. The table itself belongs to the service that uses this
 * room; metrics, Allow and the contract's tests use it as well. */
#ifndef MORPHO_HTTP_ROUTE_H
#define MORPHO_HTTP_ROUTE_H

#include <stdbool.h>
#include <stddef.h>

enum mo_method {
  MO_GET = 1 << 0,
  MO_HEAD = 1 << 1,
  MO_POST = 1 << 2,
  MO_PUT = 1 << 3,
  MO_DELETE = 1 << 4,
  MO_OPTIONS = 1 << 5,
  MO_PATCH = 1 << 6,
  MO_OTHER_METHOD = 0
};

enum mo_route_flag {
  MO_ROUTE_OPEN = 1,     /* needs no token */
  MO_ROUTE_DIRECT = 2,   /* answered without an API thread */
  MO_ROUTE_HEALTH = 4,   /* also answered on the connections reserved for health requests */
  MO_ROUTE_LIST = 8,     /* returns or reads much; LIST, HEAVY and ROLLOUT have their own threads */
  MO_ROUTE_RATED = 16,   /* accepts work or data; limited by client_rate_per_s */
  MO_ROUTE_VARY = 32,    /* the form of the reply depends on Accept */
  MO_ROUTE_JSON = 64,    /* the reply is JSON; an Accept that excludes it gets 406 */
  MO_ROUTE_HEAVY = 128,  /* the handler may compute for seconds */
  MO_ROUTE_ROLLOUT = 256 /* interactive: the handler waits for workers */
};

/* The right of a token's holder; each right includes the rights before it. Workers have their own
 * server, and no right on the server for clients. */
enum mo_right {
  MO_RIGHT_WORKER, /* take leases and return their results */
  MO_RIGHT_READ,   /* read, and compute without storing anything */
  MO_RIGHT_SUBMIT, /* submit jobs and control them */
  MO_RIGHT_ADMIN   /* remove or replace data that others may use */
};
extern const char *const mo_right_words[]; /* "worker", "read", "submit", "admin", NULL */

/* A bearer token. */
#define MO_TOKEN_NAME_MAX 64
#define MO_TOKENS_MAX     64
struct mo_token {
  const char *name; /* its holder: 1 to 64 printable ASCII characters without blanks */
  enum mo_right right;
  const char *text; /* 16 to 512 printable ASCII characters without blanks */
};

/* The size limit of the body. */
enum mo_body_limit {
  MO_BODY_SMALL, /* 64 KiB */
  MO_BODY_LARGE, /* max_body_bytes of the configuration; a length is required */
  MO_BODY_FILE,  /* max_file_bytes of the configuration; a length is required */
  MO_BODY_BUNDLE /* max_bundle_bytes of the configuration; a length is required */
};

struct mo_request;

/* One method of one path. Lines with the same path are adjacent. */
struct mo_route {
  const char *path; /* "/v1/jobs/{id}" */
  enum mo_method method;
  void (*handler)(struct mo_request *request);
  enum mo_right right; /* required of the caller, unless the route is open */
  unsigned flags;      /* from enum mo_route_flag */
  enum mo_body_limit body;
  const char *query; /* the known query parameters, separated by spaces; "": none */
};

struct mo_routes {
  const struct mo_route *items;
  size_t n;
};
#define MO_ROUTES_MAX           128
#define MO_PATH_PARAMETERS      3
#define MO_PATH_PARAMETER_BYTES 160 /* a genotype has 144 digits */

enum mo_method mo_method_of(const char *name);

/* Finds the first line of a path as received; percent escapes are decoded per segment. parameters:
 * the values of {…} in order, NUL-terminated. Returns NULL if the path does not exist. */
const struct mo_route *mo_route_find(const struct mo_routes *routes, const char *path, size_t size,
                                     char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES]);
/* Finds the line of a method, starting from the first line of the path; HEAD is served as GET.
 * Returns NULL if the path does not have this method. */
const struct mo_route *mo_route_of_method(const struct mo_routes *routes,
                                          const struct mo_route *path, enum mo_method method);
/* Writes the methods of a path, given its first line: "GET, HEAD, OPTIONS". */
void mo_route_allow(const struct mo_routes *routes, const struct mo_route *path, char allow[64]);

#endif
