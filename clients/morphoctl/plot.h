/* plot.h: draws a curve as text: with braille dots if the locale has them (2 × 4 per character),
 * else with asterisks. */
#ifndef MORPHOCTL_PLOT_H
#define MORPHOCTL_PLOT_H

#include <stdbool.h>
#include <stddef.h>

struct plot_point {
  double x, y;
};

struct plot {
  const struct plot_point *curve; /* (n_curve) by ascending x; a y that is not finite makes a gap */
  size_t n_curve;
  const struct plot_point *marks; /* (n_marks) single points drawn over the curve */
  size_t n_marks;
  double x_end;      /* the x axis goes from 0 to x_end */
  int width, height; /* of the whole plot, in characters; at least 24 × 4 */
  bool utf8, color;
};

#define PLOT_MARK_UTF8  "◆"
#define PLOT_MARK_ASCII "o"

/* Draws `height` lines, each with a newline: the curve next to its scale, with the axis below
 * (malloc). */
char *plot_draw(const struct plot *plot);

#endif
