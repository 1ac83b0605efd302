/* svg.c: line charts with logarithmic axes, and the tables that they show. */
#include "bench.h"

#include <math.h>
#include <stdlib.h>

enum { WIDTH = 860, HEIGHT = 560, LEFT = 80, RIGHT = 230, TOP = 50, BOTTOM = 60 };

struct axis {
  double low, high; /* decades */
  double from, to;  /* pixels */
};

static double at(const struct axis *axis, double value)
{
  return axis->from +
         (log10(value) - axis->low) / (axis->high - axis->low) * (axis->to - axis->from);
}

static void extend(double *low, double *high, double value)
{
  *low = fmin(*low, floor(log10(value)));
  *high = fmax(*high, ceil(log10(value)));
}

/* Decades get a label; on an axis of few decades, 2 and 5 do as well. */
static void ticks(FILE *file, const struct axis *axis, bool horizontal)
{
  const bool fine = axis->high - axis->low < 3;
  for (int decade = (int)axis->low; decade <= (int)axis->high; decade++)
    for (int digit = 1; digit < 10; digit++) {
      const double value = digit * pow(10.0, decade);
      if (log10(value) > axis->high + 1e-9 || (digit != 1 && !(fine && (digit == 2 || digit == 5))))
        continue;
      const double p = at(axis, value);
      if (horizontal)
        fprintf(file,
                "<line x1=\"%.1f\" y1=\"%d\" x2=\"%.1f\" y2=\"%d\" class=\"grid\"/><text "
                "x=\"%.1f\" y=\"%d\" text-anchor=\"middle\">%g</text>\n",
                p, TOP, p, HEIGHT - BOTTOM, p, HEIGHT - BOTTOM + 18, value);
      else
        fprintf(file,
                "<line x1=\"%d\" y1=\"%.1f\" x2=\"%d\" y2=\"%.1f\" class=\"grid\"/><text x=\"%d\" "
                "y=\"%.1f\" text-anchor=\"end\">%g</text>\n",
                LEFT, p, WIDTH - RIGHT, p, LEFT - 8, p + 4, value);
    }
}

static void draw_marks(FILE *file, const struct bench_series *series, const struct axis *x,
                       const struct axis *y, const char *color)
{
  fprintf(file, "<path fill=\"%s\" d=\"", color);
  for (size_t i = 0; i < series->n; i++)
    fprintf(file, "M%.0f %.0fh8v8h-8z%s", at(x, series->x[i]) - 4, at(y, series->y[i]) - 4,
            i % 8 == 7 ? "\n" : "");
  fprintf(file, "\"/>\n");
}

/* Dots where the points are few enough to be told apart. */
static void draw_line(FILE *file, const struct bench_series *series, const struct axis *x,
                      const struct axis *y, const char *color)
{
  fprintf(file, "<polyline class=\"line\" stroke=\"%s\" points=\"", color);
  for (size_t i = 0; i < series->n; i++)
    fprintf(file, "%.1f,%.1f ", at(x, series->x[i]), at(y, series->y[i]));
  fprintf(file, "\"/>\n");
  for (size_t i = 0; i < series->n && series->n <= 64; i++)
    fprintf(file, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"3\" fill=\"%s\"/>\n", at(x, series->x[i]),
            at(y, series->y[i]), color);
}

static void draw_panel(FILE *file, const struct bench_panel *panel, const char *x_name)
{
  static const char *const colors[] = {"#1b6ca8", "#c0392b", "#1e8449", "#b7950b", "#7d3c98",
                                       "#5dade2", "#ec7063", "#58d68d", "#f5b041", "#af7ac5"};
  double x_low = INFINITY, x_high = -INFINITY, y_low = INFINITY, y_high = -INFINITY;
  for (size_t s = 0; s < panel->n_series; s++)
    for (size_t i = 0; i < panel->series[s].n; i++) {
      extend(&x_low, &x_high, panel->series[s].x[i]);
      extend(&y_low, &y_high, panel->series[s].y[i]);
    }
  const struct axis x = {x_low, x_high, LEFT, WIDTH - RIGHT},
                    y = {y_low, y_high, HEIGHT - BOTTOM, TOP};
  fprintf(file, "<text x=\"%d\" y=\"30\" font-size=\"15\">%s</text>\n", LEFT, panel->title);
  ticks(file, &x, true);
  ticks(file, &y, false);
  fprintf(file,
          "<text x=\"%d\" y=\"%d\" text-anchor=\"middle\">%s</text>\n"
          "<text transform=\"translate(18 %d) rotate(-90)\" text-anchor=\"middle\">%s</text>\n",
          (LEFT + WIDTH - RIGHT) / 2, HEIGHT - 16, x_name, (TOP + HEIGHT - BOTTOM) / 2,
          panel->y_name);
  for (size_t s = 0, row = TOP + 12; s < panel->n_series; s++) {
    const struct bench_series *series = panel->series + s;
    if (series->n == 0)
      continue;
    const char *color =
        series->color != NULL ? series->color : colors[s % (sizeof(colors) / sizeof(colors[0]))];
    if (series->marks)
      draw_marks(file, series, &x, &y, color);
    else
      draw_line(file, series, &x, &y, color);
    fprintf(file,
            "<line x1=\"%d\" y1=\"%zu\" x2=\"%d\" y2=\"%zu\" stroke=\"%s\" stroke-width=\"3\"/>"
            "<text x=\"%d\" y=\"%zu\">%s</text>\n",
            WIDTH - RIGHT + 16, row, WIDTH - RIGHT + 40, row, color, WIDTH - RIGHT + 48, row + 4,
            series->name);
    row += 20;
  }
}

static int draw(const char *path, const char *x_name, const struct bench_panel *panels,
                size_t n_panels)
{
  FILE *file = fopen(path, "w");
  if (file == NULL)
    return -1;
  const size_t height = n_panels * HEIGHT;
  fprintf(file,
          "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 %d %zu\" "
          "font-family=\"sans-serif\" font-size=\"12\">\n"
          "<style>.grid{stroke:#ddd}.line{fill:none;stroke-width:1.8}</style>\n"
          "<rect width=\"%d\" height=\"%zu\" fill=\"white\"/>\n",
          WIDTH, height, WIDTH, height);
  for (size_t p = 0; p < n_panels; p++) {
    fprintf(file, "<g transform=\"translate(0 %zu)\">\n", p * HEIGHT);
    draw_panel(file, panels + p, x_name);
    fprintf(file, "</g>\n");
  }
  fprintf(file, "</svg>\n");
  return fclose(file) == 0 ? 0 : -1;
}

FILE *bench_table(const struct bench_options *options)
{
  FILE *table = options->csv != NULL ? fopen(options->csv, "w") : stdout;
  if (table == NULL) {
    perror(options->csv);
    exit(1);
  }
  return table;
}

int bench_finish(const struct bench_options *options, FILE *table, const char *x_name,
                 const struct bench_panel *panels, size_t n_panels)
{
  int status = 0;
  if (options->csv != NULL && fclose(table) != 0)
    status = 1;
  if (options->svg != NULL && draw(options->svg, x_name, panels, n_panels) != 0) {
    perror(options->svg);
    status = 1;
  }
  return status;
}
