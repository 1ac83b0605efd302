/* raster.h: draws robots on their terrain into an array of pixels, without a display or a graphics
 * processor, and encodes it. The picture looks like the dashboard's stage. */
#ifndef MORPHOCTL_FILM_RASTER_H
#define MORPHOCTL_FILM_RASTER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "scene.h"

#define RASTER_SIDE_MAX 4096 /* pixels */

/* The position of the camera: it circles around a point. */
struct raster_camera {
  double target_m[3];
  double yaw, pitch; /* radians; yaw 0 looks from the middle of the map toward the light */
  double distance_m;
};

struct raster;

/* Allocates the buffers of a picture of the given size in pixels, each side 16 … RASTER_SIDE_MAX,
 * drawn with 2 × 2 samples each (kept, ctl.h). */
struct raster *raster_create(uint32_t width, uint32_t height);

/* Draws a rollout at a time; after its end, the last frame. light: a bright background instead of a
 * dark one. rgb: (height, width, 3), written. */
void raster_draw(struct raster *raster, const struct scene *scene, uint32_t rollout, double time_s,
                 const struct raster_camera *camera, bool light, uint8_t *rgb);

/* Writes the background color. */
void raster_background(bool light, uint8_t rgb[3]);

/* Computes the mean position of a rollout's masses at a time, which a camera may follow. */
void raster_center(const struct scene *scene, uint32_t rollout, double time_s, double center_m[3]);

/* Encodes (height, width, 3) bytes as PNG; *size bytes, malloc. */
unsigned char *png_encode(const uint8_t *rgb, uint32_t width, uint32_t height, size_t *size);

#endif
