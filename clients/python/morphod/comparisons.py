"""Comparisons with a confidence interval, as plain numbers: of campaigns, and of two controllers.

The methods and numbers are the same as in `morphoctl campaign compare` and `morphoctl train
compare`.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import MorphodError
from .frames import frame

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

CONFIDENCE = 0.95
"""Confidence level of all intervals."""


class CampaignComparison:
    """Campaigns, compared by their best scores at the newest generation that all have reached.

    `data` has the names of `morphoctl campaign compare --json`. Each of its `sides` is a campaign
    with its replicates: `best` is their mean, and `difference`, `low`, `high` and `verdict` compare
    it with the first side. A side's `differences` are the settings that differ from the first
    side's, as {"setting", "values"}, and `left_out` has the replicates that ended early.
    """

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data
        self.generation: int = data["generation"]
        self.sides: list[dict[str, Any]] = data["sides"]

    def frame(self) -> pd.DataFrame:
        """Returns a table with a row per side."""
        return frame({
            "campaign": side["campaign"], "label": side["label"], "runs": len(side["replicates"]),
            **{name: side.get(name) for name in ("best", "difference", "low", "high", "verdict")},
            "differs_in": ", ".join(one["setting"] for one in side["differences"]),
        } for side in self.sides)

    def __repr__(self) -> str:
        return "\n".join([f"<generation {self.generation}>", *self._lines()])

    def _lines(self) -> Iterator[str]:
        first, *others = self.sides
        for side in self.sides:
            for one in side["left_out"]:
                yield (f"campaign {one['id']}, a replicate of {side['campaign']}, is left out: "
                       f"{one['state']}")
        for side in others:
            for one in side["differences"]:
                a, b = map(short, one["values"])
                yield f"campaign {side['campaign']} differs in {one['setting']}: {b}, not {a}"
        for side in others:
            yield campaign_verdict(first, side)


class ControllerComparison:
    """Two controllers, a and b, compared on one held-out set, rollout by rollout.

    `difference` is the mean of b's scores minus a's, over the `pairs` designs that diverged with
    neither controller. `low` and `high` are its 95 % interval for other designs and other
    environments. `verdict` says whether b is "better", "worse" or "undecided". `improved` designs
    are better with b, and `sign_test_p` is the p of a sign test. `differences` are the settings of
    their training runs that differ, except the seed, as {"setting", "values"}: they, too, may
    explain the difference. If a controller's file does not say how it was trained, `training_known`
    of that side is false and only sensors and control periods are compared. `data` has the names of
    `morphoctl train compare --json`.
    """

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data
        self.difference: float = data["difference"]
        self.low: float = data["low"]
        self.high: float = data["high"]
        self.pairs: int = data["pairs"]
        self.improved: int = data["improved"]
        self.sign_test_p: float = data["sign_test_p"]
        self.verdict: str = data["verdict"]
        self.differences: list[dict[str, Any]] = data["differences"]

    def __repr__(self) -> str:
        a, b = self.data["a"]["controller"], self.data["b"]["controller"]
        lines = [f"{b} differs in {one['setting']}: {short(one['values'][1])}, not "
                 f"{short(one['values'][0])}" for one in self.differences]
        lines += [f"not known: how {self.data[side]['controller']} was trained"
                  for side in "ab" if not self.data[side]["training_known"]]
        return "\n".join([*lines, self._verdict()])

    def _verdict(self) -> str:
        a, b = self.data["a"]["controller"], self.data["b"]["controller"]
        if self.pairs < 2:
            return "Too few designs have a score with both controllers to say which is better."
        interval = (f"{self.difference:+.4f}, {CONFIDENCE:.0%} confidence {self.low:+.4f} to "
                    f"{self.high:+.4f}")
        if self.verdict == "undecided":
            said = f"No significant difference between {a} and {b} ({interval})."
        else:
            said = f"{b} is {self.verdict} than {a} ({interval})."
        unequal = self.pairs - self.data["equal"]
        by_number = "better" if 2 * self.improved > unequal else "worse"
        if self.sign_test_p < 1 - CONFIDENCE and by_number != self.verdict:
            said += (f" However, most designs are better with {b if by_number == 'better' else a} "
                     f"(sign test, p = {self.sign_test_p:.2g}).")
        return said


# ---- settings ----


def differences_of(a: Mapping[str, Any], b: Mapping[str, Any], place: str = ""
                   ) -> list[dict[str, Any]]:
    """Returns the members that differ, nested ones with dots: {"setting", "values": [of a, of b]}.
    """
    found = []
    for name in {**a, **b}:
        one, other = a.get(name), b.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found += differences_of(one, other, f"{place}{name}.")
        elif one != other:
            found.append({"setting": f"{place}{name}", "values": [one, other]})
    return found


def recipe_of(controller: Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns the settings of a controller's training run; None if its file does not have them."""
    try:
        recipe = json.loads(controller["metadata"].get("morphod.settings", ""))
    except ValueError:
        return None
    return recipe if isinstance(recipe, dict) else None


def training_differences(controllers: Sequence[Mapping[str, Any]],
                         recipes: Sequence[dict[str, Any] | None]) -> list[dict[str, Any]]:
    """Returns what differs between two controllers and their training runs, except the seed."""
    conditions = []
    for controller, recipe in zip(controllers, recipes):
        of_one: dict[str, Any] = {"sensor": controller["sensor"]}
        if None in recipes:
            of_one["control_period_s"] = controller["control_period_s"]
        else:
            of_one.update((name.removeprefix("morphod."), value)
                          for name, value in controller["metadata"].items()
                          if name.startswith("morphod.")
                          and name not in ("morphod.seed", "morphod.code"))
            of_one["settings"] = recipe
        conditions.append(of_one)
    return differences_of(conditions[0], conditions[1])


def require_two_controllers(a: str, b: str, controllers: Sequence[Mapping[str, Any]]) -> None:
    """Raises an error if both names mean one controller."""
    if controllers[0]["sha256"] == controllers[1]["sha256"]:
        raise MorphodError(f"{a} and {b} are the same controller "
                           f"(sha256:{controllers[0]['sha256']}): there is nothing to compare")


def short(value: Any) -> str:
    """Writes the value of a setting in at most 40 characters."""
    text = "-" if value is None else json.dumps(value, separators=(",", ":"))
    return text if len(text) <= 40 else f"{text[:37]}..."


def require_comparable(a: str, b: str, differences: Sequence[Mapping[str, Any]]) -> None:
    """Raises an error if scores of campaigns with these differences are not comparable."""
    for one in differences:
        setting = one["setting"]
        if setting == "settings.environments":
            raise MorphodError(
                f"campaigns {a} and {b} are in different environments, so their scores are not "
                "comparable. Score their champions in the same environments: champions(), "
                "evaluate()")
        if setting.startswith(("own_score", "settings.aggregate")):
            values = ", ".join(map(short, one["values"]))
            raise MorphodError(
                f"campaigns {a} and {b} have different settings for {setting} ({values}), so their "
                "scores are not comparable. Evaluate the champions of both instead: champions(), "
                "evaluate()")
        if setting.startswith("settings.physics."):
            values = ", ".join(map(short, one["values"]))
            raise MorphodError(
                f"campaigns {a} and {b} differ in {setting.removeprefix('settings.')} ({values}), "
                "so their scores are not comparable. Score their champions with the same physics: "
                "champions(), evaluate()")


# ---- statistics ----


def _beta_fraction(a: float, b: float, x: float) -> float:
    """The continued fraction of I_x(a, b), for x < (a + 1)/(a + b + 2) (modified Lentz)."""
    tiny = 1e-300
    c, d = 1.0, 1 - (a + b) * x / (a + 1)
    d = 1 / (tiny if abs(d) < tiny else d)
    value = d
    for m in range(1, 10001):
        change = 1.0
        for term in (m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
                     -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))):
            d = 1 + term * d
            d = 1 / (tiny if abs(d) < tiny else d)
            c = 1 + term / c
            c = tiny if abs(c) < tiny else c
            change = c * d
            value *= change
        if abs(change - 1) < sys.float_info.epsilon:
            break
    return value


def _incomplete_beta(a: float, b: float, x: float, y: float) -> float:
    """I_x(a, b); y = 1 - x, exact where x is near 1."""
    if x <= 0 or y <= 0:
        return 0.0 if x <= 0 else 1.0
    front = math.exp(math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) +
                     b * math.log(y))
    if x < (a + 1) / (a + b + 2):
        return front * _beta_fraction(a, b, x) / a
    return 1 - front * _beta_fraction(b, a, y) / b


def student_quantile(p: float, freedom: float) -> float:
    """Returns t with P(T <= t) = p of Student's distribution, for p >= 0.5, by bisection."""
    def probability(t: float) -> float:
        square = t * t
        return 1 - _incomplete_beta(freedom / 2, 0.5, freedom / (freedom + square),
                                    square / (freedom + square)) / 2

    low, high = 0.0, 1.0
    while probability(high) < p and high < 1e300:
        high *= 2
    for _ in range(200):
        middle = low + (high - low) / 2
        if not low < middle < high:
            break
        if probability(middle) < p:
            low = middle
        else:
            high = middle
    return low + (high - low) / 2


def _verdict_of(low: float, high: float) -> str:
    return "better" if high < 0 else "worse" if low > 0 else "undecided"


def _interval(difference: float, error: float, freedom: float) -> dict[str, Any]:
    half = student_quantile(0.5 + CONFIDENCE / 2, freedom) * error if error > 0 else error
    low, high = difference - half, difference + half
    return {"low": low, "high": high, "verdict": _verdict_of(low, high)}


def welch(a: Sequence[float], b: Sequence[float]) -> dict[str, Any]:
    """Compares the means of two sets that are not paired, by Welch's interval: difference (b - a),
    low, high, verdict. The interval is NaN if a set has fewer than two values."""
    first, second = np.array(a, dtype=np.float64), np.array(b, dtype=np.float64)
    difference = float(second.mean() - first.mean())
    if min(len(first), len(second)) < 2 or not math.isfinite(difference):
        return {"difference": difference, "low": math.nan, "high": math.nan,
                "verdict": "undecided"}
    errors = [float(values.var(ddof=1)) / len(values) for values in (first, second)]
    both = sum(errors)
    freedom = 1.0 if both == 0 else both**2 / (errors[0]**2 / (len(first) - 1) +
                                               errors[1]**2 / (len(second) - 1))
    return {"difference": difference, **_interval(difference, math.sqrt(both), freedom)}


def crossed(a: NDArray[np.float64], b: NDArray[np.float64]) -> dict[str, Any]:
    """Compares the losses (designs, environments) of two controllers. Losses of diverged rollouts
    are not finite. Designs and environments are both random effects, crossed: mean squares of the
    two-way layout without replication, and Satterthwaite's degrees of freedom. With one environment
    the interval holds for other designs in that environment."""
    whole = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    a, b = a[whole], b[whole]
    n, worlds = a.shape
    of_designs = (b - a).mean(axis=1)
    improved, equal = int((of_designs < 0).sum()), int((of_designs == 0).sum())
    found: dict[str, Any] = {
        "pairs": n, "mean_a": math.nan, "mean_b": math.nan, "difference": math.nan,
        "standard_error": math.nan, "low": math.nan, "high": math.nan, "verdict": "undecided",
        "improved": improved, "equal": equal, "sign_test_p": sign_test(improved, n - equal),
        "interval_for": "designs" if worlds < 2 else "designs and environments",
    }
    if n == 0:
        return found
    difference = float(of_designs.mean())
    found.update(mean_a=float(a.mean()), mean_b=float(b.mean()), difference=difference)
    if n < 2:
        return found
    error, freedom = _crossed_error(b - a)
    found.update(standard_error=error, **_interval(difference, error, freedom))
    return found


def _crossed_error(differences: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the standard error of the mean difference, and its degrees of freedom."""
    n, worlds = differences.shape
    mean = differences.mean()
    rows, columns = differences.mean(axis=1), differences.mean(axis=0)
    designs = worlds * float(((rows - mean)**2).sum()) / (n - 1)
    if worlds < 2:
        return math.sqrt(designs / n), n - 1.0
    environments = n * float(((columns - mean)**2).sum()) / (worlds - 1)
    left = differences - rows[:, None] - columns + mean
    rest = float((left**2).sum()) / ((n - 1) * (worlds - 1))
    # A component with an estimate below 0 counts as 0.
    total = designs + environments - min(rest, designs, environments)
    squares = (designs**2 / (n - 1) + environments**2 / (worlds - 1) +
               rest**2 / ((n - 1) * (worlds - 1)))
    return (math.sqrt(total / (n * worlds)),
            max(1.0, total**2 / squares) if squares > 0 else n - 1.0)


def sign_test(lower: int, n: int) -> float:
    """Returns the two-sided p of `lower` successes in n trials with even odds; NaN if n is 0."""
    least = min(lower, n - lower)
    return math.nan if n == 0 else min(1.0, 2 * _incomplete_beta(n - least, least + 1, 0.5, 0.5))


def campaign_verdict(first: Mapping[str, Any], side: Mapping[str, Any]) -> str:
    """Explains what the interval of a side shows."""
    a, b = first["campaign"], side["campaign"]
    if min(len(first["replicates"]), len(side["replicates"])) < 2:
        return (f"Cannot say whether campaign {b} is better than {a}: a confidence interval needs "
                "at least two replicates of each.")
    interval = (f"{side['difference']:+.4f}, {CONFIDENCE:.0%} confidence {side['low']:+.4f} to "
                f"{side['high']:+.4f}")
    if side["verdict"] == "undecided":
        return (f"No significant difference between campaigns {a} and {b} ({interval}). More "
                "replicates would narrow the interval.")
    return f"Campaign {b} is {side['verdict']} than {a} ({interval})."
