"""The study's tables, from the cases' results."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

_NOTHING, _UNEXPLAINED, _SUFFICIENT, _ERROR = "nothing", "unexplained", "model_sufficient", "error"
_PARAMETERS = ("K", "alpha", "B_sp")


@dataclass(frozen=True)
class Table:
    """A table with its title; cells are ready text."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def text(self, *, markdown: bool) -> str:
        """For a terminal, or for a page."""
        if markdown:
            lines = ["| " + " | ".join(row) + " |" for row in (self.columns, ("---",) * len(self.columns), *self.rows)]
            return f"### {self.title}\n\n" + "\n".join(lines)
        widths = [max(len(row[i]) for row in (self.columns, *self.rows)) for i in range(len(self.columns))]
        lines = [
            "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in (self.columns, *self.rows)
        ]
        return "\n".join([self.title, *(line.rstrip() for line in lines)])


def verdict(result: dict) -> str:
    """How a case with one hidden effect, or with none, ended.

    right, tied (the truth is among what can't be told from the first effect), wrong, missed, unexplained, error; of a
    clean case right where the model suffices, or false alarm. What nobody's catalogue holds, and what was left out of
    it, is right where it is called unexplained or unknown, and tied where look-alikes are stated, or that something
    unknown is missing beside a name.
    """
    truth = result["case"]["families"]
    if result["error"]:
        return "error"
    named = result["families"]
    if not truth:
        return "right" if result["decision"] == _SUFFICIENT else "false alarm"
    unknown = result["leave_out"] or truth == ["unknown"]
    if result["decision"] == _UNEXPLAINED and (unknown or not named):
        return "right" if unknown else "unexplained"
    if not named:
        return "missed"
    if unknown:
        return "right" if named[0] == "unknown" else "tied" if result["ties"] or result["unknown_beside"] else "wrong"
    if named[0] in truth:
        return "right"
    return "tied" if set(truth) & set(result["ties"]) else "wrong"


def tables(results: Sequence[dict]) -> list[Table]:
    """All tables that the results have cases for."""
    left_out = [r for r in results if r["leave_out"]]
    usual = [r for r in results if not r["leave_out"]]
    single = [r for r in usual if len(r["case"]["families"]) == 1]
    pairs = [r for r in usual if len(r["case"]["families"]) == 2]
    clean = [r for r in usual if not r["case"]["families"]]
    found = []
    if single:
        found += [
            _confusion(single),
            _verdicts("Hidden effect, by strength", sorted(single, key=_limits), _by_strength),
            _look_alikes(single),
        ]
    if clean:
        found.append(_false_alarms(clean))
    if pairs:
        found.append(_pairs(pairs))
    if left_out:
        found += [
            _verdicts("Family left out of the catalogue", left_out, lambda r: r["case"]["families"][0]),
            _verdicts("Family left out, by the strength of its effect", sorted(left_out, key=_limits), _by_strength),
        ]
    done = [r for r in results if not r["error"]]
    if done:
        found += [_errors(done), _bias(done), _costs(results)]
    if any("baselines" in r for r in results):
        found.append(_baselines([r for r in results if "baselines" in r]))
    return found


def _share(count: int, of: int) -> str:
    """A share with its exact 95 % interval (Clopper, Pearson)."""
    interval = binomtest(count, of).proportion_ci()
    return f"{100 * count / of:.1f} % ({count} of {of}; {100 * interval.low:.1f} to {100 * interval.high:.1f} %)"


def _named(result: dict) -> str:
    if result["error"]:
        return _ERROR
    ended = verdict(result)
    if ended == "tied":
        return "tied with truth"
    if result["families"]:
        return result["families"][0]
    return _UNEXPLAINED if result["decision"] == _UNEXPLAINED else _NOTHING


def _confusion(results: Sequence[dict]) -> Table:
    """Rows are the truth; cells count the first named family."""
    truths = list(dict.fromkeys(r["case"]["families"][0] for r in results))
    counts = Counter((r["case"]["families"][0], _named(r)) for r in results)
    others = sorted({named for _, named in counts} - set(truths) - {"tied with truth"})
    columns = ("truth", "right", "tied with truth", "named otherwise")
    rows = []
    for truth in truths:
        wrong = [
            f"{name} {counts[truth, name]}" for name in (*truths, *others) if name != truth and counts[truth, name]
        ]
        row = (truth, str(counts[truth, truth]), str(counts[truth, "tied with truth"]), ", ".join(wrong))
        rows.append(row)
    good = sum(verdict(r) in ("right", "tied") for r in results)
    rows.append(("all", _share(good, len(results)) + " right or tied", "", ""))
    return Table("First family named (rows: truth)", columns, rows)


def _look_alikes(results: Sequence[dict]) -> Table:
    """What can't be told from the first effect that was named, by the hidden family."""
    groups = list(dict.fromkeys(r["case"]["families"][0] for r in results))
    rows = []
    for truth in groups:
        chosen = [r for r in results if r["case"]["families"][0] == truth and not r["error"]]
        tied = [set(r["ties"]) - {r["families"][0]} for r in chosen if r["families"]]
        counts = Counter(family for families in tied for family in families)
        told = ", ".join(f"{name} {count}" for name, count in counts.most_common())
        rows.append((truth, str(len(chosen)), str(sum(bool(families) for families in tied)), told))
    return Table("Look-alikes: families tied with the first one named", ("hidden", "cases", "with ties", "tied"), rows)


def in_proportion(pairs: Sequence[tuple[dict, dict]]) -> Table:
    """How often refitting every form changes what is said.

    Args:
        pairs: results of the same case, as usual and with every form refitted.
    """

    def said(result: dict) -> tuple:
        return result.get("decision"), tuple(result.get("families") or ())

    def name(result: dict) -> str:
        names = ", ".join(result.get("names") or ()) or str(result.get("decision"))
        return f"{result['case']['name']}: {names}"

    other = [(plain, all_forms) for plain, all_forms in pairs if said(plain) != said(all_forms)]
    rows = [("decision or families", _share(len(other), len(pairs)), "; ".join(name(plain) for plain, _ in other))]
    rows.append(("with every form", "", "; ".join(name(all_forms) for _, all_forms in other)))
    ratio = np.median([all_forms["seconds"] / plain["seconds"] for plain, all_forms in pairs])
    rows.append(("time, times as long (median)", f"{ratio:.1f}", ""))
    return Table("What refitting every form changes", ("", "share", "cases"), rows)


def _limits(result: dict) -> float:
    return min(result["case"]["detection_limits"])


def _by_strength(result: dict) -> str:
    for most in (20, 1000):
        if _limits(result) <= most:
            return f"up to {most} detection limits"
    return "above"


def _verdicts(title: str, results: Sequence[dict], key: Callable[[dict], str]) -> Table:
    names = ("right", "tied", "wrong", "missed", "unexplained", "error")
    groups = list(dict.fromkeys(key(r) for r in results))
    rows = []
    for group in [*groups, "all"]:
        counts = Counter(verdict(r) for r in results if group in (key(r), "all"))
        good = counts["right"] + counts["tied"]
        rows.append((group, *(str(counts[name]) for name in names), _share(good, counts.total())))
    return Table(title, ("", *names, "right or tied"), rows)


def _false_alarms(results: Sequence[dict]) -> Table:
    groups: dict[str, list[dict]] = {}
    for result in results:
        groups.setdefault(_noise_of(result["case"]), []).append(result)
    rows = []
    for name, chosen in (*groups.items(), ("all", results)):
        alarms = [r for r in chosen if verdict(r) != "right"]
        told = Counter(_named(r) for r in alarms)
        rows.append((name, _share(len(alarms), len(chosen)), ", ".join(f"{k} {n}" for k, n in told.items())))
    return Table("Clean cases: false alarms", ("noise", "rate", "named"), rows)


def _noise_of(case: dict) -> str:
    """The kind of noise, by the case's name."""
    if case["name"].endswith("-remembering"):
        return "noise with a memory altogether"
    return ("coloured" if case["coloured"] else "white") + (
        " noise, noisy torque" if case["torque_noise"] else " noise"
    )


def _pairs(results: Sequence[dict]) -> Table:
    def found(result: dict) -> int:
        if result["error"]:
            return 0
        said = set(result["families"]) | set(result["all_ties"])
        return len(set(result["case"]["families"]) & said)

    counts = Counter(found(r) for r in results)
    strict = sum(not r["error"] and set(r["case"]["families"]) <= set(r["families"]) for r in results)
    rows = [
        ("both named", _share(strict, len(results))),
        ("both named or tied", _share(counts[2], len(results))),
        ("one", str(counts[1])),
        ("none", str(counts[0])),
    ]
    return Table("Pairs of effects", ("found", "cases"), rows)


def _errors(results: Sequence[dict]) -> Table:
    """Free run along the held-out log over the noise of the dynamic error; beside it what the true equations leave,
    started from what the same few samples tell."""
    rows = []
    groups = {
        "clean": [r for r in results if not r["case"]["families"]],
        "one effect": [r for r in results if len(r["case"]["families"]) == 1 and not r["leave_out"]],
        "two effects": [r for r in results if len(r["case"]["families"]) == 2],
        "left out": [r for r in results if r["leave_out"]],
    }
    for name, chosen in groups.items():
        if not chosen:
            continue
        cells = [name]
        noise = np.array([r["case"]["noise"] for r in chosen])
        # A run that left the numbers is stored as null.
        found = {stage: np.array([r["held_out"][stage] or np.inf for r in chosen]) for stage in ("before", "after")}
        truth = np.hypot(noise, [r["case"]["own_error"] for r in chosen])
        for ratios in (found["before"] / noise, found["after"] / noise, truth / noise, found["after"] / truth):
            cells += [f"{np.median(ratios):.3g}", f"{np.quantile(ratios, 0.9, method='higher'):.3g}"]
        rows.append(tuple(cells))
    stages = ("before", "after", "true equations", "after, over true equations")
    columns = ("cases", *(f"{stage}: {figure}" for stage in stages for figure in ("median", "90 %")))
    return Table("Held-out free-run error over noise", columns, rows)


def _bias(results: Sequence[dict]) -> Table:
    """Of cases in which the parameter has one true value: nothing hidden that redefines it."""
    rows = []
    for name in _PARAMETERS:
        for stage in ("before", "after"):
            known = []
            for result in results:
                truth = result["case"]["base"][name]
                entry = result[stage].get(name)
                if entry is None or name in result["case"]["undefined"] or None in (entry["value"], entry["std"]):
                    continue
                low, high = entry["ci95"]
                inside = (low is None or low <= truth) and (high is None or truth <= high)
                off = entry["value"] - truth
                known.append(
                    (off / entry["std"] if entry["std"] else np.inf, 100 * off / truth if truth else np.nan, inside)
                )
            if known:
                sigmas, percent, inside = (np.array(column, float) for column in zip(*known, strict=True))
                rows.append(
                    (
                        name,
                        stage,
                        f"{np.median(sigmas):+.2g}",
                        f"{np.median(np.abs(sigmas)):.2g}",
                        f"{np.nanmedian(percent):+.2g} %",
                        f"{np.nanmedian(np.abs(percent)):.2g} %",
                        _share(int(inside.sum()), inside.size),
                    )
                )
    columns = (
        "parameter",
        "model",
        "bias, standard errors (median)",
        "its size",
        "bias, percent (median)",
        "its size",
        "95 % intervals that hold the truth",
    )
    return Table("Bias of the base parameters", columns, rows)


def _costs(results: Sequence[dict]) -> Table:
    seconds = np.array([r["seconds"] for r in results])
    row = (str(seconds.size), f"{np.median(seconds):.0f}", f"{np.quantile(seconds, 0.9):.0f}", f"{seconds.max():.0f}")
    return Table("Seconds a case", ("cases", "median", "90 %", "most"), [row])


def _baselines(results: Sequence[dict]) -> Table:
    """The same cases, by others."""
    single = [r for r in results if len(r["case"]["families"]) == 1 and not r["leave_out"]]
    clean = [r for r in results if not r["case"]["families"]]
    rows = []
    for name, named in (
        ("hdjax", lambda r: r.get("families") or []),
        ("greedy BIC", lambda r: r["baselines"]["greedy_bic"]),
    ):
        right = sum(bool(named(r)) and named(r)[0] in r["case"]["families"] for r in single)
        alarms = sum(bool(named(r)) for r in clean)
        error = (
            _median_error(results, lambda r: (r.get("held_out") or {}).get("after")) if name == "hdjax" else "none made"
        )
        rows.append(
            (
                name,
                _share(right, len(single)) if single else "",
                _share(alarms, len(clean)) if clean else "",
                error,
            )
        )
    black_box = _median_error(results, lambda r: r["baselines"]["black_box"])
    rows.append(("polynomial autoregression", "names nothing", "", black_box))
    sparse = [r for r in results if "sindy" in r["baselines"]]
    if sparse:
        rows.append(("PySINDy", "names nothing", "", _median_error(sparse, lambda r: r["baselines"]["sindy"])))
    columns = (
        "method",
        "first family right, ties not counted",
        "false alarms on clean cases",
        "held-out error over noise",
    )
    return Table("Baselines on the same cases", columns, rows)


def _median_error(results: Sequence[dict], error: Callable[[dict], float | None]) -> str:
    ratios = [(error(r) or np.inf) / r["case"]["noise"] for r in results]
    return f"{np.median(ratios):.3g} (median), {np.quantile(ratios, 0.9, method='higher'):.3g} (90 %)"
