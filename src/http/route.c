/* route.c: see route.h. */
#include "http/route.h"

#include <stdio.h>
#include <string.h>

#include "http/field.h"

static const struct {
  const char *name;
  enum mo_method method;
} methods[] = {{"GET", MO_GET},     {"HEAD", MO_HEAD},     {"POST", MO_POST},      {"PUT", MO_PUT},
               {"PATCH", MO_PATCH}, {"DELETE", MO_DELETE}, {"OPTIONS", MO_OPTIONS}};

enum mo_method mo_method_of(const char *name)
{
  for (size_t i = 0; i < sizeof(methods) / sizeof(methods[0]); i++)
    if (strcmp(name, methods[i].name) == 0)
      return methods[i].method;
  return MO_OTHER_METHOD;
}

static bool matches(const char *pattern, const char *path, size_t size,
                    char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES])
{
  size_t at = 0, parameter = 0;
  while (*pattern != '\0') {
    /* Path and pattern must both be at a slash. */
    if (at >= size || path[at] != '/')
      return false;
    pattern++, at++;
    size_t wanted = strcspn(pattern, "/");
    size_t given = 0;
    while (at + given < size && path[at + given] != '/')
      given++;
    if (*pattern == '{') {
      if (given == 0 || !mo_percent_decode(path + at, given, false, parameters[parameter],
                                           MO_PATH_PARAMETER_BYTES))
        return false;
      parameter++;
    } else if (wanted != given || memcmp(pattern, path + at, given) != 0) {
      return false;
    }
    pattern += wanted;
    at += given;
  }
  return at == size;
}

const struct mo_route *mo_route_find(const struct mo_routes *routes, const char *path, size_t size,
                                     char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES])
{
  for (size_t i = 0; i < routes->n; i++)
    if (matches(routes->items[i].path, path, size, parameters))
      return &routes->items[i];
  return NULL;
}

/* Returns the next line of the same path, or NULL after the last one. */
static const struct mo_route *next_of_path(const struct mo_routes *routes,
                                           const struct mo_route *route)
{
  const struct mo_route *next = route + 1;
  return next < routes->items + routes->n && strcmp(next->path, route->path) == 0 ? next : NULL;
}

const struct mo_route *mo_route_of_method(const struct mo_routes *routes,
                                          const struct mo_route *path, enum mo_method method)
{
  while (path != NULL && path->method != (method == MO_HEAD ? MO_GET : method))
    path = next_of_path(routes, path);
  return path;
}

void mo_route_allow(const struct mo_routes *routes, const struct mo_route *path, char allow[64])
{
  size_t at = 0;
  unsigned allowed = MO_OPTIONS;
  for (; path != NULL; path = next_of_path(routes, path))
    allowed |= path->method == MO_GET ? MO_GET | MO_HEAD : (unsigned)path->method;
  for (size_t i = 0; i < sizeof(methods) / sizeof(methods[0]); i++)
    if (allowed & (unsigned)methods[i].method)
      at += (size_t)snprintf(allow + at, 64 - at, "%s%s", at > 0 ? ", " : "", methods[i].name);
}
