"""The words that people type over a list: each has to stand somewhere in an object, in any case.

What is searched is what the lists show: identifiers, names, states. The name of a scene finds its objects too.
"""

from __future__ import annotations

import json
from typing import Any, TypeVar

from sqlalchemy import JSON, ColumnElement, Select, String, cast, or_, select
from sqlalchemy.orm import InstrumentedAttribute

from physworld_storage.tables import DatasetRow, FitRow, JobRow, SceneRow

Found = TypeVar("Found", bound=Select[Any])
MOST_WORDS = 8
MOST_NAMED = 60
"""Scenes by whose name a job is found, and as many of their fits and datasets."""


def words_of(text: str | None) -> list[str]:
    """The words of a search, the first few."""
    return (text or "").split()[:MOST_WORDS]


def matching(
    statement: Found,
    text: str | None,
    *columns: InstrumentedAttribute[Any],
    scene_id: InstrumentedAttribute[Any] | None = None,
) -> Found:
    """The statement with every word of ``text`` in one of the columns, or in the name of the scene of ``scene_id``."""
    for word in words_of(text):
        places: list[ColumnElement[bool]] = [_holds(column, word) for column in columns]
        if scene_id is not None:
            places.append(scene_id.in_(select(SceneRow.id).where(_holds(SceneRow.name, word))))
        statement = statement.where(or_(*places))
    return statement


def matching_jobs(statement: Found, text: str | None) -> Found:
    """The same of jobs: by their id, kind and state, by what they work on and make, and by the name of their scene."""
    for word in words_of(text):
        places = [_holds(column, word) for column in (JobRow.id, JobRow.kind, JobRow.state)]
        places += [_holds(column, word) for column in (JobRow.inputs, JobRow.outputs)]
        places.append(JobRow.config["model_name"].as_string().icontains(word, autoescape=True))
        named = select(SceneRow.id).where(_holds(SceneRow.name, word)).limit(MOST_NAMED)
        made = [
            select(row.id).where(row.scene_id.in_(named)).limit(MOST_NAMED) for row in (FitRow, DatasetRow)
        ]
        first = JobRow.inputs[(0, "id")].as_string()
        places += [first.in_(found) for found in (named, *made)]
        statement = statement.where(or_(*places))
    return statement


def listing(column: InstrumentedAttribute[Any], text: str) -> ColumnElement[bool]:
    """Whether a column that lists texts has this one, in any case."""
    return cast(column, String).icontains(json.dumps(text), autoescape=True)


def _holds(column: InstrumentedAttribute[Any], word: str) -> ColumnElement[bool]:
    """Whether a text, or a column of JSON as text, holds a word."""
    written = json.dumps(word)[1:-1] if isinstance(column.type, JSON) else word
    return cast(column, String).icontains(written, autoescape=True)
