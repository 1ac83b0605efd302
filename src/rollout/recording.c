/* recording.c: the arrays of a recording. Code that allocates, stores or sends recordings iterates
 * over the channels with these functions; the simulations fill the arrays by name. */
#include <morpho/rollout.h>

#include <stdlib.h>

const char *const mo_channel_words[] = {"com", "masses", "actuation", "contacts", NULL};

uint32_t mo_recording_frames(const struct mo_physics *physics, uint32_t stride)
{
  return stride > 0 ? physics->scheme.n_steps / stride + 1 : 0;
}

uint32_t mo_channel_numbers(enum mo_channel channel, uint32_t n_masses, uint32_t n_springs)
{
  switch (channel) {
  case MO_RECORD_COM: return 3;
  case MO_RECORD_MASSES: return 3 * n_masses;
  case MO_RECORD_ACTUATION: return n_springs;
  case MO_RECORD_CONTACTS: return n_masses;
  }
  return 0;
}

uint32_t mo_channel_width(enum mo_channel channel)
{
  return channel == MO_RECORD_COM      ? sizeof(double)
         : channel == MO_RECORD_MASSES ? sizeof(float)
                                       : sizeof(uint8_t);
}

uint64_t mo_recording_frame_bytes(unsigned channels, uint32_t n_masses, uint32_t n_springs)
{
  uint64_t bytes = 0;
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS; channel <<= 1)
    if (channels & channel)
      bytes += (uint64_t)mo_channel_width((enum mo_channel)channel) *
               mo_channel_numbers((enum mo_channel)channel, n_masses, n_springs);
  return bytes;
}

void *mo_recording_array(const struct mo_recording *recording, enum mo_channel channel)
{
  switch (channel) {
  case MO_RECORD_COM: return recording->com_m;
  case MO_RECORD_MASSES: return recording->mass_m;
  case MO_RECORD_ACTUATION: return recording->actuation;
  case MO_RECORD_CONTACTS: return recording->contacts;
  }
  return NULL;
}

static void *zeros(unsigned channels, enum mo_channel channel, size_t frames, uint32_t n_masses,
                   uint32_t n_springs, bool *failed)
{
  if (!(channels & channel))
    return NULL;
  void *made =
      calloc(frames * mo_channel_numbers(channel, n_masses, n_springs), mo_channel_width(channel));
  *failed |= made == NULL;
  return made;
}

int mo_recording_create(struct mo_recording *recording, unsigned channels, uint32_t stride,
                        uint32_t frames, uint32_t n_masses, uint32_t n_springs)
{
  bool failed = false;
  *recording = (struct mo_recording){
      stride, zeros(channels, MO_RECORD_COM, frames, n_masses, n_springs, &failed),
      zeros(channels, MO_RECORD_MASSES, frames, n_masses, n_springs, &failed),
      zeros(channels, MO_RECORD_ACTUATION, frames, n_masses, n_springs, &failed),
      zeros(channels, MO_RECORD_CONTACTS, frames, n_masses, n_springs, &failed)};
  if (failed)
    mo_recording_free(recording);
  return failed ? MO_ERR_NO_MEMORY : MO_OK;
}

void mo_recording_free(struct mo_recording *recording)
{
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS; channel <<= 1)
    free(mo_recording_array(recording, (enum mo_channel)channel));
  *recording = (struct mo_recording){.stride = recording->stride};
}
