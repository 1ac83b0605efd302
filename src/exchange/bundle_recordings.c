/* bundle_recordings.c: the arrays of recordings in a bundle: the next one, its name, and its bytes
 * in NumPy's file format. Writing and reading follow the same order. */
#include <stdio.h>
#include <string.h>

#include "exchange/bundle.h"
#include "exchange/values.h"

void mo_bundle_recordings_name(const struct mo_bundle_recordings *recordings,
                               char name[MO_ARCHIVE_NAME_BYTES])
{
  if (recordings->channel == 0)
    snprintf(name, MO_ARCHIVE_NAME_BYTES, "recordings/%08u/evaluation.json", recordings->n);
  else
    snprintf(name, MO_ARCHIVE_NAME_BYTES, "recordings/%08u/%05u-%02u-%s.npy", recordings->n - 1,
             recordings->place, recordings->environment,
             mo_channel_words[__builtin_ctz(recordings->channel)]);
}

void mo_bundle_recordings_begin(struct mo_bundle_recordings *recordings,
                                const struct mo_physics *physics)
{
  const unsigned channels = recordings->evaluation.record;
  recordings->n++;
  recordings->frames = mo_recording_frames(physics, recordings->evaluation.stride);
  recordings->place = recordings->environment = 0;
  recordings->channel = channels & -channels;
}

int mo_bundle_recordings_next(struct mo_bundle_recordings *recordings)
{
  const struct mo_imported_evaluation *evaluation = &recordings->evaluation;
  const unsigned channels = evaluation->record;
  const unsigned later = channels & ~(2 * recordings->channel - 1);
  recordings->channel = later & -later;
  if (recordings->channel != 0)
    return 0;
  if (++recordings->environment == evaluation->n_environments) {
    recordings->environment = 0;
    recordings->place++;
  }
  recordings->channel = recordings->place < evaluation->n_designs ? channels & -channels : 0;
  return 1;
}

/* Writes the header of the array. Returns the number of bytes that follow it. */
static size_t write_header(struct mo_text *text, const struct mo_bundle_recordings *recordings)
{
  const struct mo_trajectory_sides sides = {.frames = recordings->frames,
                                            .masses = recordings->n_masses,
                                            .springs = recordings->n_springs};
  mo_recording_header(text, (enum mo_channel)recordings->channel, "", &sides);
  return sides.frames * mo_recording_frame_bytes(recordings->channel, sides.masses, sides.springs);
}

int mo_bundle_write_array(struct mo_text *text, const struct mo_bundle_recordings *recordings,
                          const struct mo_recording *recording)
{
  const void *numbers = mo_recording_array(recording, (enum mo_channel)recordings->channel);
  const size_t size = write_header(text, recordings);
  if (numbers == NULL)
    return MO_ERR_CORRUPT;
  mo_text_bytes(text, numbers, size);
  return MO_OK;
}

int mo_bundle_read_array(struct mo_bundle_recordings *recordings, const char *bytes, size_t size)
{
  struct mo_text header = {0};
  const size_t expected = write_header(&header, recordings);
  int error = header.failed ? MO_ERR_NO_MEMORY
              : size != MO_NPY_HEADER + expected || memcmp(header.data, bytes, MO_NPY_HEADER) != 0
                  ? MO_ERR_FORMAT
                  : MO_OK;
  mo_text_free(&header);
  if (error == MO_OK && recordings->recording.stride == 0)
    error = mo_recording_create(&recordings->recording, recordings->evaluation.record,
                                recordings->evaluation.stride, recordings->frames,
                                recordings->n_masses, recordings->n_springs);
  if (error == MO_OK)
    memcpy(mo_recording_array(&recordings->recording, (enum mo_channel)recordings->channel),
           bytes + MO_NPY_HEADER, expected);
  return error;
}
