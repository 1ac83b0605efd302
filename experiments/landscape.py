"""Statistics of the landscapes of atlas files, side by side, as Markdown; and Kendall's τ of each
two. docs/search.md defines them."""
import argparse
import itertools
import math
import sys
from pathlib import Path

import client_code

client_code.prepare()

from morphod.atlas import Atlas, landscape


def percent(share):
    return "–" if math.isnan(share) else f"{100 * share:.1f} %"


def rows_of(atlas, found):
    """Yields the names and texts of the statistics of an atlas."""
    yield "bodies", f"{found.bodies:,}"
    yield "maximum number of voxels", str(atlas.voxels_max)
    yield "orientations", atlas.orientations
    yield "bodies that diverged", f"{found.diverged:,}"
    yield "neighbors of a body", f"{found.neighbors:.2f}"
    for k in (1, 2, 5):
        yield (f"autocorrelation of walks, {k} step{'s' if k > 1 else ''} apart",
               f"{found.autocorrelation[k]:.3f}")
        yield "– without the mean of the size", f"{found.within_sizes[k]:.3f}"
    yield "correlation length, steps", f"{found.correlation_length:.2f}"
    yield "local optima", f"{found.optima:,} ({percent(found.optima / found.bodies)})"
    yield ("basin of the best body",
           f"{found.best_basin:,} ({percent(found.best_basin / found.bodies)})")
    yield "median basin, bodies", f"{found.median_basin:g}"
    yield "steps of a steepest ascent, mean", f"{found.ascent_steps:.2f}"
    yield "regret at its end, median", f"{found.ascent_regret:.4f}"
    yield f"neutral neighbors (within {found.tolerance:g})", percent(found.neutral)
    yield "epistasis: pairs of voxels", f"{found.epistasis.pairs:,}"
    for kind in ("none", "magnitude", "sign", "reciprocal"):
        yield f"– {kind}", percent(getattr(found.epistasis, kind))
    yield "best change removes a voxel", percent(found.shrinks)


def table(columns):
    """columns: (name, rows)."""
    yield "| | " + " | ".join(name for name, _ in columns) + " |"
    yield "| --- |" + " --- |" * len(columns)
    for rows in zip(*(rows for _, rows in columns)):
        yield f"| {rows[0][0]} | " + " | ".join(text for _, text in rows) + " |"


def sizes_of(found):
    yield ("| voxels | bodies | best | median | local optima | no added voxel helps | best body "
           "contains the best of one voxel fewer | ascent from the best ends at |")
    yield "| --- |" + " --- |" * 7
    for size in found.sizes:
        yield (f"| {size.voxels} | {size.bodies:,} | {size.best:.4f} | {size.median:.4f} | "
               f"{size.optima:,} | {percent(size.no_growth)} | "
               f"{'–' if size.voxels == 1 else 'yes' if size.grown else 'no'} | "
               f"{size.ends_at:.4f} |")


def main():
    parser = argparse.ArgumentParser(prog="tools/bench landscape", description=__doc__)
    parser.add_argument("atlas", nargs="+", help="atlas files")
    parser.add_argument("--tolerance", type=float, default=0.001,
                        help="of neutrality and epistasis, in units of the loss (default 0.001)")
    parser.add_argument("--sample", type=int, default=20000,
                        help="bodies whose pairs of voxels are examined (default 20000)")
    arguments = parser.parse_args()
    atlases = [Atlas.open(path, check=True) for path in arguments.atlas]
    columns, sizes = [], []
    for path, atlas in zip(arguments.atlas, atlases):
        found = landscape(atlas, tolerance=arguments.tolerance, sample=arguments.sample)
        columns.append((Path(path).stem, list(rows_of(atlas, found))))
        sizes.append((Path(path).stem, found))
    print("\n".join(table(columns)))
    for name, found in sizes:
        print(f"\n{name}:\n")
        print("\n".join(sizes_of(found)))
    print()
    for one, other in itertools.combinations(atlases, 2):
        if one.workspace == other.workspace:
            found = one.compare(other)
            print(f"{Path(one.path).stem} and {Path(other.path).stem}: Kendall's τ {found.tau:.3f} "
                  f"of {found.bodies:,} bodies")
    return 0


if __name__ == "__main__":
    sys.exit(main())
