"""The page of a trace, from the report, the scene and the tracks before and after.

    page = render(report, scene, tracks["before"], tracks["after"])

The report is :func:`physworld.trace.document`'s, or what an API returned; keys that a report of another version lacks
leave their part of the page out. Everything that is shown is escaped; the page loads nothing from anywhere.
"""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from typing import Any

from physworld.arrays import Array
from physworld.report import pictures, words
from physworld.report.curves import Residuals, residuals
from physworld.report.maps import carpets
from physworld.report.markup import Child, Html, scrolled, tag
from physworld.report.names import label
from physworld.report.view import script, view
from physworld.scene import Scene

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
STYLES = ("palette.css", "style.css")
_CLAIMED = ("named", "equivalent_set", "data_issue", "numerical_issue")


def render(report: dict[str, Any], scene: Scene, before: Array, after: Array) -> str:
    """The page as text.

    Args:
        report: of the trace.
        scene: the recording that was traced.
        before, after: open-loop tracks, (T, N, 3) [m].

    Raises:
        ValueError: the tracks are not those of the scene's points.
    """
    found = residuals(scene, before, after, _split(report, scene))
    sigma = report.get("held_out", {}).get("noise_floor")
    sections = [
        _head(report, found),
        _effects(report),
        _recordings(report),
        _section(
            "Before and after",
            "Open loop from frame 0: each prediction sees the grips' motion and nothing of the points after the first "
            "frame.",
            view(scene, before, after, found),
        ),
        _section(
            "Error against horizon",
            "Root mean squared coordinate error of the points that were seen. Shaded frames were used once, for this "
            "report.",
            pictures.horizon(found, sigma),
            linked=True,
        ),
        _section(
            "Where and when the residual is",
            "Measured minus predicted: its mean along each axis, and its length for every point in every frame.",
            pictures.components(found),
            carpets(found),
            linked=True,
        ),
        _chosen(report),
        _remainder(report),
        _experiment(report, sigma),
        _foot(report),
    ]
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", f"Trace of {report.get('scene', scene.name)}"),
        tag("style", Html("\n".join(files(__package__).joinpath(f).read_text() for f in STYLES))),
    )
    body = tag("body", tag("main", *sections), tag("script", Html(script())))
    return "<!doctype html>\n" + tag("html", head, body, lang="en") + "\n"


def _split(report: dict[str, Any], scene: Scene) -> int:
    """First held-out frame: the report's, else the scene's."""
    test = (report.get("split") or {}).get("test") or scene.test
    return int(test[0]) if test[1] > test[0] else scene.frame_count


def _section(heading: str, note: Child, *children: Child, linked: bool = False) -> Html:
    shown = tag("p", note, class_="quiet small") if note else None
    return tag("section", tag("h2", heading), shown, *children, data_linked=linked)


def _head(report: dict[str, Any], found: Residuals) -> Html:
    name, tone = words.VERDICTS.get(str(report.get("verdict")), (str(report.get("verdict")), "warn"))
    out, training = report.get("held_out", {}), report.get("training", {})
    changed = not found.same
    facts = [
        _fact(
            "Held-out error",
            _arrow(words.millimetres(out.get("before")), words.millimetres(out.get("after")), changed),
            _after_interval(out) if changed else _where(report, len(found.times) - found.split),
        ),
        _fact("Noise floor", words.millimetres(out.get("noise_floor")), "of one coordinate of one point"),
        _fact(
            "Part removed",
            "–" if out.get("explained_fraction") is None or not changed else f"{out['explained_fraction']:.0%}",
            "of the held-out error above the noise",
        ),
        _fact(
            "Training misfit",
            _arrow(words.number(training.get("misfit_before")), words.number(training.get("misfit_after")), changed),
            "of the noise; 1 is perfect",
        ),
    ]  # fmt: skip
    return tag(
        "header",
        tag("div", tag("span", name, class_=f"pill {tone}"), tag("span", f"trace of {report.get('scene', '')}"),
            class_="crumb"),
        tag("h1", words.headline(report)),
        tag("p", _sentence(str(report.get("reason", ""))), class_="quiet lead"),
        tag("div", *facts, class_="facts"),
    )  # fmt: skip


def _where(report: dict[str, Any], frames: int) -> str:
    unseen = sum(known.get("role") == "held_out" for known in report.get("recordings", ()))
    return f"on {unseen} recordings that are held out" if unseen else f"on {frames} frames"


def _recordings(report: dict[str, Any]) -> Html | None:
    """Errors of each recording, where there are several."""
    every = report.get("recordings", [])
    if len(every) < 2:
        return None
    rows = []
    for known in every:
        first, end = known.get("frames", (0, 0))
        role = "only measured" if known.get("role") == "held_out" else "fitted"
        numbers = [words.millimetres(known.get(key)) for key in ("before", "after", "noise_floor")]
        cells = [known.get("scene", ""), role, f"{first} to {end - 1}", *numbers]
        rows.append(tag("tr", [tag("td", cell) for cell in cells]))
    note = (
        "Material and effects are the same for all. Errors are on frames not used. Pictures show the first."
    )
    head = ("recording", "", "frames", "before", "after", "noise")
    return _section("Recordings", note, _table(head, rows))


def _fact(name: str, value: str, note: str) -> Html:
    return tag("div", tag("span", name), tag("strong", value), tag("small", note), class_="fact")


def _arrow(before: str, after: str, changed: bool) -> str:
    return f"{before} → {after}" if changed else before


def _after_interval(out: dict[str, Any]) -> str:
    ends = out.get("after_ci95") or (None, None)
    return f"after, 95 %: {words.number(_mm(ends[0]))} to {words.millimetres(ends[1])}"


def _mm(value: float | None) -> float | None:
    return None if value is None else 1e3 * value


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if not text or text.endswith(".") else ".")


def _effects(report: dict[str, Any]) -> Html | None:
    claimed = report.get("verdict") in _CLAIMED
    rows = [_parameters(effect, "found") for effect in report.get("effects", [])] if claimed else []
    rows += [_parameters(effect, "would do as well") for effect in report.get("equivalent", [])]
    calibrated = report.get("calibrated", {})
    parts: list[Child] = []
    if rows:
        parts.append(_table(("effect", "role", "number", "value", "95 % interval", "drawn"), rows))
    if calibrated:
        entries = [
            tag("tr", tag("td", label(name)), *_figure(figure)) for name, figure in calibrated.items()
        ]  # fmt: skip
        title = "Calibrated with it" if rows else "Calibrated parameters"
        parts += [
            tag("h3", title) if rows else None,
            _table(("parameter", "value", "95 % interval", "drawn"), entries),
        ]
    if not parts:
        return None
    heading = "What was found" if rows else "Calibrated parameters"
    if rows and report.get("verdict") == "numerical_issue":
        heading = "What fits best, and is not claimed"
    return _section(heading, None, *parts)


def _parameters(effect: dict[str, Any], role: str) -> list[Html]:
    rows = []
    for number, (name, figure) in enumerate(effect.get("parameters", {}).items()):
        first = (words.title(effect), role) if number == 0 else ("", "")
        rows.append(
            tag("tr", tag("td", tag("strong", first[0])), tag("td", first[1], class_="quiet"),
                tag("td", label(name)), *_figure(figure))
        )  # fmt: skip
    return rows or [tag("tr", tag("td", words.title(effect)), tag("td", role, class_="quiet"))]


def _figure(figure: dict[str, Any]) -> list[Html]:
    value = words.quantity(figure.get("value"), figure.get("unit", "1"))
    cells = (value, words.interval(figure), pictures.strength(figure))
    return [tag("td", cell) for cell in cells]


def _table(head: tuple[str, ...], rows: list[Any]) -> Html:
    table = tag("table", tag("thead", tag("tr", [tag("th", h) for h in head])), tag("tbody", *rows))
    return scrolled("Table", table)


def _chosen(report: dict[str, Any]) -> Html:
    steps: list[Child] = []
    for number, step in enumerate(report.get("path", []), start=1):
        base = " and ".join(words.title(name) for name in step.get("base", [])) or "the declared physics"
        tried = step.get("tried", [])
        steps.append(tag("h3", f"Step {number}: beside {base}"))
        if step.get("threshold") is not None:
            best = (step.get("scores") or [{}])[0]
            scored = f"Best score {best.get('score', 0.0):.3f} ({words.title(best)})"
            steps.append(tag("p", f"{scored}, threshold {step['threshold']:.3f}.", class_="quiet small"))
        if not tried:
            steps.append(tag("p", "No candidate scored enough to be refitted.", class_="quiet"))
            continue
        rows = [_tried(model, step.get("kept")) for model in tried]
        steps.append(_table(("refitted with", "misfit / noise", "left-out error", "numbers"), rows))
    refused = report.get("refused", {})
    listed = (
        tag("details", tag("summary", f"{len(refused)} effects that make no sense here, or failed"),
            _table(("effect", "why"), [tag("tr", tag("td", words.title(k)), tag("td", v)) for k, v in refused.items()]))
        if refused
        else None
    )  # fmt: skip
    return _section(
        "How it was chosen",
        "A candidate's score is the share of the training residual that it explains together with the calibrated "
        "parameters. The best are fitted with the full simulator and compared on blocks of frames that they were not "
        "fitted to, under noise and a smooth discrepancy of the twin; the posterior is how sure that comparison is.",
        pictures.candidates(report), _hypotheses(report), *steps, listed,
    )  # fmt: skip


def _hypotheses(report: dict[str, Any]) -> Html | None:
    """Every set of effects of which each removes a half of what is left without it, with its posterior."""
    known = report.get("hypotheses") or []
    if not known:
        return None
    rows = [
        tag("tr",
            tag("td", " and ".join(words.title(name) for name in one.get("effects", [])) or "the declared physics"),
            tag("td", f"{float(one.get('posterior') or 0.0):.3f}", class_="right"),
            tag("td", words.number(one.get("misfit"))), tag("td", words.number(one.get("left_out"))),
            tag("td", words.millimetres(one.get("discrepancy_m"))))
        for one in known
    ]  # fmt: skip
    return _table(
        ("set of effects", "posterior", "misfit / noise", "left-out error / noise", "discrepancy"), rows
    )


def _tried(model: dict[str, Any], kept: list[str] | None) -> Html:
    names = list(model.get("effects", []))
    values = _values(model.get("values", {}))
    return tag(
        "tr",
        tag("td", " and ".join(words.title(name) for name in names)),
        tag("td", words.number(model.get("misfit"))),
        tag("td", words.number(model.get("left_out_error"))),
        tag("td", values, class_="quiet small"),
        class_="kept" if kept is not None and names == list(kept) else None,
    )  # fmt: skip


def _values(values: dict[str, float | None]) -> str:
    return ", ".join(f"{label(k.split('.')[-1])} {words.number(v)}" for k, v in values.items())


def _remainder(report: dict[str, Any]) -> Html:
    left, training = report.get("unexplained") or {}, report.get("training", {})
    parts: list[Child] = [
        tag("p", tag("strong", f"{words.millimetres(left.get('rms_m'))} rms beyond the noise on the training frames. "),
            _sentence(str(left.get("description") or "")), class_="lead"),
    ]  # fmt: skip
    numerics = training.get("numerics") or {}
    if numerics:
        shown = "; ".join(f"{name} {words.number(value, 2)}" for name, value in numerics.items())
        parts.append(
            tag("p", f"What the solver's own choices change, over the noise: {shown}.", class_="quiet lead")
        )
    parts += [tag("p", _sentence(str(note)), class_="lead") for note in report.get("notes", [])]
    return _section("What remains", None, *parts)


def _experiment(report: dict[str, Any], sigma: float | None) -> Html:
    suggested = report.get("suggested_experiment")
    if not suggested:
        done = "None is needed to tell models apart: no other model does as well as the one above." if (
            report.get("verdict") in ("named", "nothing_to_explain")
        ) else "None was computed for this verdict."  # fmt: skip
        return _section("The experiment to run next", None, tag("p", done, class_="quiet"))
    points = json.dumps(
        {"times_s": suggested.get("times_s"), "controllers": suggested.get("controllers")}, allow_nan=False
    )
    address = "data:application/json;base64," + base64.b64encode(points.encode()).decode()
    link = (
        tag(
            "p",
            tag("a", "Controller points as JSON", href=address, download="experiment.json"),
            " for a robot or a rollout.",
        )
        if suggested.get("controllers")
        else None
    )
    return _section(
        "The experiment to run next", None, tag("blockquote", str(suggested.get("description", ""))),
        pictures.experiment(suggested, sigma), link,
    )  # fmt: skip


def _foot(report: dict[str, Any]) -> Html:
    seconds = report.get("seconds") or 0.0
    cost = f"{report.get('simulations', 0)} simulations, {words.number(seconds)} s."
    return tag(
        "footer",
        tag("p", cost, " A name means: best supported among the candidates of the library, with these data and this "
            "resolution. It is not a proof that no other cause exists."),
    )  # fmt: skip
