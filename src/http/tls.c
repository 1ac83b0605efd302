/* tls.c: the parts of TLS that libmicrohttpd, which does the encryption, does not cover. */
#include <gnutls/gnutls.h>
#include <string.h>

#include "http/server.h"

static gnutls_datum_t datum_of(const char *text)
{
  return (gnutls_datum_t){(unsigned char *)text, (unsigned)strlen(text)};
}

int mo_http_check_certificate(const char *certificate, const char *key, struct mo_message *message)
{
  const gnutls_datum_t chain = datum_of(certificate), secret = datum_of(key);
  gnutls_certificate_credentials_t credentials;
  if (gnutls_certificate_allocate_credentials(&credentials) != GNUTLS_E_SUCCESS)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory for the certificate");
  const int status =
      gnutls_certificate_set_x509_key_mem(credentials, &chain, &secret, GNUTLS_X509_FMT_PEM);
  gnutls_certificate_free_credentials(credentials);
  return status >= 0 ? MO_OK
                     : mo_fail(message, MO_ERR_INVALID, "invalid certificate or key: %s",
                               gnutls_strerror(status));
}

bool mo_connection_write_last(struct mo_request *request, const char *bytes, size_t n)
{
  if (!request->http->is_tls)
    return send(request->connection->fd, bytes, n, MSG_NOSIGNAL | MSG_DONTWAIT) > 0;
  const union MHD_ConnectionInfo *info =
      MHD_get_connection_info(request->mhd, MHD_CONNECTION_INFO_GNUTLS_SESSION);
  if (info == NULL || info->tls_session == NULL)
    return false;
  gnutls_session_t session = info->tls_session;
  const bool written = gnutls_record_send(session, bytes, n) > 0;
  gnutls_bye(session, GNUTLS_SHUT_WR);
  return written;
}
