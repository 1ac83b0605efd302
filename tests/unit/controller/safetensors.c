/* safetensors.c: controller files, valid and hostile. The hostile ones are a valid 1x1x1 file with
 * some text of its header replaced, and the message must describe the fault.
 * tests/fuzz/controller.c tests random damage. */
#include "../make.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <morpho/controller.h>

struct blob {
  uint8_t *bytes;
  size_t size;
};

static struct blob make_file(const struct mo_controller *c)
{
  struct blob blob = {NULL, 0};
  make_check(mo_controller_encode(c, &blob.bytes, &blob.size), "a file");
  check_keep(blob.bytes, free);
  return blob;
}

static struct blob good; /* re-created for each case */

static void make_good(void)
{
  struct mo_controller *c = make_controller((struct mo_workspace){1, 1, 1}, MO_SENSOR_INVERSE_SQRT);
  mo_controller_randomize(c, 3);
  good = make_file(c);
}

static uint64_t header_length(void)
{
  uint64_t n;
  memcpy(&n, good.bytes, 8);
  return n;
}

static char *make_header_text(void)
{
  char *text = make_zeros(header_length() + 1, 1);
  return memcpy(text, good.bytes + 8, header_length());
}

/* Makes a file with this header (its length is written, without padding) and the data of `good`,
 * plus `extra` bytes of data. */
static struct blob make_with_header(const char *header, uint64_t length, ptrdiff_t extra)
{
  const size_t from = 8 + header_length(), data = good.size - from;
  struct blob blob = {make_zeros(8 + length + data + (extra > 0 ? (size_t)extra : 0), 1),
                      (size_t)((ptrdiff_t)(8 + length + data) + extra)};
  memcpy(blob.bytes, &length, 8);
  memcpy(blob.bytes + 8, header, length);
  memcpy(blob.bytes + 8 + length, good.bytes + from, data);
  return blob;
}

/* Decodes; reports a wrong code or message. */
static void expect(const char *name, const struct blob *blob, int code, const char *says)
{
  struct mo_controller *c = NULL;
  struct mo_message message = {""};
  const int r = mo_controller_decode(blob->bytes, blob->size, &c, &message);
  if (r != code || (says != NULL && strstr(message.text, says) == NULL) || (r < 0 && c != NULL)) {
    check_failures++;
    printf("# %s: code %d (expected %d), message \"%s\" (expected \"%s\")\n", name, r, code,
           message.text, says ? says : "");
  }
  mo_controller_free(c);
}

struct edit {
  const char *name, *find, *replace, *says;
};

static const struct edit edits[] = {
    {"dtype", "\"F32\"", "\"F16\"", "tensor net.0.weight has dtype \"F16\"; expected \"F32\""},
    {"dtype is not text", "\"F32\"", "32", "tensor net.0.weight: expected {\"dtype\""},
    {"shape transposed", "[256,13]", "[13,256]",
     "tensor net.0.weight has shape [13, 256]; expected [256, 13] in a workspace of 1x1x1 voxels"},
    {"shape too short", "[256,13]", "[3328]", "shape [3328]; expected [256, 13]"},
    {"shape too long", "[256,13]", "[256,13,1]", "shape [256, 13, 1]; expected [256, 13]"},
    {"shape of hundreds", "[256,13]",
     "[256,13,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,"
     "1,1,1,1,1]",
     "tensor net.0.weight has shape [256, 13, 1,"},
    {"shape of a vector", "[24]", "[24,1]", "tensor net.9.bias has shape [24, 1]; expected [24]"},
    {"shape negative", "[256,13]", "[-256,-13]", "shape [-256, -13]"},
    {"shape fraction", "[256,13]", "[256.0,13]", "shape [?, 13]"},
    {"shape product overflows", "[256,13]", "[4294967296,4294967296]",
     "shape [4294967296, 4294967296]; expected [256, 13]"},
    {"shape beyond 64 bits", "[256,13]", "[18446744073709551616,13]", "not valid JSON: too big"},
    {"shape not an array", "[256,13]", "\"256,13\"", "tensor net.0.weight: expected {\"dtype\""},
    {"empty shape", "[256,13]", "[]", "has shape []; expected"},
    {"overlap", "[13312,14336]", "[0,1024]", "tensors overlap"},
    {"partial overlap", "[13312,14336]", "[13308,14332]",
     "tensor net.0.bias starts at byte 13308 of the data; expected 13312: tensors overlap"},
    {"beyond the end", "[13312,14336]", "[4000000,4001024]",
     "tensor net.0.bias ends at byte 4001024 of the data, which has"},
    {"begin after end", "[13312,14336]", "[14336,13312]",
     "tensor net.0.bias: data_offsets must be"},
    {"negative offset", "[13312,14336]", "[-1024,0]", "tensor net.0.bias: data_offsets must be"},
    {"offset near 2^63", "[13312,14336]", "[9223372036854774783,9223372036854775807]",
     "tensor net.0.bias ends at byte 9223372036854775807"},
    {"offset as fraction", "[13312,14336]", "[13312.0,14336.0]", "data_offsets must be"},
    {"one offset", "[13312,14336]", "[13312]", "data_offsets must be"},
    {"three offsets", "[13312,14336]", "[13312,14336,14336]", "data_offsets must be"},
    {"wrong span", "[13312,14336]", "[13312,14340]",
     "tensor net.0.bias spans 1028 bytes; expected 1024"},
    {"shifted onto the next", "[13312,14336]", "[14336,15360]",
     "tensor net.0.bias starts at byte 14336 of the data; expected 13312: there is a gap"},
    {"tensor renamed", "net.9.bias", "net.9.bios", "unexpected tensor \"net.9.bios\""},
    {"strange name", "net.9.bias", "n\\u001b[31m\xc3\xa4", "unexpected tensor \"n?[31m??\""},
    {"long name", "net.9.bias",
     "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa"
     "aaaaaaaaaaaaaaaaaa",
     "unexpected tensor \"aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa\""},
    {"tensor is null", "{\"dtype\":\"F32\",\"shape\":[24],", "{\"shape\":[24],",
     "tensor net.9.bias: expected {\"dtype\""},
    {"more fields", "\"shape\":[24],", "\"shape\":[24],\"stride\":[1],",
     "tensor net.9.bias: expected"},
    {"extra tensor", "\"net.9.bias\"",
     "\"net.10.bias\":{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]},\"net.9.bias\"",
     "unexpected tensor \"net.10.bias\""},
    {"tensor twice", "\"net.0.bias\"", "\"net.0.weight\"", "duplicate"},
    {"key twice in a tensor", "\"shape\":[24],", "\"shape\":[24],\"shape\":[24],", "duplicate"},
    {"metadata key twice",
     "\"mass_order\":", "\"sensor\":\"inverse_sqrt\",\"mass_order\":", "duplicate"},
    {"NUL in a value", "lexicographic", "lex\\u0000graphic", "not valid JSON"},
    {"NUL in a name", "net.9.bias", "net.9.bias\\u0000", "not valid JSON"},
    {"broken UTF-8", "lexicographic", "\xff\xfe", "not valid JSON"},
    {"lone surrogate", "lexicographic", "\\ud800", "not valid JSON"},
    {"1e400", "[24]", "[1e400]", "not valid JSON"},
    {"NaN literal", "[24]", "[NaN]", "not valid JSON"},
    {"trailing text", "}}", "}} x", "not valid JSON"},
    {"spring order", "lexicographic", "random",
     "metadata \"spring_order\" is \"random endpoint pairs\"; expected \"lexicographic endpoint "
     "pairs\""},
    {"mass order", "(x*2+y)", "(y*2+x)",
     "metadata \"mass_order\" is \"x-major lattice (y*2+x)*2+z\""},
    {"sensor", "\"inverse_sqrt\"", "\"inverse_cube\"",
     "metadata \"sensor\" is \"inverse_cube\"; expected \"inverse_sqrt\" or"},
    {"sensor is not text", "\"inverse_sqrt\"", "7", "metadata \"sensor\" is not a string"},
    {"metadata of lists", "\"1x1x1\"", "[1,1,1]", "metadata \"workspace\" is not a string"},
    {"workspace of two", "\"1x1x1\"", "\"1x1\"", "metadata \"workspace\" is \"1x1\""},
    {"workspace of four", "\"1x1x1\"", "\"1x1x1x1\"", "metadata \"workspace\""},
    {"workspace with zero", "\"1x1x1\"", "\"0x1x1\"", "metadata \"workspace\""},
    {"workspace with sign", "\"1x1x1\"", "\"+1x1x1\"", "metadata \"workspace\""},
    {"workspace with leading zero", "\"1x1x1\"", "\"01x1x1\"", "metadata \"workspace\""},
    {"workspace with space", "\"1x1x1\"", "\"1x1x1 \"", "metadata \"workspace\""},
    {"workspace empty", "\"1x1x1\"", "\"\"", "metadata \"workspace\""},
    {"workspace beyond 16 bits", "\"1x1x1\"", "\"65537x1x1\"", "metadata \"workspace\""},
    {"workspace wraps", "\"1x1x1\"", "\"4294967297x1x1\"", "metadata \"workspace\""},
    {"workspace of other shapes", "\"1x1x1\"", "\"1x2x1\"", "metadata \"mass_order\""},
    {"no workspace named", "\"workspace\":\"1x1x1\"", "\"note\":\"\"",
     "expected \"x-major lattice (x*7+y)*5+z\""},
};

static void expect_header(const char *name, const char *header, size_t n, int code,
                          const char *says)
{
  const struct blob bad = make_with_header(header, n, 0);
  expect(name, &bad, code, says);
  check_drop_from(bad.bytes);
}

/* The good header with one replacement. */
static void expect_edit(const struct edit *e, int code)
{
  const char *header = make_header_text(), *at = strstr(header, e->find);
  char *text = NULL;
  REQUIRE(at != NULL);
  const int n =
      asprintf(&text, "%.*s%s%s", (int)(at - header), header, e->replace, at + strlen(e->find));
  REQUIRE(n > 0);
  expect_header(e->name, text, (size_t)n, code, e->says);
  free(text);
}

static void hostile_headers(void)
{
  static const struct edit none = {"nothing changed", "\"F32\"", "\"F32\"", ""},
                           large = {"workspace too large", "\"1x1x1\"", "\"65535x65535x65535\"",
                                    "at most 1048576 in all"};
  make_good();
  for (size_t i = 0; i < COUNT(edits); i++)
    expect_edit(&edits[i], MO_ERR_FORMAT);
  expect_edit(&none, MO_OK);
  expect_edit(&large, MO_ERR_LIMIT);
}

static void not_an_object(void)
{
  static const char *const texts[] = {"", "[]", " {}", "\xef\xbb\xbf{}", "null", "\"{\"", "\n{}"};
  make_good();
  for (size_t i = 0; i < COUNT(texts); i++)
    expect_header(texts[i], texts[i], strlen(texts[i]), MO_ERR_FORMAT,
                  "its first byte must be '{'");
  expect_header("unfinished", "{", 1, MO_ERR_FORMAT, "not valid JSON");
  expect_header("empty object", "{}", 2, MO_ERR_FORMAT, "tensor net.0.weight is missing");
  expect_header("raw NUL", "{\0}", 3, MO_ERR_FORMAT, "not valid JSON");
  expect_header("metadata list", "{\"__metadata__\":[]}", 19, MO_ERR_FORMAT,
                "\"__metadata__\" is not an object");
}

static void depth_bombs(void)
{
  const size_t n = 1 << 20;
  char *text = make_zeros(n + 1, 1);
  make_good();
  memcpy(text, "{\"a\":", 5);
  memset(text + 5, '[', n - 5);
  expect_header("a million brackets", text, n, MO_ERR_FORMAT, "maximum parsing depth");
  expect_header("64 levels", text, 5 + 63, MO_ERR_FORMAT, "not valid JSON");
  for (size_t i = 5; i + 5 <= n; i += 5)
    memcpy(text + i, "{\"a\":", 5);
  expect_header("objects in objects", text, n - n % 5, MO_ERR_FORMAT, "maximum parsing depth");
  /* Brackets in strings are only text, even after escaped quotes. */
  const int used = snprintf(text, n, "{\"\\\"");
  memset(text + used, '[', 500);
  memcpy(text + used + 500, "\":1}", 5);
  expect_header("brackets in a text", text, (size_t)used + 504, MO_ERR_FORMAT,
                "unexpected tensor \"\"[[[");
}

static void truncations(void)
{
  make_good();
  const uint64_t header = header_length();
  CHECK_INT((8 + header) % 8, 0);
  /* Every truncation of the header, and some of the data. */
  for (size_t n = 0; n < good.size; n += n < 8 + header + 64 ? 1 : 4099) {
    struct mo_controller *c = NULL;
    struct mo_message message = {""};
    uint8_t *part = malloc(n > 0 ? n : 1); /* long enough that ASan notices a read beyond its end */
    REQUIRE(part != NULL);
    memcpy(part, good.bytes, n);
    CHECK_INT(mo_controller_decode(part, n, &c, &message), MO_ERR_FORMAT);
    CHECK(message.text[0] != '\0' && c == NULL);
    free(part);
  }
  const struct {
    uint64_t claim;
    int code;
  } claims[] = {{UINT64_MAX, MO_ERR_LIMIT},     {UINT64_C(1) << 63, MO_ERR_LIMIT},
                {UINT64_MAX - 7, MO_ERR_LIMIT}, {(1 << 20) + 1, MO_ERR_LIMIT},
                {1 << 20, MO_ERR_FORMAT},       {good.size - 7, MO_ERR_FORMAT},
                {good.size - 8, MO_ERR_FORMAT}, {0, MO_ERR_FORMAT},
                {header - 8, MO_ERR_FORMAT},    {header + 8, MO_ERR_FORMAT}};
  for (size_t i = 0; i < COUNT(claims); i++) {
    memcpy(good.bytes, &claims[i].claim, 8);
    expect("header length", &good, claims[i].code, NULL);
  }
}

static void gaps(void)
{
  make_good();
  char *text = make_header_text(), *at = strstr(text, "\"net.9.bias\""), *gap = NULL;
  const struct blob longer = make_with_header(text, strlen(text), 4),
                    shorter = make_with_header(text, strlen(text), -1);
  expect("more data", &longer, MO_ERR_FORMAT, "the tensors end at byte");
  expect("less data", &shorter, MO_ERR_FORMAT, "tensor net.9.bias ends at byte");
  /* The last tensor is 4 bytes later. */
  REQUIRE(at != NULL);
  unsigned long begin = 0, end = 0;
  REQUIRE(sscanf(strstr(at, "data_offsets"), "data_offsets\":[%lu,%lu]", &begin, &end) == 2);
  REQUIRE(
      asprintf(&gap,
               "%.*s\"net.9.bias\":{\"dtype\":\"F32\",\"shape\":[24],\"data_offsets\":[%lu,%lu]}}",
               (int)(at - text), text, begin + 4, end + 4) > 0);
  const struct blob gapped = make_with_header(gap, strlen(gap), 4);
  expect("gap", &gapped, MO_ERR_FORMAT, "there is a gap between tensors");
  free(gap);
  /* Without the last tensor. */
  memcpy(at - 1, "}", 2);
  expect_header("missing", text, strlen(text), MO_ERR_FORMAT, "tensor net.9.bias is missing");
}

/* Makes metadata of `entries` empty entries and one with `long_bytes` bytes, along with the
 * workspace. */
static void expect_metadata(const char *rest, int entries, int long_bytes, int code,
                            const char *says)
{
  char *text = NULL;
  size_t n = 0;
  FILE *out = open_memstream(&text, &n);
  REQUIRE(out != NULL);
  fprintf(out, "{\"__metadata__\":{\"workspace\":\"1x1x1\"");
  for (int i = 0; i < entries; i++)
    fprintf(out, ",\"%d\":\"\"", i);
  if (long_bytes > 0)
    fprintf(out, ",\"long\":\"%0*d\"", long_bytes, 0);
  fprintf(out, "}%s", rest);
  fclose(out);
  expect_header("metadata", text, n, code, says);
  free(text);
}

static void many_metadata(void)
{
  make_good();
  const char *rest = strstr(make_header_text(), "},");
  REQUIRE(rest != NULL);
  expect_metadata(rest + 1, 1019, 0, MO_OK, "");
  expect_metadata(rest + 1, 1020, 0, MO_ERR_LIMIT, "has 1021 entries; at most 1020");
  expect_metadata(rest + 1, 0, 65536, MO_OK, "");
  expect_metadata(rest + 1, 0, 65537, MO_ERR_LIMIT, "metadata \"long\" is longer");
}

static void values_not_finite(void)
{
  struct mo_controller *c = make_controller((struct mo_workspace){1, 1, 1}, MO_SENSOR_INVERSE_SQRT);
  const float bad[] = {NAN, -NAN, INFINITY, -INFINITY, 1.1e6f, -1e20f};
  float *const places[] = {&c->weight[0][0], &c->norm_gain[1][7], &c->bias[3][23]};
  const char *const names[] = {"tensor net.0.weight: value 0 is", "tensor net.4.weight: value 7 is",
                               "tensor net.9.bias: value 23 is"};
  for (int p = 0; p < 3; p++)
    for (int k = 0; k < 6; k++) {
      const float before = *places[p];
      *places[p] = bad[k];
      const struct blob blob = make_file(c);
      expect("not finite or too large", &blob, MO_ERR_FORMAT, names[p]);
      *places[p] = before;
    }
}

static void round_trip(void)
{
  struct mo_controller *b = NULL;
  struct mo_message message = {""};
  struct mo_controller *a =
      make_controller((struct mo_workspace){2, 1, 3}, MO_SENSOR_INVERSE_SQUARE);
  mo_controller_randomize(a, 9);
  CHECK_INT(
      mo_controller_set_metadata(a, "note", "\"quotes\" \\ \b\f\n\r\t \x01\x1f\x7f / \xc2\xb5"),
      MO_OK);
  const struct blob first = make_file(a);
  REQUIRE(mo_controller_decode(first.bytes, first.size, &b, &message) == MO_OK);
  CHECK_INT(b->n_parameters, a->n_parameters);
  CHECK(SAME(a->parameters, b->parameters, a->n_parameters));
  CHECK_INT(b->sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_INT(b->workspace.nz, 3);
  CHECK_INT(b->n_metadata, a->n_metadata);
  for (size_t i = 0; i < a->n_metadata; i++) {
    CHECK_TEXT(b->metadata[i].key, a->metadata[i].key);
    CHECK_TEXT(b->metadata[i].value, a->metadata[i].value);
  }
  const struct blob second = make_file(b);
  CHECK(first.size == second.size && SAME(first.bytes, second.bytes, first.size));
  mo_controller_free(b);
}

static struct blob make_read(const char *relative)
{
  const char *path = make_source_path(relative);
  FILE *file = fopen(path, "rb");
  make_check(file != NULL ? MO_OK : MO_ERR_NOT_FOUND, path);
  fseek(file, 0, SEEK_END);
  struct blob blob = {make_zeros((size_t)ftell(file), 1), (size_t)ftell(file)};
  rewind(file);
  make_check(fread(blob.bytes, 1, blob.size, file) == blob.size ? MO_OK : MO_ERR_IO, path);
  fclose(file);
  return blob;
}

/* The header was written by the safetensors package, with other orders of tensors in header and
 * data. */
static void from_package(void)
{
  const struct blob header = make_read("tests/golden/safetensors-package-1x1x1.header");
  const size_t n = 256 * 13 + 2 * 65536 + 24 * 256 + 24 + 9 * 256;
  const struct blob file = {make_zeros(header.size + n * 4, 1), header.size + n * 4};
  memcpy(file.bytes, header.bytes, header.size);
  for (size_t i = 0; i < n; i++) {
    const float value = (float)i;
    memcpy(file.bytes + header.size + 4 * i, &value, 4);
  }
  struct mo_controller *c = NULL;
  struct mo_message message = {""};
  CHECK_INT(mo_controller_decode(file.bytes, file.size, &c, &message), MO_OK);
  CHECK_TEXT(message.text, "");
  REQUIRE(c != NULL);
  CHECK_NEAR((double)c->bias[0][0], 0, 0); /* sorted by name: net.0.bias comes first */
  CHECK_NEAR((double)c->weight[0][0], 256, 0);
  CHECK_NEAR((double)c->weight[0][13 * 256 - 1], 256 + 13 * 256 - 1, 0);
  CHECK_NEAR((double)c->norm_shift[0][0], 14 * 256, 0);
  CHECK_NEAR((double)c->weight[3][24 * 256 - 1], (double)n - 1, 0);
  CHECK_INT(c->sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_TEXT(mo_controller_get_metadata(c, "note"),
             "quotes \" and \\ and \xc2\xb5 and \xe8\xaa\x9e");
  mo_controller_free(c);
}

static void bootstrap(void)
{
  const struct mo_controller *c = make_shipped_controller("bootstrap");
  CHECK_INT(c->n_parameters, 620912);
  CHECK_TEXT(mo_controller_get_metadata(c, "sensor"), "inverse_sqrt");
  /* Our writer produces the same bytes as the program that trained this controller. */
  const struct blob ours = make_file(c),
                    theirs = make_read("data/controllers/bootstrap.safetensors");
  CHECK(ours.size == theirs.size && SAME(ours.bytes, theirs.bytes, ours.size));
}

static void read_faults(void)
{
  char folder[] = "/tmp/morpho-controller-XXXXXX";
  struct mo_controller *c = NULL;
  struct mo_message message = {""};
  char path[64];
  REQUIRE(mkdtemp(folder) != NULL);
  snprintf(path, sizeof(path), "%s/absent", folder);
  CHECK_INT(mo_controller_read(path, &c, &message), MO_ERR_NOT_FOUND);
  CHECK_SAYS(message, "No such file");
  CHECK_INT(mo_controller_read(folder, &c, &message), MO_ERR_IO);
  CHECK_TEXT(message.text, "not a regular file");
  snprintf(path, sizeof(path), "%s/pipe", folder);
  REQUIRE(mkfifo(path, 0600) == 0);
  /* Fails at once, although the pipe has no writer. */
  CHECK_INT(mo_controller_read(path, &c, &message), MO_ERR_IO);
  unlink(path);
  snprintf(path, sizeof(path), "%s/short", folder);
  const int fd = open(path, O_CREAT | O_WRONLY | O_CLOEXEC, 0600);
  REQUIRE(fd >= 0);
  CHECK_INT(mo_controller_read(path, &c, &message), MO_ERR_FORMAT);
  CHECK_INT(write(fd, "\x02\0\0\0\0\0\0\0{}", 10), 10);
  CHECK_INT(mo_controller_read(path, &c, &message), MO_ERR_FORMAT);
  CHECK_TEXT(message.text, "tensor net.0.weight is missing");
  /* A sparse file beyond the limit. */
  if (ftruncate(fd, (off_t)MO_CONTROLLER_FILE_MAX + 1) == 0)
    CHECK_INT(mo_controller_read(path, &c, &message), MO_ERR_LIMIT);
  close(fd);
  unlink(path);
  rmdir(folder);
  CHECK(c == NULL);
}

static void header_overflow(void)
{
  struct mo_controller *c = make_controller((struct mo_workspace){1, 1, 1}, MO_SENSOR_INVERSE_SQRT);
  char *text = make_zeros(65537, 1), key[8];
  memset(text, 'a', 65536);
  for (int i = 0; i < 16; i++) {
    snprintf(key, sizeof(key), "k%d", i);
    CHECK_INT(mo_controller_set_metadata(c, key, text), MO_OK);
  }
  struct blob blob = {NULL, 0};
  CHECK_INT(mo_controller_encode(c, &blob.bytes, &blob.size), MO_ERR_LIMIT);
  CHECK(blob.bytes == NULL);
}

static const struct check_case cases[] = {
    {"round trip", round_trip},
    {"the bootstrap controller", bootstrap},
    {"a header of the safetensors package", from_package},
    {"hostile headers", hostile_headers},
    {"headers that are not objects", not_an_object},
    {"depth bombs", depth_bombs},
    {"truncations and lengths", truncations},
    {"gaps", gaps},
    {"much metadata", many_metadata},
    {"values that are not finite or too large", values_not_finite},
    {"files that cannot be read", read_faults},
    {"a header too long to write", header_overflow}};
CHECK_MAIN(cases)
