/* plot.c: see plot.h. The curve is drawn on a grid of dots. Each column of dots shows the mean of
 * its points, and straight lines join the columns that have points. */
#include "plot.h"

#include "ctl.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LABEL 9 /* width of the scale, in characters */

struct grid {
  const struct plot *plot;
  int columns, rows;       /* of the drawing area, in characters */
  int dots_x, dots_y;      /* of the drawing area, in dots */
  double low, high, x_end; /* range of the y axis; end of the x axis */
  unsigned char *dots;     /* (dots_y, dots_x) */
  unsigned char *marks;    /* (rows, columns) */
};

static void widen(const struct plot_point *points, size_t n, double *low, double *high)
{
  for (size_t i = 0; i < n; i++)
    if (isfinite(points[i].y)) {
      *low = fmin(*low, points[i].y);
      *high = fmax(*high, points[i].y);
    }
}

static void find_range(struct grid *grid)
{
  double low = INFINITY, high = -INFINITY;
  widen(grid->plot->curve, grid->plot->n_curve, &low, &high);
  widen(grid->plot->marks, grid->plot->n_marks, &low, &high);
  if (low > high) { /* nothing to show yet */
    low = 0;
    high = 1;
  }
  double margin = high > low ? (high - low) * 0.04 : fmax(fabs(high) * 0.05, 1e-9);
  grid->low = low - margin;
  grid->high = high + margin;
  grid->x_end = grid->plot->x_end > 0 ? grid->plot->x_end : 1;
}

/* Returns the index of a value among n cells, clamped. */
static int cell(double value, double low, double high, int n)
{
  int at = (int)floor((value - low) / (high - low) * n);
  return at < 0 ? 0 : at >= n ? n - 1 : at;
}

static int cell_y(const struct grid *grid, double y, int n)
{
  return n - 1 - cell(y, grid->low, grid->high, n);
}

/* Draws the dots of one column, from the height of the previous column (−1 if none) to its own. */
static void stroke(struct grid *grid, int x, int from, int to)
{
  int low = from < 0    ? to
            : from < to ? from + 1
                        : to,
      high = from < 0    ? to
             : from > to ? from - 1
                         : to;
  for (int y = low; y <= high; y++)
    grid->dots[y * grid->dots_x + x] = 1;
}

static void draw_curve(struct grid *grid)
{
  const struct plot *plot = grid->plot;
  int before_x = -1, before_y = -1; /* −1: a new line begins */
  for (size_t i = 0; i < plot->n_curve;) {
    int x = cell(plot->curve[i].x, 0, grid->x_end, grid->dots_x);
    double sum = 0;
    size_t n = 0;
    for (; i < plot->n_curve && cell(plot->curve[i].x, 0, grid->x_end, grid->dots_x) == x; i++)
      if (isfinite(plot->curve[i].y)) {
        sum += plot->curve[i].y / (double)plot->n_curve; /* so that no sum overflows */
        n++;
      }
    if (n == 0) {
      before_y = -1;
      continue;
    }
    int y = cell_y(grid, sum / (double)n * (double)plot->n_curve, grid->dots_y), last = before_y;
    for (int at = before_x + 1; last >= 0 && at < x; at++) { /* columns between two points */
      int between =
          (int)lround(before_y + (double)(y - before_y) * (at - before_x) / (x - before_x));
      stroke(grid, at, last == between ? -1 : last, between);
      last = between;
    }
    stroke(grid, x, last == y ? -1 : last, y);
    before_x = x;
    before_y = y;
  }
  for (size_t i = 0; i < plot->n_marks; i++)
    if (isfinite(plot->marks[i].y))
      grid->marks[cell_y(grid, plot->marks[i].y, grid->rows) * grid->columns +
                  cell(plot->marks[i].x, 0, grid->x_end, grid->columns)] = 1;
}

static void put_character(const struct grid *grid, FILE *file, int row, int column)
{
  const struct plot *plot = grid->plot;
  if (grid->marks[row * grid->columns + column] != 0) {
    fprintf(file, "%s%s%s", plot->color ? "\033[33m" : "",
            plot->utf8 ? PLOT_MARK_UTF8 : PLOT_MARK_ASCII, plot->color ? "\033[0m" : "");
    return;
  }
  if (!plot->utf8) {
    fputc(grid->dots[row * grid->dots_x + column] != 0 ? '*' : ' ', file);
    return;
  }
  static const unsigned char bits[4][2] = {{0x01, 0x08}, {0x02, 0x10}, {0x04, 0x20}, {0x40, 0x80}};
  unsigned pattern = 0;
  for (int y = 0; y < 4; y++)
    for (int x = 0; x < 2; x++)
      if (grid->dots[(row * 4 + y) * grid->dots_x + column * 2 + x] != 0)
        pattern |= bits[y][x];
  if (pattern == 0)
    fputc(' ', file);
  else /* U+2800 and the pattern */
    fprintf(file, "\xE2%c%c", (char)(0xA0 | pattern >> 6), (char)(0x80 | (pattern & 0x3F)));
}

static void write_grid(const struct grid *grid, FILE *file)
{
  const struct plot *plot = grid->plot;
  for (int row = 0; row < grid->rows; row++) {
    bool labelled = row == 0 || row == grid->rows - 1 || (grid->rows >= 7 && row == grid->rows / 2);
    double middle = grid->high - (grid->high - grid->low) * (row + 0.5) / grid->rows;
    if (labelled)
      fprintf(file, "%*.4f %s", LABEL - 1, middle, plot->utf8 ? "┤" : "|");
    else
      fprintf(file, "%*s%s", LABEL, "", plot->utf8 ? "│" : "|");
    int last = grid->columns - 1;
    bool full = false; /* no blanks at the end of a line */
    for (; last >= 0 && !full; last--) {
      full = grid->marks[row * grid->columns + last] != 0;
      int across = grid->dots_x / grid->columns, down = grid->dots_y / grid->rows;
      for (int y = 0; y < down; y++)
        for (int x = 0; x < across; x++)
          full |= grid->dots[(row * down + y) * grid->dots_x + last * across + x] != 0;
    }
    for (int column = 0; full && column <= last + 1; column++)
      put_character(grid, file, row, column);
    fputc('\n', file);
  }
  fprintf(file, "%*s%s", LABEL, "", plot->utf8 ? "└" : "+");
  for (int column = 0; column < grid->columns; column++)
    fputs(plot->utf8 ? "─" : "-", file);
  char end[32];
  int length = snprintf(end, sizeof(end), "step %.0f", plot->x_end);
  fprintf(file, "\n%*s0%*s%s\n", LABEL + 1, "",
          grid->columns - 1 - length > 0 ? grid->columns - 1 - length : 1, "", end);
}

char *plot_draw(const struct plot *plot)
{
  struct grid grid = {.plot = plot};
  grid.columns = (plot->width > 24 ? plot->width : 24) - LABEL - 1;
  grid.rows = (plot->height > 4 ? plot->height : 4) - 2;
  grid.dots_x = grid.columns * (plot->utf8 ? 2 : 1);
  grid.dots_y = grid.rows * (plot->utf8 ? 4 : 1);
  grid.dots = need(calloc((size_t)grid.dots_x * (size_t)grid.dots_y, 1));
  grid.marks = need(calloc((size_t)grid.columns * (size_t)grid.rows, 1));
  char *text = NULL;
  size_t size = 0;
  FILE *file = need(open_memstream(&text, &size));
  find_range(&grid);
  draw_curve(&grid);
  write_grid(&grid, file);
  close_text(file);
  free(grid.dots);
  free(grid.marks);
  return text;
}
