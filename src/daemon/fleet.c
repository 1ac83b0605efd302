/* fleet.c: see fleet.h. */
#include "fleet.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "daemon/log.h"
#include "daemon/memory.h"
#include "daemon/tokens.h"

#define PEM_MAX 65536 /* bytes of a file */

/* Each session holds a connection for its orders and one for leases. The third may be one that has
 * just been lost. */
#define CONNECTIONS_MAX (3 * 4096)
#define BODY_BYTES      (UINT64_C(8) << 20) /* of an exchange */
#define BODY_MEMORY     (UINT64_C(256) << 20)
#define BODY_TIMEOUT_MS 300000 /* 8 MiB at 250 kbit/s */

/* Reads a text (malloc, with a NUL). A pipe is refused: reading it would wait without end. */
static int read_pem(const char *name, const char *path, char **text, struct mo_message *message)
{
  struct stat status;
  FILE *file = NULL;
  size_t n = 0;
  errno = 0;
  if (stat(path, &status) != 0 || !S_ISREG(status.st_mode) || (file = fopen(path, "re")) == NULL)
    return mo_fail(message, MO_ERR_INVALID, "%s: %s: %s", name, path,
                   errno != 0 ? strerror(errno) : "not a file");
  *text = calloc(1, PEM_MAX + 1);
  if (*text != NULL)
    n = fread(*text, 1, PEM_MAX + 1, file);
  const bool failed = ferror(file) != 0;
  fclose(file);
  if (*text == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  if (failed || n == 0 || n > PEM_MAX)
    return mo_fail(message, MO_ERR_INVALID, "%s: %s: %s", name, path,
                   failed   ? strerror(errno)
                   : n == 0 ? "the file is empty"
                            : "larger than 65536 bytes");
  return MO_OK;
}

int fleet_certificate_read(const struct settings *settings, struct fleet_certificate *pair,
                           struct mo_message *message)
{
  *pair = (struct fleet_certificate){NULL, NULL};
  if (settings->fleet_certificate == NULL || settings->fleet_key == NULL)
    return MO_OK;
  struct mo_message why = {{0}};
  int error =
      read_pem("fleet_certificate", settings->fleet_certificate, &pair->certificate, message);
  if (error == MO_OK)
    error = read_pem("fleet_key", settings->fleet_key, &pair->key, message);
  if (error == MO_OK &&
      (error = mo_http_check_certificate(pair->certificate, pair->key, &why)) != MO_OK)
    mo_fail(message, error, "fleet_certificate, fleet_key: %s", why.text);
  if (error != MO_OK)
    fleet_certificate_free(pair);
  return error;
}

void fleet_certificate_free(struct fleet_certificate *pair)
{
  if (pair->key != NULL)
    explicit_bzero(pair->key, PEM_MAX);
  free(pair->key);
  free(pair->certificate);
  *pair = (struct fleet_certificate){NULL, NULL};
}

uint32_t fleet_max_connections(const struct settings *settings)
{
  return settings->fleet_listen.n > 0 ? CONNECTIONS_MAX : 0;
}

int fleet_start(const struct settings *settings, struct sockets *sockets, struct mo_api *api,
                void (*log)(void *context, const struct mo_http_log_entry *entry),
                struct mo_message *message)
{
  struct tokens tokens;
  struct fleet_certificate pair;
  if (settings->fleet_listen.n == 0)
    return MO_OK;
  int error = fleet_certificate_read(settings, &pair, message);
  if (error != MO_OK)
    return error;
  error = tokens_read(settings->token_file, &tokens, message);
  if (error != MO_OK) {
    fleet_certificate_free(&pair);
    return error == MO_ERR_IO ? MO_ERR_INVALID : error;
  }
  const uint64_t memory = memory_limit_of(settings->max_memory) / 8;
  const struct mo_http_config config = {
      .listeners = sockets->fd,
      .n_listeners = sockets->n,
      .allowed_hosts = (const char *const *)settings->allowed_hosts.items,
      .n_allowed_hosts = settings->allowed_hosts.n,
      .tokens = tokens.items,
      .n_tokens = tokens.n_workers,
      .token_if_any = true,
      .certificate = pair.certificate,
      .key = pair.key,
      .max_connections = CONNECTIONS_MAX,
      .other_files = (uint32_t)settings->max_connections,
      .max_in_flight = CONNECTIONS_MAX, /* one address may have many workers */
      .max_queued = CONNECTIONS_MAX,
      .max_file_bytes = BODY_BYTES,
      .max_body_memory = memory < BODY_MEMORY ? memory : BODY_MEMORY,
      .header_timeout_ms = (uint32_t)settings->header_timeout_ms,
      .body_timeout_ms = BODY_TIMEOUT_MS,
      .idle_timeout_ms = (uint32_t)settings->idle_timeout_ms,
      .log = log,
  };
  error = mo_api_start_fleet(api, &config, message);
  sockets_hand_over(sockets);
  tokens_free(&tokens);
  fleet_certificate_free(&pair);
  if (error == MO_OK) {
    struct mo_http_stats stats;
    mo_http_get_stats(mo_api_fleet_http(api), &stats);
    if (stats.max_connections < CONNECTIONS_MAX)
      log_warning("the limit of open files allows fewer connections of workers: raise it "
                  "(LimitNOFILE=)",
                  LOG_INT("max_connections", CONNECTIONS_MAX),
                  LOG_INT("used", stats.max_connections));
  }
  return error;
}
