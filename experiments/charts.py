"""Charts as SVG, written by hand: a page of panels with linear or logarithmic scales, lines, bands
and histograms."""
import math
from xml.sax.saxutils import escape

from records import replace

COLORS = {"zero-shot": "#1b6ca8", "few-shot": "#c0392b", "simultaneous": "#1e8449"}
PALETTE = ("#1b6ca8", "#c0392b", "#1e8449", "#8e44ad", "#d68910", "#148f77", "#7b241c", "#5d6d7e",
           "#b03a9c", "#6e6e1e")
GRAY = "#777"


class Scale:
    """Maps values to a share of an axis, 0 to 1. `ticks`: the values that get a mark."""
    def __init__(self, low, high, log=False, ticks=None):
        self.low, self.high, self.log = low, high, log
        self.ticks = ticks if ticks is not None else log_ticks(low, high) if log else round_ticks(
            low, high)

    def share(self, value):
        if self.log:
            return math.log(max(value, 1e-300) / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def label(value):
    """Returns the label of a tick: three digits, or more if a number has more before the point."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.6g}"


def log_ticks(low, high):
    values = [
        d * 10.0**k for k in range(math.floor(math.log10(low)),
                                   math.ceil(math.log10(high)) + 1) for d in (1, 2, 5)
    ]
    return [value for value in values if low * 0.999 <= value <= high * 1.001]


def round_ticks(low, high, most=6):
    """Returns multiples of 1, 2 or 5 times a power of ten, at most `most` of them."""
    step = 10.0**math.floor(math.log10((high - low) / most or 1))
    step *= next(factor for factor in (1, 2, 5, 10, 20) if (high - low) / (factor * step) <= most)
    return [
        i * step for i in range(math.ceil(low / step - 1e-9),
                                math.floor(high / step + 1e-9) + 1)
    ]


def decades(values, margin=1.0):
    """Returns bounds around positive values: 1, 2 or 5 times a power of ten."""
    values = [value for value in values if value is not None and value > 0] or [0.1, 1]
    least, most = min(values) / margin, max(values) * margin
    steps = [d * 10.0**k for k in range(-12, 13) for d in (1, 2, 5)]
    low = max(step for step in steps if step <= least * 1.0001)
    return low, max(min(step for step in steps if step >= most * 0.9999), 2 * low)


class Chart:
    """The page, with all its panels."""
    def __init__(self,
                 width,
                 height,
                 style=".grid{stroke:#ddd}polyline{fill:none;stroke-width:1.6}"):
        self.out = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'font-family="sans-serif" font-size="12">',
            f"<style>{style}</style>", '<rect width="100%" height="100%" fill="#fff"/>'
        ]

    def text(self, x, y, text, **attributes):
        given = "".join(f' {name.replace("_", "-")}="{value}"'
                        for name, value in attributes.items())
        self.out.append(f'<text x="{x}" y="{y}"{given}>{escape(text)}</text>')

    def legend(self, x, y, entries, column=170):
        """Draws entries in a row: (text, color, dash)."""
        for i, (text, color, dash) in enumerate(entries):
            at = x + i * column
            self.out.append(
                f'<line x1="{at}" y1="{y - 4}" x2="{at + 24}" y2="{y - 4}" stroke="{color}" '
                f'stroke-width="2" stroke-dasharray="{dash}"/>'
            )
            self.text(at + 30, y, text)

    def save(self, path):
        self.out[-1] += "</svg>"
        replace(path, "\n".join(self.out) + "\n")


class Panel:
    """A rectangle of a chart with two scales. left, top, right, bottom: its edges on the page."""
    def __init__(self, chart, left, top, right, bottom, x, y):
        self.chart, self.x, self.y = chart, x, y
        self.left, self.top, self.right, self.bottom = left, top, right, bottom

    def at_x(self, value):
        return self.left + self.x.share(value) * (self.right - self.left)

    def at_y(self, value):
        return self.bottom - self.y.share(value) * (self.bottom - self.top)

    def title(self, text, above=16, size=15):
        self.chart.text(self.left, self.top - above, text, font_size=size)

    def axes(self, x_name="", y_name="", x_labels=True, x_grid=False):
        for value in self.y.ticks:
            self.chart.out.append(
                f'<line class="grid" x1="{self.left}" y1="{self.at_y(value):.1f}" '
                f'x2="{self.right}" y2="{self.at_y(value):.1f}"/>'
                f'<text x="{self.left - 8}" y="{self.at_y(value) + 4:.1f}" '
                f'text-anchor="end">{label(value)}</text>'
            )
        taken = -math.inf  # the end of the previous label
        for value in self.x.ticks:
            if x_grid:
                self.chart.out.append(
                    f'<line class="grid" x1="{self.at_x(value):.1f}" y1="{self.top}" '
                    f'x2="{self.at_x(value):.1f}" y2="{self.bottom}"/>'
                )
            half = 3.6 * len(label(value))  # about half of its width
            if x_labels and self.at_x(value) - half > taken:
                self.chart.out.append(
                    f'<text x="{self.at_x(value):.1f}" y="{self.bottom + 18}" '
                    f'text-anchor="middle">{label(value)}</text>'
                )
                taken = self.at_x(value) + half
        if x_name:
            self.chart.text(f"{(self.left + self.right) / 2:.1f}",
                            self.bottom + 34,
                            x_name,
                            text_anchor="middle",
                            fill="#444")
        if y_name:
            y = f"{(self.top + self.bottom) / 2:.1f}"
            self.chart.text(self.left - 46,
                            y,
                            y_name,
                            text_anchor="middle",
                            fill="#444",
                            transform=f"rotate(-90 {self.left - 46} {y})")

    def points(self, values):
        return " ".join(f"{self.at_x(x):.1f},{self.at_y(y):.1f}" for x, y in values
                        if y is not None)

    def line(self, values, color, dash="", style=""):
        given = f' style="{style}"' if style else ""
        self.chart.out.append(
            f'<polyline stroke="{color}" stroke-dasharray="{dash}"{given} '
            f'points="{self.points(values)}"/>'
        )

    def band(self, values, color, opacity=0.18):
        """Draws a band. values: (x, least, most)."""
        known = [value for value in values if value[1] is not None and value[2] is not None]
        around = [(x, most) for x, _, most in known] + [(x, least)
                                                        for x, least, _ in reversed(known)]
        if len(known) > 1:
            self.chart.out.append(
                f'<polygon fill="{color}" fill-opacity="{opacity}" points="{self.points(around)}"/>'
            )

    def dots(self, values, color, radius=2.2):
        self.chart.out += [
            f'<circle cx="{self.at_x(x):.1f}" cy="{self.at_y(y):.1f}" r="{radius}" fill="{color}"/>'
            for x, y in values if y is not None
        ]

    def histogram(self, edges, shares, color):
        """Draws a filled outline over the bins."""
        corners = [(edges[0], 0)]
        for left, right, share in zip(edges, edges[1:], shares):
            corners += [(left, share), (right, share)]
        corners.append((edges[-1], 0))
        self.chart.out.append(
            f'<polygon fill="{color}" fill-opacity="0.25" stroke="{color}" stroke-width="1.2" '
            f'points="{self.points(corners)}"/>'
        )


def bundle(panel, curves, color, dash="", dots=False):
    """Draws several curves of one quantity, each a dictionary x → y: a band from least to most and
    a line of the mean where all of them have values. A curve with a single point becomes a dot."""
    shared = sorted(
        set.intersection(*(set(x for x, y in curve.items() if y is not None)
                           for curve in curves))) if curves else []
    if len(curves) > 1:
        panel.band([(x, min(curve[x] for curve in curves), max(curve[x] for curve in curves))
                    for x in shared], color)
    middle = [(x, sum(curve[x] for curve in curves) / len(curves)) for x in shared]
    panel.line(middle, color, dash)
    if dots or len(middle) == 1:
        panel.dots(middle, color)
