/* served.c: see served.h. */
#include "served.h"

#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

enum { FLAGS_MAX = 8 };

_Noreturn void bench_die(const char *what)
{
  fprintf(stderr, "morpho-bench: %s: %s\n", what, errno != 0 ? strerror(errno) : "failed");
  exit(1);
}

void bench_daemon_start(struct bench_daemon *daemon, const struct bench_options *options,
                        const char *const *flags)
{
  const char *program = options->morphod;
  char state[96], ports[96], defaults[4200], address[128] = "";
  snprintf(daemon->folder, sizeof(daemon->folder), "/tmp/morphod-bench-XXXXXX");
  if (mkdtemp(daemon->folder) == NULL)
    bench_die("a temporary folder");
  snprintf(state, sizeof(state), "--state-dir=%s/state", daemon->folder);
  snprintf(ports, sizeof(ports), "--port-file=%s/addresses", daemon->folder);
  snprintf(defaults, sizeof(defaults), "--default-controller=%s", options->controller);
  daemon->pid = fork();
  if (daemon->pid < 0)
    bench_die("fork");
  if (daemon->pid == 0) {
    int log = open("/dev/null", O_WRONLY);
    dup2(log, STDOUT_FILENO);
    dup2(log, STDERR_FILENO);
    const char *arguments[FLAGS_MAX + 8] = {
        program, state, ports, defaults, "--listen=127.0.0.1:0", "--log-level=error"};
    for (int i = 0; flags != NULL && i < FLAGS_MAX && flags[i] != NULL; i++)
      arguments[6 + i] = flags[i];
    execv(program, (char *const *)arguments);
    _exit(127);
  }
  const char *path = strchr(ports, '=') + 1;
  for (int i = 0; i < 1000 && strchr(address, '\n') == NULL; i++) {
    usleep(10000);
    FILE *file = fopen(path, "r");
    if (file == NULL)
      continue;
    if (fgets(address, sizeof(address), file) == NULL)
      address[0] = '\0';
    fclose(file);
  }
  const char *colon = strrchr(address, ':');
  if (colon == NULL) {
    fprintf(stderr, "morpho-bench: %s does not start\n", program);
    exit(1);
  }
  daemon->port = (uint16_t)strtoul(colon + 1, NULL, 10);
}

void bench_daemon_stop(const struct bench_daemon *daemon)
{
  char command[160];
  int status = 0;
  kill(daemon->pid, SIGTERM);
  waitpid(daemon->pid, &status, 0);
  snprintf(command, sizeof(command), "rm -rf '%s'", daemon->folder);
  if (system(command) !=
      0) /* NOLINT(cert-env33-c): a fixed command on a folder of our own making */
    fprintf(stderr, "morpho-bench: %s remains\n", daemon->folder);
  if (!WIFEXITED(status) || WEXITSTATUS(status) != 0)
    fprintf(stderr, "morpho-bench: morphod ended with status %d\n", status);
}

int bench_dial(const struct bench_daemon *daemon)
{
  struct sockaddr_in address = {
      .sin_family = AF_INET, .sin_port = htons(daemon->port), .sin_addr = {htonl(INADDR_LOOPBACK)}};
  int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0), one = 1;
  if (fd < 0 || connect(fd, (struct sockaddr *)&address, sizeof(address)) != 0)
    bench_die("connect");
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
  return fd;
}

void bench_send(int fd, const char *bytes, size_t n)
{
  while (n > 0) {
    ssize_t sent = send(fd, bytes, n, MSG_NOSIGNAL);
    if (sent < 0 && errno != EINTR)
      bench_die("send");
    if (sent > 0) {
      bytes += sent;
      n -= (size_t)sent;
    }
  }
}

size_t bench_reply_size(const char *text, size_t n)
{
  const char *end = memmem(text, n, "\r\n\r\n", 4);
  if (end == NULL)
    return 0;
  const char *length = memmem(text, (size_t)(end - text) + 2, "Content-Length: ", 16);
  return (size_t)(end - text) + 4 + (length != NULL ? strtoul(length + 16, NULL, 10) : 0);
}

int bench_ask(const struct bench_daemon *daemon, const char *method, const char *path,
              const char *headers, const char *body, size_t size, char **ret)
{
  char head[512];
  int fd = bench_dial(daemon);
  int n = snprintf(head, sizeof(head),
                   "%s %s HTTP/1.1\r\nHost: localhost\r\nContent-Type: "
                   "application/json\r\nContent-Length: %zu\r\n%s\r\n",
                   method, path, size, headers);
  bench_send(fd, head, (size_t)n);
  bench_send(fd, body, size);
  size_t got = 0, capacity = 65536, wanted = 0;
  char *text = malloc(capacity);
  while (text != NULL && (wanted == 0 || got < wanted)) {
    if (capacity - got < 2)
      text = realloc(text, capacity *= 2);
    if (text == NULL)
      break;
    ssize_t part = recv(fd, text + got, capacity - got - 1, 0);
    if (part <= 0)
      bench_die("recv");
    got += (size_t)part;
    text[got] = '\0';
    wanted = bench_reply_size(text, got);
  }
  close(fd);
  if (text == NULL)
    bench_die("memory");
  int status = (int)strtol(text + 9, NULL, 10);
  char *start = strstr(text, "\r\n\r\n") + 4;
  memmove(text, start, strlen(start) + 1);
  if (ret != NULL)
    *ret = text;
  else
    free(text);
  return status;
}

char *bench_request_of(struct mo_body_stream *stream, int n, const char *more, size_t *size)
{
  char *text = malloc((size_t)n * 170 + 256), digits[MO_DEFAULT_VOXELS + 1];
  uint64_t bits[MO_DEFAULT_WORDS];
  if (text == NULL)
    bench_die("memory");
  size_t at = (size_t)sprintf(text, "{\"designs\":[");
  for (int i = 0; i < n; i++) {
    bench_check(mo_body_stream_next(stream, bits, NULL), "a random body");
    mo_genotype_to_text(MO_DEFAULT_WORKSPACE, bits, digits);
    at += (size_t)sprintf(text + at, "%s{\"voxels\":\"%s\"}", i > 0 ? "," : "", digits);
  }
  at += (size_t)sprintf(text + at, "]%s}", more);
  *size = at;
  return text;
}
