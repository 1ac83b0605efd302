/* last_reply.c: replies that bypass libmicrohttpd and end their connection.
 *
 * The library cannot reply in the middle of a body. To requests that it cannot parse, it replies by
 * itself: in HTML, after some errors with two headers, and not at all when the connection's memory
 * is used up. In these cases, the reply is written directly to the socket. The socket is then shut
 * down for writing, which discards anything that the library still wants to send.
 *
 * The library sends its own pages with MHD_queue_response. The definition in this file replaces
 * that function in the whole program, the library included. Our own replies reach the library's
 * function through mo_queue_response (reply.c). */
#include "http/server.h"

static enum MHD_Result write_header(void *context, enum MHD_ValueKind kind, const char *name,
                                    const char *value)
{
  (void)kind;
  mo_text_format(context, "%s: %s\r\n", name, value);
  return MHD_YES;
}

void mo_reply_last(struct mo_request *request)
{
  struct mo_reply *reply = &request->reply;
  struct mo_text text = {0};
  struct MHD_Response *headers =
      MHD_create_response_from_buffer(0, (void *)"", MHD_RESPMEM_PERSISTENT);
  mo_request_drop_body(request);
  reply->close = true;
  mo_text_format(&text, "HTTP/1.1 %u %s\r\nContent-Length: %zu\r\n", reply->status,
                 MHD_get_reason_phrase_for(reply->status), reply->size);
  if (headers != NULL && mo_reply_headers(request, headers)) {
    MHD_get_response_headers(headers, write_header, &text);
    mo_text_add(&text, "\r\n");
    if (request->method != MO_HEAD)
      mo_text_bytes(&text, reply->body != NULL ? reply->body : reply->fixed, reply->size);
    if (!text.failed && mo_connection_write_last(request, text.data, text.size)) {
      request->sent = request->method != MO_HEAD ? reply->size : 0;
      request->answered = true;
    }
  }
  MHD_destroy_response(headers);
  mo_text_free(&text);
  shutdown(request->connection->fd, SHUT_WR);
  request->connection->lingers = true;
}

static void refuse_unparsed(struct mo_connection *connection, struct MHD_Connection *mhd,
                            unsigned status)
{
  static const struct {
    unsigned status;
    const char *detail;
  } refusals[] = {
      {400, "This is not valid HTTP: a malformed request line, header field, length or chunk, "
            "or no Host."},
      {413, "The length of the body, or of one of its chunks, is too large."},
      {414, "The request line is too long; " MO_HEADER_WORDS},
      {431, "The header is too large; " MO_HEADER_WORDS},
      {505, "This service supports only HTTP/1.0 and HTTP/1.1."},
      /* The library uses 500 for a line of a chunk that its memory cannot hold. */
      {0, "The request cannot be read."}};
  struct mo_request *request = connection->request;
  if (request == NULL && (request = mo_request_begin(connection, mhd, "")) == NULL)
    return;
  size_t i = 0;
  while (refusals[i].status != status && refusals[i].status != 0)
    i++;
  mo_reply_problem(request, refusals[i].status != 0 ? status : 400, NULL, "%s", refusals[i].detail);
  mo_reply_last(request);
}

__attribute__((visibility("default"))) enum MHD_Result
MHD_queue_response(struct MHD_Connection *mhd, unsigned status, struct MHD_Response *response)
{
  const union MHD_ConnectionInfo *info =
      MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_SOCKET_CONTEXT);
  struct mo_connection *connection = info != NULL ? info->socket_context : NULL;
  if (connection != NULL)
    refuse_unparsed(connection, mhd, status);
  info = MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_CONNECTION_FD);
  if (info != NULL)
    shutdown(info->connect_fd, SHUT_WR);
  /* Let the library queue its page and end the connection, because not all of its code can handle a
   * failure here. */
  return mo_queue_response(mhd, status, response);
}
