/* wire_codec.h: what the encoders and decoders of messages have in common.
 *
 * An encoder computes the size first and then writes. A decoder checks every count before it
 * allocates, and reads nothing beyond the message. */
#ifndef MORPHO_FLEET_WIRE_CODEC_H
#define MORPHO_FLEET_WIRE_CODEC_H

#include "fleet/wire.h"

#include <stdlib.h>
#include <string.h>

#include "base/fields.h"

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "messages are little-endian");

struct header {
  char magic[8];
  uint32_t version, items;
  uint64_t bytes;
};
_Static_assert(sizeof(struct header) == 24, "without padding");

enum wire_kind { WIRE_LEASES, WIRE_RESULTS };

struct codec {
  uint8_t *to; /* the write position */
  const uint8_t *from;
  size_t at, size; /* size of the whole message */
};

static inline void put(struct codec *codec, const void *value, size_t size)
{
  memcpy(codec->to + codec->at, value, size);
  codec->at += size;
}

/* Returns false if fewer bytes are left. */
static inline bool get(struct codec *codec, void *value, size_t size)
{
  if (size > codec->size - codec->at)
    return false;
  memcpy(value, codec->from + codec->at, size);
  codec->at += size;
  return true;
}

static inline void put_packed(struct codec *codec, const struct mo_fields *fields, unsigned version,
                              const void *settings)
{
  mo_fields_pack(fields, version, settings, codec->to + codec->at);
  codec->at += mo_fields_packed_bytes(fields, version);
}

static inline const char *wire_magic(enum wire_kind kind)
{
  return kind == WIRE_LEASES ? "MOFLEETL" : "MOFLEETR";
}

static inline int open_message(enum wire_kind kind, uint32_t items, struct codec *codec)
{
  struct header header = {.version = MO_WIRE_VERSION, .items = items, .bytes = codec->size};
  memcpy(header.magic, wire_magic(kind), sizeof(header.magic));
  codec->to = malloc(codec->size);
  if (codec->to == NULL)
    return MO_ERR_NO_MEMORY;
  put(codec, &header, sizeof(header));
  return MO_OK;
}

static inline int read_header(enum wire_kind kind, uint32_t items_max, struct codec *codec,
                              uint32_t *items, struct mo_message *message)
{
  struct header header;
  if (!get(codec, &header, sizeof(header)))
    return mo_fail(message, MO_ERR_FORMAT, "a message must have at least %zu bytes, got %zu",
                   sizeof(header), codec->size);
  if (memcmp(header.magic, wire_magic(kind), sizeof(header.magic)) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "the message must begin with \"%s\"", wire_magic(kind));
  if (header.version != MO_WIRE_VERSION)
    return mo_fail(message, MO_ERR_UNSUPPORTED, "the message must have version %d, got %u",
                   MO_WIRE_VERSION, header.version);
  if (header.bytes != codec->size)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the header gives a size of %llu bytes, but the message has %zu",
                   (unsigned long long)header.bytes, codec->size);
  if (header.items > items_max)
    return mo_fail(message, MO_ERR_FORMAT, "a message may have at most %u items, got %u", items_max,
                   header.items);
  *items = header.items;
  return MO_OK;
}

static inline int read_end(const struct codec *codec, struct mo_message *message)
{
  if (codec->at == codec->size)
    return MO_OK;
  return mo_fail(message, MO_ERR_FORMAT, "%zu bytes of trailing data after the last item",
                 codec->size - codec->at);
}

static inline int cut_off(struct mo_message *message, const char *item, uint32_t i)
{
  return mo_fail(message, MO_ERR_FORMAT, "%s %u extends beyond the message", item, i);
}

#endif
