/* plot.h: a curve as text: braille dots where the locale has them (2 × 4 to a character), else
 * asterisks. */
#ifndef MORPHOCTL_PLOT_H
#define MORPHOCTL_PLOT_H

#include <stdbool.h>
#include <stddef.h>

struct plot_point {
  double x, y;
};

struct plot {
  const struct plot_point
      *curve; /* (n_curve) by ascending x; those whose y is not finite are gaps */
  size_t n_curve;
  const struct plot_point *marks; /* (n_marks) single points on top of it */
  size_t n_marks;
  double x_end;      /* the x axis goes from 0 to here */
  int width, height; /* of the whole, in characters; at least 24 × 4 is drawn */
  bool utf8, colour;
};

#define PLOT_MARK_UTF8  "◆"
#define PLOT_MARK_ASCII "o"

/* height lines, each ended by a newline: the curve beside its scale, the axis below (malloc; NULL:
 * out of memory). */
char *plot_draw(const struct plot *plot);

#endif
