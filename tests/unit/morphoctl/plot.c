/* A curve as text: its size, its shape, and input that must not break it. */
#include "plot.h"
#include "../check.h"

static char *lines[64];
static size_t n_lines;
static char *drawn;

static void draw(const struct plot *plot)
{
  free(drawn);
  drawn = plot_draw(plot);
  n_lines = 0;
  for (char *at = drawn; at != NULL && *at != '\0' && n_lines < 64;) {
    lines[n_lines++] = at;
    at = strchr(at, '\n');
    if (at != NULL)
      *at++ = '\0';
  }
}

static size_t width(const char *text)
{
  size_t n = 0;
  for (; *text != '\0'; text++)
    n += ((unsigned char)*text & 0xc0) != 0x80;
  return n;
}

static void falls(void)
{
  struct plot_point curve[200];
  for (int i = 0; i < 200; i++)
    curve[i] = (struct plot_point){i + 1, 1.0 - i / 200.0};
  struct plot plot = {.curve = curve, .n_curve = 200, .x_end = 200, .width = 50, .height = 12};
  draw(&plot);
  REQUIRE(n_lines == 12);
  /* A straight line: in each row the asterisks are to the right of those above. */
  size_t before = 0;
  for (int row = 0; row < 10; row++) {
    const char *first = strchr(lines[row], '*'), *last = strrchr(lines[row], '*');
    REQUIRE(first != NULL && last != NULL);
    CHECK((size_t)(first - lines[row]) + 1 >= before && (size_t)(last - lines[row]) > before);
    before = (size_t)(last - lines[row]);
    CHECK(width(lines[row]) <= 50);
  }
  CHECK(strstr(lines[11], "step 200") != NULL && width(lines[11]) <= 50);
  CHECK(strtod(lines[0], NULL) > 0.9 && strtod(lines[9], NULL) < 0.1);
  plot.utf8 = true;
  draw(&plot);
  REQUIRE(n_lines == 12);
  for (int row = 0; row < 10; row++)
    CHECK(width(lines[row]) <= 50 && strstr(lines[row], "\xE2\xA0") != NULL);
}

static void marks(void)
{
  const struct plot_point curve[] = {{1, 0.5}, {50, 0.5}}, marks[] = {{0, 1.0}, {50, 0.0}};
  struct plot plot = {.curve = curve,
                      .n_curve = 2,
                      .marks = marks,
                      .n_marks = 2,
                      .x_end = 50,
                      .width = 40,
                      .height = 8};
  draw(&plot);
  REQUIRE(n_lines == 8);
  CHECK(strchr(lines[0], 'o') != NULL && strchr(lines[5], 'o') != NULL &&
        strchr(lines[2], 'o') == NULL);
  plot.color = plot.utf8 = true;
  draw(&plot);
  CHECK(strstr(lines[0], "\033[33m" PLOT_MARK_UTF8 "\033[0m") != NULL);
}

/* No point, one point, a constant, gaps, huge numbers, an area that is too small: the drawing
 * always has the requested size. */
static void odd(void)
{
  const struct plot_point nothing[] = {{1, NAN}, {2, INFINITY}}, one[] = {{7, 3}},
                          flat[] = {{1, 2}, {2, 2}, {3, NAN}, {4, 2}},
                          huge[] = {{1, -1e300}, {1e9, 1e300}, {2e9, 0}},
                          beyond[] = {{-5, 1}, {1000, 2}};
  const struct {
    const struct plot_point *points;
    size_t n;
    double end;
  } tries[] = {{NULL, 0, 0}, {nothing, 2, 2}, {one, 1, 7},
               {flat, 4, 4}, {huge, 3, 2e9},  {beyond, 2, 10}};
  for (size_t i = 0; i < sizeof(tries) / sizeof(tries[0]); i++)
    for (int utf8 = 0; utf8 < 2; utf8++) {
      struct plot plot = {.curve = tries[i].points,
                          .n_curve = tries[i].n,
                          .x_end = tries[i].end,
                          .width = 60,
                          .height = 10,
                          .utf8 = utf8 != 0};
      draw(&plot);
      CHECK_INT(n_lines, 10);
      plot.width = plot.height = -3;
      draw(&plot);
      CHECK_INT(n_lines, 4);
    }
  free(drawn);
  drawn = NULL;
}

static const struct check_case cases[] = {
    {"a falling line", falls}, {"marks", marks}, {"odd curves", odd}};
CHECK_MAIN(cases)
