/* curves.c: losses against steps, linear axes, as an SVG file. */
#include "learning.h"

#include <math.h>

enum { WIDTH = 940, HEIGHT = 440, LEFT = 70, RIGHT = 300, TOP = 40, BOTTOM = 50, TICKS = 5 };

static const char *const colors[] = {"#1b6ca8", "#c0392b", "#1e8449", "#b7950b",
                                     "#7d3c98", "#5dade2", "#ec7063", "#58d68d"};

static double across(double step, double n_steps)
{
  return LEFT + step / n_steps * (WIDTH - LEFT - RIGHT);
}

/* 0 at the bottom, 1.1 at the top; higher losses are drawn at the top. */
static double up(double loss)
{
  return HEIGHT - BOTTOM - fmin(loss, 1.1) / 1.1 * (HEIGHT - TOP - BOTTOM);
}

static void line(FILE *file, const double *loss, uint32_t n_steps, const char *color,
                 const char *style)
{
  fprintf(file, "<polyline class=\"%s\" stroke=\"%s\" points=\"", style, color);
  for (uint32_t i = 1; i <= n_steps; i++)
    if (!isnan(loss[i]))
      fprintf(file, "%.1f,%.1f ", across(i, n_steps), up(loss[i]));
  fprintf(file, "\"/>\n");
}

static void mean_line(FILE *file, const struct curves_group *group, uint32_t n_steps,
                      const char *color)
{
  fprintf(file, "<polyline class=\"mean\" stroke=\"%s\" points=\"", color);
  for (uint32_t i = 1; i <= n_steps; i++) {
    double sum = 0.0;
    int n = 0;
    for (size_t r = 0; r < group->n_runs; r++)
      if (!isnan(group->runs[r].loss[i])) {
        sum += group->runs[r].loss[i];
        n++;
      }
    if (n > 0)
      fprintf(file, "%.1f,%.1f ", across(i, n_steps), up(sum / n));
  }
  fprintf(file, "\"/>\n");
}

static void axes(FILE *file, const struct curves_panel *panel, uint32_t n_steps)
{
  fprintf(file, "<text x=\"%d\" y=\"24\" font-size=\"15\">%s</text>\n", LEFT, panel->title);
  for (int i = 0; i <= TICKS; i++) {
    const double step = (double)n_steps * i / TICKS, loss = 0.2 * i;
    fprintf(file,
            "<line x1=\"%.1f\" y1=\"%d\" x2=\"%.1f\" y2=\"%d\" class=\"grid\"/><text x=\"%.1f\" "
            "y=\"%d\" text-anchor=\"middle\">%g</text>\n"
            "<line x1=\"%d\" y1=\"%.1f\" x2=\"%d\" y2=\"%.1f\" class=\"grid\"/><text x=\"%d\" "
            "y=\"%.1f\" text-anchor=\"end\">%.1f</text>\n",
            across(step, n_steps), TOP, across(step, n_steps), HEIGHT - BOTTOM,
            across(step, n_steps), HEIGHT - BOTTOM + 18, step, LEFT, up(loss), WIDTH - RIGHT,
            up(loss), LEFT - 8, up(loss) + 4, loss);
  }
  fprintf(
      file,
      "<text x=\"%d\" y=\"%d\" text-anchor=\"middle\">step</text>\n<text transform=\"translate(20 "
      "%d) rotate(-90)\" text-anchor=\"middle\">mean loss of the batch</text>\n",
      (LEFT + WIDTH - RIGHT) / 2, HEIGHT - 12, (TOP + HEIGHT - BOTTOM) / 2);
}

int bench_draw_curves(const char *path, uint32_t n_steps, const struct curves_panel *panels,
                      size_t n_panels)
{
  FILE *file = fopen(path, "w");
  if (file == NULL)
    return -1;
  fprintf(file,
          "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 %d %zu\" "
          "font-family=\"sans-serif\" font-size=\"12\">\n"
          "<style>.grid{stroke:#ddd}polyline{fill:none}.run{stroke-width:0.7;opacity:0.45}.mean{"
          "stroke-width:2.2}</style>\n"
          "<rect width=\"%d\" height=\"%zu\" fill=\"white\"/>\n",
          WIDTH, n_panels * HEIGHT, WIDTH, n_panels * HEIGHT);
  for (size_t p = 0; p < n_panels; p++) {
    fprintf(file, "<g transform=\"translate(0 %zu)\">\n", p * HEIGHT);
    axes(file, &panels[p], n_steps);
    for (size_t g = 0; g < panels[p].n_groups; g++) {
      const struct curves_group *group = panels[p].groups[g];
      const char *color = colors[g % (sizeof(colors) / sizeof(colors[0]))];
      for (size_t r = 0; r < group->n_runs; r++)
        line(file, group->runs[r].loss, n_steps, color, "run");
      mean_line(file, group, n_steps, color);
      fprintf(file,
              "<line x1=\"%d\" y1=\"%zu\" x2=\"%d\" y2=\"%zu\" stroke=\"%s\" "
              "stroke-width=\"3\"/><text x=\"%d\" y=\"%zu\">%s</text>\n",
              WIDTH - RIGHT + 16, TOP + 12 + 20 * g, WIDTH - RIGHT + 40, TOP + 12 + 20 * g, color,
              WIDTH - RIGHT + 48, TOP + 16 + 20 * g, group->name);
    }
    fprintf(file, "</g>\n");
  }
  fprintf(file, "</svg>\n");
  return fclose(file) == 0 ? 0 : -1;
}
