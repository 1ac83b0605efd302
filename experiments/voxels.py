"""Draws voxel bodies as SVG, seen from above one corner. Each visible face is a parallelogram; far
ones come first."""

SIZE = (6, 6, 4)
COS, SIN = 0.866, 0.5  # of 30°: x to the right and down, y to the left and down, z up


def cells(genotype):
    """Returns (x, y, z) of each voxel in a genotype of 144 digits."""
    return [(i // 24, i // 4 % 6, i % 4) for i, digit in enumerate(genotype) if digit == "1"]


def shade(color, factor):
    """Returns a color #rrggbb mixed with white (factor above 1) or black."""
    parts = [int(color[i:i + 2], 16) for i in (1, 3, 5)]
    mixed = [part * factor if factor <= 1 else part + (255 - part) * (factor - 1) for part in parts]
    return "#" + "".join(f"{round(part):02x}" for part in mixed)


def draw(genotype, left, top, unit, color):
    """Draws the body on the outline of its workspace, in a box of width 12 · COS · unit and height
    10 · unit with the given upper left corner."""
    def corner(x, y, z):
        return f"{left + (x - y + 6) * COS * unit:.1f},{top + ((x + y) * SIN + 4 - z) * unit:.1f}"

    body = set(cells(genotype))
    floor = " ".join(corner(*point) for point in ((0, 0, 0), (6, 0, 0), (6, 6, 0), (0, 6, 0)))
    out = [
        f'<polygon fill="#f6f6f6" stroke="#ccc" stroke-width="0.5" points="{floor}"/>',
        '<g stroke="#333" stroke-width="0.4">'
    ]
    faces = (
        ((0, 0, 1), 1.45, ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))),  # top
        ((1, 0, 0), 1.0, ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1))),  # right
        ((0, 1, 0), 0.72, ((0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1))))  # left
    for x, y, z in sorted(body, key=sum):
        for (dx, dy, dz), factor, corners in faces:
            if (x + dx, y + dy, z + dz) not in body:
                points = " ".join(corner(x + i, y + j, z + k) for i, j, k in corners)
                out.append(f'<polygon fill="{shade(color, factor)}" points="{points}"/>')
    return out + ["</g>"]
