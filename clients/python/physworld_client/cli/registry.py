"""``physworld models compare|describe|unalias|verify|keys``: the registry beyond looking things up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli import service
from physworld_client.cli.lists import VersionName, models, show, show_list
from physworld_client.cli.options import Data, Json, Token, Url
from physworld_client.cli.output import print_json, print_table, stdout
from physworld_client.manifest import verify_folder
from physworld_client.resources import LATEST
from physworld_client.signatures import trusted_keys
from schemas.model import MeasuredError, ModelComparison
from schemas.signing import SigningKey

PublicKey = Annotated[
    str | None, typer.Option("--public-key", help="The only key that may have signed, base64.")
]


@models.command("compare")
def models_compare(
    name: str,
    a: Annotated[str, typer.Argument(help="A number, an alias, or latest.")],
    b: Annotated[str, typer.Argument(help="A number, an alias, or latest.")] = LATEST,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Two versions side by side: errors with intervals, gains, and what differs in how they were made."""
    with service.connect(url, token, data) as client:
        found = client.models.compare(name, a, b)
    if json:
        print_json(found)
    else:
        _print_comparison(found)


@models.command("describe")
def models_describe(
    name: str,
    version: VersionName = LATEST,
    description: Annotated[str | None, typer.Option(help="New description.")] = None,
    tag: Annotated[list[str] | None, typer.Option(help="Tags from now on; repeatable.")] = None,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Change description and tags of a version; its files never change."""
    with service.connect(url, token, data) as client:
        tags = None if tag is None else tuple(tag)
        show(client.models.update(name, version, description=description, tags=tags), json)


@models.command("unalias")
def models_unalias(name: str, alias: str, url: Url = None, token: Token = None, data: Data = None) -> None:
    """Remove an alias; the version stays."""
    with service.connect(url, token, data) as client:
        client.models.delete_alias(name, alias)
    stdout.print(f"{name}@{alias} is no more")


@models.command("verify")
def models_verify(
    folder: Annotated[Path, typer.Argument(help="A folder that `models download` wrote.")],
    public_key: PublicKey = None,
) -> None:
    """Check signature and digests of a downloaded version, without the service."""
    manifest = verify_folder(folder, keys=trusted_keys(public_key))
    stdout.print(
        f"{manifest.name} version {manifest.version}: {len(manifest.files)} files and the signature are good"
    )


@models.command("keys")
def models_keys(json: Json = False, url: Url = None, token: Token = None, data: Data = None) -> None:
    """The public keys that sign, or once signed, this service's models."""

    def row(key: SigningKey) -> tuple[str, ...]:
        return (key.key_id, key.algorithm, key.public_key, f"{key.created_at:%Y-%m-%d}")

    with service.connect(url, token, data) as client:
        keys = client.models.signing_keys()
    show_list(keys, len(keys), json, ("key", "algorithm", "public key", "since"), row)


def _print_comparison(found: ModelComparison) -> None:
    first, second = f"version {found.a}", f"version {found.b}"
    if not found.same_recording:
        stdout.print("The versions were scored on different frames: no gains.")
    rows = [
        (item.metric, item.predictor, _millimetres(item.a), _millimetres(item.b), _millimetres(item.gain))
        for item in found.errors
    ]
    print_table(("error [mm]", "predictor", first, second, "gain of b"), rows)
    for heading, items in (("figure", found.figures), ("made with", found.differences)):
        stdout.print()
        print_table((heading, first, second), [(item.field, _text(item.a), _text(item.b)) for item in items])


def _millimetres(error: MeasuredError | None) -> str:
    """``1.76 (1.42 to 2.1)``."""
    if error is None:
        return "–"
    interval = "" if error.ci95 is None else f" ({1e3 * error.ci95[0]:.3g} to {1e3 * error.ci95[1]:.3g})"
    return f"{1e3 * error.value:.3g}{interval}"


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "–" if value is None else str(value)
