/* fleet_request.c: the bodies that workers, and operators about workers, send. */
#include "api/fleet.h"

#include <string.h>

#include "api/requests.h"

_Static_assert(MO_ORIGIN_BYTES == 2 * MO_FLEET_NAME_BYTES + 2, "a name, @, a host");

/* Reads printable ASCII of 1 to `most` bytes. */
static void read_ascii(struct mo_json *json, char *value, size_t most)
{
  const unsigned depth = json->depth;
  struct mo_json_slice text;
  if (!mo_json_string(json, &text))
    return;
  bool is_good = text.size >= 1 && text.size <= most;
  for (size_t i = 0; i < text.size && is_good; i++)
    is_good = text.bytes[i] >= ' ' && text.bytes[i] <= '~';
  if (is_good) {
    memcpy(value, text.bytes, text.size);
    value[text.size] = '\0';
  } else {
    mo_json_fault_at(json, depth, "", "1 to %zu printable ASCII characters are expected", most);
  }
}

static void read_name(struct mo_json *json, void *value)
{
  read_ascii(json, value, MO_FLEET_NAME_BYTES);
}

static void read_version(struct mo_json *json, void *value)
{
  read_ascii(json, value, sizeof(((struct mo_fleet_offer *)NULL)->version) - 1);
}

/* A class stands in events, as it is. */
static void read_class(struct mo_json *json, void *value)
{
  const unsigned depth = json->depth;
  char *class = value;
  read_ascii(json, class, sizeof(((struct mo_fleet_offer *)NULL)->classes[0].scores) - 1);
  if (strpbrk(class, "\"\\") != NULL)
    mo_json_fault_at(json, depth, "", "a class has no quotation mark and no backslash");
}

static void read_hash(struct mo_json *json, void *value)
{
  const unsigned depth = json->depth;
  struct mo_json_slice digits;
  if (mo_json_string(json, &digits) &&
      mo_sha256_from_hex(digits.bytes, digits.size, value) != MO_OK)
    mo_json_fault_at(json, depth, "", "64 hexadecimal digits are expected");
}

static void read_why(struct mo_json *json, void *value)
{
  read_ascii(json, value, MO_WHY_BYTES);
}

static void read_origin(struct mo_json *json, void *value)
{
  read_ascii(json, value, sizeof(((struct mo_parsed_verification *)NULL)->origin) - 1);
}

/* Reads "G-C", what the reply to the page before had as `next`. */
static void read_place(struct mo_json *json, void *value)
{
  const unsigned depth = json->depth;
  struct mo_origin_place place;
  struct mo_json_slice text;
  if (!mo_json_string(json, &text))
    return;
  const char *dash = memchr(text.bytes, '-', text.size);
  const size_t n = dash != NULL ? (size_t)(dash - text.bytes) : 0;
  if (dash != NULL && mo_decimal(text.bytes, n, 1, INT64_MAX, &place.genotype) &&
      mo_decimal(dash + 1, text.size - n - 1, 1, INT64_MAX, &place.condition))
    *(struct mo_origin_place *)value = place;
  else
    mo_json_fault_at(json, depth, "", "the `next` of an earlier reply is expected");
}

static const struct mo_field_own name = {.read = read_name}, version = {.read = read_version},
                                 class_name = {.read = read_class}, hash = {.read = read_hash},
                                 why_text = {.read = read_why}, origin_text = {.read = read_origin},
                                 origin_place = {.read = read_place};

#define AT(member)    offsetof(struct mo_parsed_offer, member)
#define CLASS(member) (AT(offer.classes[0].member) - AT(offer.classes[0]))
static const struct mo_field class_rows[] = {
    {"scores", MO_FIELD_OWN, 0, CLASS(scores), .own = &class_name},
    {"gradients", MO_FIELD_OWN, 0, CLASS(gradients), .own = &class_name},
    {"canary", MO_FIELD_OWN, 0, CLASS(canary), .own = &hash},
};
static const struct mo_fields class_fields = MO_FIELDS(class_rows);
static const struct mo_field classes_rows[] = {
    {"cpu", MO_FIELD_GROUP, 0, AT(offer.classes[MO_ON_CPU]), .group = &class_fields},
    {"device", MO_FIELD_GROUP, 0, AT(offer.classes[MO_ON_DEVICE]), .group = &class_fields},
};
static const struct mo_fields classes_fields = MO_FIELDS(classes_rows);
static const struct mo_field offer_rows[] = {
    {"protocol", MO_FIELD_COUNT, 0, AT(protocol), .min = 0, .max = UINT32_MAX, .unit = ""},
    {"name", MO_FIELD_OWN, 0, AT(offer.name), .own = &name},
    {"host", MO_FIELD_OWN, 0, AT(offer.host), .own = &name},
    {"version", MO_FIELD_OWN, 0, AT(offer.version), .own = &version},
    {"n_threads", MO_FIELD_COUNT, 0, AT(offer.n_threads), .min = 0, .max = 65536, .unit = ""},
    {"n_devices", MO_FIELD_COUNT, 0, AT(offer.n_devices), .min = 0, .max = 1024, .unit = ""},
    {"classes", MO_FIELD_GROUP, 0, 0, .group = &classes_fields},
};
static const struct mo_fields offer_fields = MO_FIELDS(offer_rows);
#undef CLASS
#undef AT

static int check_offer(struct mo_json *json, void *any)
{
  const struct mo_fleet_offer *offer = &((struct mo_parsed_offer *)any)->offer;
  static const char *const places[] = {"/classes/cpu", "/classes/device"};
  if (json->faults->n > 0)
    return MO_OK;
  if (offer->name[0] == '\0' || offer->host[0] == '\0' || offer->version[0] == '\0')
    mo_json_fault_at(json, 0, "", "protocol, name, host, version and classes are expected");
  bool serves = false;
  for (size_t i = 0; i < 2; i++) {
    const bool scores = offer->classes[i].scores[0] != '\0';
    serves |= scores;
    if (scores != (offer->classes[i].gradients[0] != '\0'))
      mo_json_fault_at(json, 0, places[i], "scores, gradients and canary are expected");
  }
  if (!serves)
    mo_json_fault_at(json, 0, "/classes", "at least one of cpu and device is expected");
  return MO_OK;
}

int mo_offer_parse(const char *text, size_t size, struct mo_parsed_offer *parsed,
                   struct mo_faults *faults)
{
  static const struct mo_fields protocol = {offer_rows, 1};
  *parsed = (struct mo_parsed_offer){.protocol = MO_FLEET_PROTOCOL};
  mo_read_words(text, size, &protocol, parsed, NULL);
  return parsed->protocol != MO_FLEET_PROTOCOL
             ? MO_OK
             : mo_read_body(text, size, &offer_fields, parsed, NULL, check_offer, faults);
}

int mo_quarantine_parse(const char *text, size_t size, char *why, struct mo_faults *faults)
{
  static const struct mo_field rows[] = {{"why", MO_FIELD_OWN, .own = &why_text}};
  static const struct mo_fields fields = MO_FIELDS(rows);
  memcpy(why, "by an operator", sizeof("by an operator"));
  return mo_read_body(text, size, &fields, why, NULL, NULL, faults);
}

#define AT(member) offsetof(struct mo_parsed_verification, member)
static const struct mo_field verification_rows[] = {
    {"origin", MO_FIELD_OWN, 0, AT(origin), .own = &origin_text},
    {"after", MO_FIELD_OWN, 0, AT(after), .own = &origin_place},
    {"limit", MO_FIELD_COUNT, 0, AT(limit), .min = 1, .max = MO_VERIFIED_MAX, .unit = ""},
    {"repair", MO_FIELD_FLAG, 0, AT(repair)},
};
#undef AT

static int check_verification(struct mo_json *json, void *any)
{
  const struct mo_parsed_verification *parsed = any;
  if (json->faults->n == 0 && parsed->origin[0] == '\0')
    mo_json_fault_at(json, 0, "", "origin is expected");
  return MO_OK;
}

int mo_verification_parse(const char *text, size_t size, struct mo_parsed_verification *parsed,
                          struct mo_faults *faults)
{
  static const struct mo_fields fields = MO_FIELDS(verification_rows);
  *parsed = (struct mo_parsed_verification){.limit = MO_VERIFIED_DEFAULT};
  return mo_read_body(text, size, &fields, parsed, NULL, check_verification, faults);
}
