/* assets.c: the dashboard: its page at / and its files below /assets. */
#include "api/assets.h"

#include <stdio.h>
#include <string.h>

#include "api/handlers.h"

/* No other site may frame the page, run code in it, or receive anything from it. */
static const char policy[] =
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; media-src blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types 'none'";

const char *const mo_dashboard_words[] = {"on", "read-only", "off", NULL};

/* Returns whether the dashboard is on. If it is off, replies with a 404. */
static bool is_on(struct mo_request *request)
{
  if (mo_api_of(request)->dashboard != MO_DASHBOARD_OFF)
    return true;
  mo_reply_problem(request, 404, NULL,
                   "The dashboard of this service is off; its operator can turn it on with the "
                   "setting dashboard = on. /openapi.json lists all paths.");
  return false;
}

static void reply_asset(struct mo_request *request, const struct mo_asset *asset)
{
  const struct mo_embedded bytes = {asset->bytes, asset->size, asset->gzip, asset->gzip_size};
  mo_reply_embedded(request, asset->type, &bytes, "%s-%s", mo_assets_version, asset->name);
  request->reply.policy = policy;
}

static const struct mo_asset *find(const char *name)
{
  for (size_t i = 0; i < mo_assets_count; i++)
    if (strcmp(mo_assets[i].name, name) == 0)
      return &mo_assets[i];
  return NULL;
}

void mo_api_get_index(struct mo_request *request)
{
  if (is_on(request))
    reply_asset(request, find("index.html"));
}

/* Browsers request an icon even for replies that are not pages. */
void mo_api_get_icon(struct mo_request *request)
{
  if (is_on(request))
    reply_asset(request, find("icon.svg"));
}

/* Replies with /assets/{version}/{file}, or a file in a folder. */
void mo_api_get_asset(struct mo_request *request)
{
  const char *version = request->parameters[0], *below = request->parameters[2];
  char name[2 * MO_PATH_PARAMETER_BYTES];
  if (!is_on(request))
    return;
  snprintf(name, sizeof(name), "%s%s%s", request->parameters[1], below[0] != '\0' ? "/" : "",
           below);
  const struct mo_asset *asset = strcmp(version, mo_assets_version) == 0 ? find(name) : NULL;
  if (asset == NULL) {
    mo_reply_problem(request, 404, NULL, "The dashboard has no such file; reload the page.");
    return;
  }
  reply_asset(request, asset);
  request->reply.keep = true;
}
