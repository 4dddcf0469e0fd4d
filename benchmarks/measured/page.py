"""The figures of ``python -m benchmarks.measured`` as the section of ``docs/measured.md``."""

from __future__ import annotations

from typing import Any

from benchmarks.harness import Report
from benchmarks.measured.scoring import WHOLE

ABSENT = "-"


def report(document: dict[str, Any]) -> Report:
    """The table of held-out errors, and the smaller ones under it as notes."""
    recordings = document["recordings"]
    names = _in_order(recordings)
    rows = [
        [name, entry.get("kind", ABSENT), mm(entry.get("noise_floor_m")), *_errors(entry["track_m"], names)]
        for name, entry in recordings.items()
    ]
    settings = document["settings"]
    return Report(
        name="measured",
        title="Held-out frames of every recording",
        figures=document,
        header=["recording", "kind", "floor", *(name.replace("_", " ") for name in names)],
        rows=rows,
        notes=[
            "Track error [mm] on the held-out frames, in open loop from the first frame; the least is bold, the "
            f"floor is what a perfect prediction would show. {ABSENT}: refused or failed, see below.",
            f"Fits by the default, at most {settings['max_simulations']} simulations of about "
            f"{settings['particle_budget']} particles; they and the peers saw the training frames alone.",
            *_horizons(recordings),
            *_transfers(document["transfers"]),
            *_published(recordings),
            *_failures(recordings),
        ],
        machine=document["machine"],
    )


def mm(value: float | None) -> str:
    """Millimetres in three digits, or a dash."""
    return ABSENT if value is None else f"{1e3 * value:.3g}"


def _in_order(recordings: dict[str, Any]) -> list[str]:
    """The twin first, then every predictor that any recording has."""
    names = ["twin"]
    for entry in recordings.values():
        names += [name for name in entry["track_m"] if name not in names]
    return names


def _errors(track: dict[str, float | None], names: list[str]) -> list[str]:
    known = [value for value in track.values() if value is not None]
    return [
        f"**{mm(track[name])}**" if known and track.get(name) == min(known) else mm(track.get(name))
        for name in names
    ]


def _horizons(recordings: dict[str, Any]) -> list[str]:
    """One note a kind of horizon: the twin against its nearest rival, recording by recording."""
    notes = []
    for kind, said in (
        ("open_loop", "Mean error up to a horizon, from the first frame (mostly fitted frames)"),
        ("restarted", "The same from the first held-out frame, the state given anew there (no frame fitted)"),
    ):
        parts = []
        for name, entry in recordings.items():
            found = entry.get("horizons", {}).get(kind, {})
            curve = found.get("horizons", {}) if kind == "restarted" else found
            steps = [
                f"{horizon}{'' if horizon == WHOLE else ' s'} {_beside(at['track_m'])}"
                for horizon, at in curve.items()
            ]
            if steps:
                parts.append(f"{name}: {', '.join(steps)}")
        if parts:
            notes.append(f"{said}, twin / best of the others [mm]. {'; '.join(parts)}.")
    return notes


def _beside(track: dict[str, float | None]) -> str:
    others = [value for name, value in track.items() if name != "twin" and value is not None]
    return f"{mm(track.get('twin'))} / {mm(min(others) if others else None)}"


def _transfers(transfers: dict[str, Any]) -> list[str]:
    if not transfers:
        return []
    parts = []
    for name, entry in transfers.items():
        here = entry["held_out_track_m"]
        hertz = [ABSENT if value is None else f"{value:.2f}" for value in entry["frequency_hz"].values()]
        parts.append(
            f"{name} {_beside(entry['track_m'])}, on held-out frames {mm(here.get('twin'))} (fitted there: "
            f"{mm(here['twin_fitted_here'])}), {hertz[0]} Hz of {hertz[1]} measured"
        )
    return [
        "Material of one recording in another, over all its frames, twin / best of the others [mm] (what belongs to a "
        "recording, such as a rod's rest shape, is found on its training frames): " + "; ".join(parts) + "."
    ]


def _published(recordings: dict[str, Any]) -> list[str]:
    entries = {
        (entry["model"], entry["citation"]): entry
        for of in recordings.values()
        for entry in of.get("published", [])
    }
    return [
        f"Published, {entry['model']} ({entry['citation']}): {mm(entry['value'])}{' mm' if entry['value'] else ''}, "
        f"{entry['metric']}; {entry['reason']}."
        for entry in entries.values()
    ]


def _failures(recordings: dict[str, Any]) -> list[str]:
    """What was refused or failed: every reason once, with the recordings that it holds for."""
    who: dict[tuple[str, str], list[str]] = {}
    for name, entry in recordings.items():
        for predictor, reason in entry["reason"].items():
            who.setdefault((predictor, reason), []).append(name)
    return [f"No {predictor} of {', '.join(of)}: {reason}." for (predictor, reason), of in who.items()]
