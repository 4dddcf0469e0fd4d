"""The engine against closed forms and against an engine that is not ours: errors and observed orders.

    python -m benchmarks.verification.run [--json FILE] [--quick] [--docs FILE] [--picture FILE] [NAME ...]

Prints one row a case: what is measured, against what, the resolutions, the error at each, the order of convergence.
``--quick`` takes the coarsest resolutions only; ``--docs`` writes the table between its markers of a Markdown file, in
which the rows of cases that were not named stay,
``--picture`` draws it. Ends with status 1 where a case misses its limit or its least order.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import warp as wp

from benchmarks.harness import Report, write_json, write_section
from benchmarks.verification import contact as verification_contact
from benchmarks.verification import effects as verification_effects
from benchmarks.verification import peers as verification_peers
from benchmarks.verification import solids as verification_solids
from benchmarks.verification import thin as verification_thin
from benchmarks.verification import twist as verification_twist
from benchmarks.verification import updated as verification_updated
from benchmarks.verification.cases import Case, Outcome, run_case

CASES: tuple[Case, ...] = (
    *verification_solids.CASES,
    *verification_thin.CASES,
    *verification_twist.CASES,
    *verification_contact.CASES,
    *verification_effects.CASES,
    *verification_updated.CASES,
    *verification_peers.CASES,
)
NOTES = (
    "Errors are relative unless the row says otherwise; resolutions are cells along the body (dx; the time step "
    "follows), shares of the default time step (dt), or what the row names.",
    "Order: slope of log error against log step. Where the closed form idealises the body (beam theory of a solid), "
    "the order at which successive results approach each other, and in brackets the limit's distance from theory.",
    "Where no order is given the row says why: rounding (of double precision, or of the single precision of solids' "
    "strains and of the updated form's velocities); errors of both signs, which cancel at some size (the clamp's and "
    "the lumped mass's in the bending frequency, the rope's stretch and its grip in its swing, the contact's depth and "
    "its cells in a slide); the noise of a fit.",
    "“Cell face on the clamp” is how grips were held before: every node of the gripped cells is prescribed, which also "
    "fixes the slope at their face. Cell faces now lie 1/(2√3) of a cell inside the grip.",
    "The torsional frequency converges slowly because lumped masses make a cross-section of n cells too heavy to turn, "
    "by 3/n².",
    "Numerical damping: energy lost by the scheme, as the linear drag c that would take as much, over 2 ω; in the "
    "updated form nearly all of it in the transfers. "
    "The silicone beam's measured damping ratio is about 0.05.",
)


def measure(names: list[str], quick: bool) -> tuple[Report, list[Outcome]]:
    """Run the named cases, or all."""
    wp.config.quiet = True
    outcomes, seconds = [], {}
    for case in CASES:
        if names and case.name not in names:
            continue
        begun = time.perf_counter()
        outcome = run_case(case, quick)
        seconds[case.name] = time.perf_counter() - begun
        outcomes.append(outcome)
        state = "ok" if outcome.passed else "MISSED"
        print(f"{case.name:28s} {state:7s} {seconds[case.name]:6.1f} s", file=sys.stderr, flush=True)
    figures = {
        outcome.case.name: {
            "resolutions": outcome.steps,
            "errors": outcome.errors,
            "order": outcome.order,
            "limit_error": outcome.extrapolated,
            "allowed": outcome.allowed,
            "least_order": outcome.case.least_order,
            "passed": outcome.passed,
            "seconds": seconds[outcome.case.name],
        }
        for outcome in outcomes
    }
    report = Report(
        name="verification",
        title="Verification",
        figures={"cases": figures, "passed": all(outcome.passed for outcome in outcomes)},
        header=["measured", "against", "refined", "resolutions", "errors", "order"],
        rows=[_row(outcome) for outcome in outcomes],
        notes=NOTES,
    )
    return report, outcomes


def _row(outcome: Outcome) -> list[str]:
    case = outcome.case
    if outcome.order is None or case.least_order is None:
        reason = case.no_order if case.least_order is None else "not monotone"
        order = f"– {reason}" + ("" if outcome.extrapolated is None else f" ({outcome.extrapolated:+.1e})")
    else:
        order = f"{outcome.order:.1f}"
        if outcome.extrapolated is not None:
            order += f" ({outcome.extrapolated:+.1e})"
    title = case.title + ("" if outcome.passed else " **missed**")
    steps = ", ".join(f"{step:g}" for step in outcome.steps)
    return [title, case.theory, case.refined, steps, ", ".join(f"{e:+.1e}" for e in outcome.errors), order]


def _with_rows_of(docs: Path, report: Report) -> Report:
    """The report with the rows that a document has of cases which did not run, in the order of the cases."""
    rows = {str(row[0]).removesuffix(" **missed**"): row for row in report.rows}
    known = {}
    for line in docs.read_text().splitlines() if docs.exists() else ():
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        known[cells[0].removesuffix(" **missed**")] = cells
    titles = [case.title for case in CASES]
    kept = [rows.get(title, known.get(title)) for title in titles]
    return replace(report, rows=[row for row in kept if row is not None])


def draw(outcomes: list[Outcome], path: Path) -> None:
    """Errors over step size, log and log; left what the clamp's place changes, right the rest that converges."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    clamps: dict[str, str] = {}
    for outcome in outcomes:
        case = outcome.case
        name = case.name.removesuffix("_old_clamp")
        clamp = name in ("axial_frequency", "bending_frequency", "chain")
        if case.refined != "dx" or not (clamp or (outcome.order and case.least_order)):
            continue
        size = case.size or (lambda step: 1.0 / step)
        sizes = [size(step) / size(outcome.steps[0]) for step in outcome.steps]
        before = name != case.name
        (line,) = (left if clamp else right).loglog(
            sizes,
            [abs(e) for e in outcome.errors],
            "o--" if before else "o-",
            color=clamps.get(name),
            label=None if before and name in clamps else case.title,
            markersize=4,
            linewidth=1.2,
        )
        clamps[name] = line.get_color()
    for axes, title in ((left, "clamp, before (dashed) and now"), (right, "other cases refined in dx")):
        axes.loglog([1, 0.25], [3e-2, 3e-2 / 16], color="0.6", linewidth=4, alpha=0.5, label="second order")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("cell size over the coarsest")
        axes.set_ylabel("error")
        axes.grid(alpha=0.3, which="both")
    left.legend(fontsize=7, loc="lower right")
    right.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> int:
    """The command line; 0 when every case is as good as it must be."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verification.run", description=__doc__)
    parser.add_argument("names", nargs="*", help="cases; none: all")
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--quick", action="store_true", help="the coarsest resolutions only")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--picture", type=Path, default=None, help="PNG to draw")
    given = parser.parse_args()
    unknown = sorted(set(given.names) - {case.name for case in CASES})
    if unknown:
        parser.error(f"no case is called {', '.join(unknown)}; there are {', '.join(c.name for c in CASES)}")
    report, outcomes = measure(given.names, given.quick)
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)
    if given.docs is not None:
        write_section(_with_rows_of(given.docs, report), given.docs)
    if given.picture is not None:
        draw(outcomes, given.picture)
    return 0 if report.figures["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
