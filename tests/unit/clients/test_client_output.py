"""What people read of one object."""

from __future__ import annotations

import inspect

import pytest
from physworld_client.cli.app import app
from physworld_client.cli.lists import RESOURCES, Resource
from physworld_client.cli.output import print_fields
from physworld_client.client import Client
from physworld_client.names import SINGULAR
from pydantic import BaseModel
from typer.testing import CliRunner


class Thing(BaseModel):
    name: str
    metrics: dict[str, object]


def test_long_curves_are_told_by_their_length(capsys: pytest.CaptureFixture[str]) -> None:
    print_fields(Thing(name="beam", metrics={"track_m": 0.002, "curve": [0.1, None] * 20, "train": [0, 63]}))
    printed = capsys.readouterr().out
    assert '"40 numbers"' in printed
    assert "[0, 63]" in printed
    assert "0.1" not in printed


@pytest.mark.parametrize("resource", RESOURCES, ids=lambda resource: resource.name)
def test_the_table_of_lists_names_what_the_client_has(resource: Resource) -> None:
    with Client("http://127.0.0.1:1") as client:
        held = getattr(client, resource.name)
    assert resource.name in SINGULAR or not resource.shown, "its names and prefixes are looked up"
    for listing in resource.lists:
        parameters = inspect.signature(getattr(held, listing.name)).parameters
        wanted = {keyword for _, keyword, _ in listing.filters} | ({listing.of[0]} if listing.of else set())
        assert wanted <= parameters.keys(), listing
        help_text = CliRunner().invoke(app, [resource.name, listing.name, "--help"]).output
        for option in (
            "limit",
            "json",
            "url",
            "token",
            "data",
            *(option for option, _, _ in listing.filters),
        ):
            assert f"--{option}" in help_text
