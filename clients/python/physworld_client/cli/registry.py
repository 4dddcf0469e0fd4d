"""``physworld models …``: versions, aliases, comparison, signatures; their lists are made in ``lists``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli import service
from physworld_client.cli.lists import GROUPS, show_list
from physworld_client.cli.names import found
from physworld_client.cli.options import Data, Json, ModelName, Out, Token, Url, VersionName, connected
from physworld_client.cli.output import print_json, print_table, show, stdout
from physworld_client.cli.report import shown_unit
from physworld_client.client import Client
from physworld_client.known_keys import trusted_keys
from physworld_client.manifest import verify_folder
from physworld_client.resources import LATEST
from physworld_client.signatures import fingerprint_of
from physworld_client.types import ModelComparison, SigningKey
from physworld_schemas.library import Metric, catalogue
from physworld_schemas.model import MeasuredError

MODELS = GROUPS["models"]
PublicKey = Annotated[
    str | None, typer.Option("--public-key", help="The only key that may have signed: base64, or a file.")
]
Key = Annotated[str, typer.Argument(help="A fingerprint (`models keys`), a key in base64, or a file.")]


@connected(MODELS, "compare")
def models_compare(
    client: Client,
    name: ModelName,
    a: Annotated[str, typer.Argument(help="A number, an alias, or latest.")],
    b: Annotated[str, typer.Argument(help="A number, an alias, or latest.")] = LATEST,
    json: Json = False,
) -> None:
    """Two versions side by side: errors with intervals, gains, and what differs in how they were made."""
    compared = client.models.compare(name, a, b)
    if json:
        print_json(compared)
    else:
        _print_comparison(compared)


@connected(MODELS, "show")
def models_show(client: Client, name: ModelName, version: VersionName = LATEST, json: Json = False) -> None:
    """One version of a model."""
    show(client.models.version(name, version), json)


@connected(MODELS, "alias")
def models_alias(client: Client, name: ModelName, alias: str, version: int) -> None:
    """Point an alias at a version."""
    client.models.set_alias(name, alias, version)
    stdout.print(f"{name}@{alias} is version {version}")


@connected(MODELS, "describe")
def models_describe(
    client: Client,
    name: ModelName,
    version: VersionName = LATEST,
    description: Annotated[str | None, typer.Option(help="New description.")] = None,
    tag: Annotated[list[str] | None, typer.Option(help="Tags from now on; repeatable.")] = None,
    json: Json = False,
) -> None:
    """Change description and tags of a version; its files never change."""
    tags = None if tag is None else tuple(tag)
    show(client.models.update(name, version, description=description, tags=tags), json)


@connected(MODELS, "unalias")
def models_unalias(client: Client, name: ModelName, alias: str) -> None:
    """Remove an alias; the version stays."""
    client.models.delete_alias(name, alias)
    stdout.print(f"{name}@{alias} is no more")


@MODELS.command("download")
def models_download(
    name: ModelName,
    version: VersionName = LATEST,
    out: Out = None,
    trust: Annotated[
        str | None, typer.Option("--trust", help="A key to trust first: fingerprint, base64, or a file.")
    ] = None,
    public_key: PublicKey = None,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Download a version; verify its signature and every file."""
    address = service.require(url, token, data)
    only = None if public_key is None else _key(public_key)
    own = address.signing_key if only is None else None
    key = own if trust is None else _key(trust)
    with address.client() as client:
        name = found(client, "models", name)
        number = client.models.version(name, version).version
        folder = out or Path(f"{name}-{number}")
        got = client.models.download(name, folder, number, trust=key, public_key=only)
    stdout.print(
        f"{name} version {number}, sha256 {got.sha256}: verified in {folder.absolute()}", soft_wrap=True
    )


@MODELS.command("verify")
def models_verify(
    folder: Annotated[Path, typer.Argument(help="A folder that `models download` wrote.")],
    public_key: PublicKey = None,
) -> None:
    """Check signature and digests of a downloaded version, without the service."""
    keys = trusted_keys(None if public_key is None else _key(public_key))
    manifest = verify_folder(folder, keys=keys)
    stdout.print(
        f"{manifest.name} version {manifest.version}: {len(manifest.files)} files and the signature are good"
    )


@connected(MODELS, "keys")
def models_keys(client: Client, json: Json = False) -> None:
    """The public keys that sign, or once signed, this service's models, and whether they are trusted here."""
    keys = client.models.signing_keys()
    pinned = client.known_keys.of(client.known_as) or {}

    def row(key: SigningKey) -> tuple[str, ...]:
        mark = fingerprint_of(key.public_key)
        return (mark, key.algorithm, f"{key.created_at:%Y-%m-%d}", "yes" if mark in pinned else "no")

    show_list(keys, len(keys), json, ("fingerprint", "algorithm", "since", "trusted here"), row)


@connected(MODELS, "trust")
def models_trust(client: Client, key: Key) -> None:
    """Trust a key to sign this service's models, beside those that are."""
    mark = client.models.trust(_key(key))
    stdout.print(f"{mark} is trusted for {client.known_as}", soft_wrap=True)


@connected(MODELS, "distrust")
def models_distrust(
    client: Client,
    fingerprint: Annotated[str, typer.Argument(help="Of a key that is trusted (`models keys`).")],
) -> None:
    """Trust a key no more to sign this service's models."""
    client.models.distrust(fingerprint)
    stdout.print(f"{fingerprint} is trusted no more for {client.known_as}", soft_wrap=True)


def _key(given: str) -> str | Path:
    """A key, or the file of that name."""
    path = Path(given)
    return path if path.is_file() else given


def _print_comparison(found: ModelComparison) -> None:
    first, second = f"version {found.a}", f"version {found.b}"
    if not found.same_recording:
        stdout.print("The versions were scored on different frames: no gains.")
    rows = [
        (f"{metric.title}{shown_unit(metric)}", item.predictor, *(_error(one, metric) for one in three))
        for item in found.errors
        for metric in [catalogue().metric(item.metric)]
        for three in [(item.a, item.b, item.gain)]
    ]
    print_table(("metric", "predictor", first, second, "gain of b"), rows)
    for heading, items in (("figure", found.figures), ("made with", found.differences)):
        stdout.print()
        print_table((heading, first, second), [(item.field, _text(item.a), _text(item.b)) for item in items])


def _error(error: MeasuredError | None, metric: Metric) -> str:
    """``1.76 (1.42 to 2.1)``, lengths in millimetres."""
    if error is None:
        return "–"
    scale = 1e3 if metric.unit == "m" else 1.0
    interval = "" if error.ci95 is None else f" ({scale * error.ci95[0]:.3g} to {scale * error.ci95[1]:.3g})"
    return f"{scale * error.value:.3g}{interval}"


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "–" if value is None else str(value)
