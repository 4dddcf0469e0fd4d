"""Options that several commands share, and the commands that are given a connection to a service."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from physworld_client.cli import service
from physworld_client.cli.names import Named, found, help_of

Url = Annotated[str | None, typer.Option("--url", help="Address of a running service [PHYSWORLD_URL].")]
Token = Annotated[str | None, typer.Option("--token", help="API key for --url [PHYSWORLD_TOKEN].")]
Data = Annotated[
    Path | None, typer.Option("--data", help="Data folder of the embedded service [PHYSWORLD_DATA_DIR].")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Limit = Annotated[int, typer.Option("--limit", "-n", min=1, help="At most so many, newest first.")]
Out = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the files [./ID].")]
SceneName = Annotated[str, typer.Argument(help=help_of("scenes")), Named("scenes")]
TraceName = Annotated[str, typer.Argument(help=help_of("traces")), Named("traces")]
DatasetName = Annotated[str, typer.Argument(help=help_of("datasets")), Named("datasets")]
ModelName = Annotated[str, typer.Argument(help=help_of("models")), Named("models")]
LoopName = Annotated[str, typer.Argument(help=help_of("loops")), Named("loops")]
JobName = Annotated[str, typer.Argument(help=help_of("jobs")), Named("jobs")]
KeyName = Annotated[str, typer.Argument(help=help_of("keys")), Named("keys")]
"""Arguments that name one object: by id, the beginning of one, or a name."""
VersionName = Annotated[str, typer.Option("--version", help="A number, an alias, or latest.")]


def written_as(*suffixes: str) -> Callable[[Path | None], Path | None]:
    """The callback of an option that names a file to be written: its ending is one of these, or it is refused.

    What is there already and is no plain file (a pipe, ``/dev/stdout``) takes anything.
    """

    def checked(path: Path | None) -> Path | None:
        if path is None or path.suffix.lower() in suffixes or (path.exists() and not path.is_file()):
            return path
        ending = f"ends in {path.suffix!r}" if path.suffix else "has no ending"
        raise typer.BadParameter(f"{path} {ending}; it is written as {' or '.join(suffixes)}")

    return checked


JSON_FILE, NPZ_FILE, MP4_FILE, PNG_FILE, HTML_FILE, PLY_FILE = map(
    written_as, (".json", ".npz", ".mp4", ".png", ".html", ".ply")
)

CONNECTION = {"url": Url, "token": Token, "data": Data}
"""The options that say which service a command talks to, by the parameters of ``service.connect``."""


def connected(
    group: typer.Typer, name: str, options: dict[str, tuple[Any, Any]] | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Makes a command of a function whose first parameter is the client.

    On the command line the client's place is taken by ``--url``, ``--token`` and ``--data``, which stand last. An
    argument that is marked as ``Named`` may be an id, the beginning of one, or a name; the function is given the id.

    Args:
        group: where the command is added.
        name: of the command.
        options: parameters that the function takes as keywords: name, (type for typer, default). Without a
            default (``inspect.Parameter.empty``) it is an argument.
    """

    def added(function: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(function, include_extras=True)
        own = [
            parameter.replace(annotation=hints[parameter.name])
            for parameter in list(inspect.signature(function).parameters.values())[1:]
            if parameter.kind is not inspect.Parameter.VAR_KEYWORD
        ]
        more = {**(options or {}), **{option: (hint, None) for option, hint in CONNECTION.items()}}
        own += [
            inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
            for option, (annotation, default) in more.items()
        ]

        @functools.wraps(function)
        def command(**given: Any) -> None:
            where = {option: given.pop(option) for option in CONNECTION}
            with service.connect(**where) as client:
                for name, resource in named.items():
                    if given[name] is not None:
                        given[name] = found(client, resource, given[name])
                function(client, **given)

        named = {
            parameter.name: mark.resource
            for parameter in own
            for mark in getattr(parameter.annotation, "__metadata__", ())
            if isinstance(mark, Named)
        }
        parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own]
        command.__dict__["__signature__"] = inspect.Signature(parameters)
        command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        group.command(name)(command)
        return function

    return added
