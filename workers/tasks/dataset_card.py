"""The card of a dataset: what its episodes cover and what was rejected, as ``card.json`` with ``coverage.svg|png``."""

from __future__ import annotations

import json
from typing import Any

from physworld.demonstrate.coverage import Coverage
from physworld_schemas.base import Artifact
from physworld_schemas.dataset import DatasetConfig
from physworld_storage.artifacts import ArtifactStore
from physworld_workers.coverage_picture import coverage_pictures
from physworld_workers.tasks.fit_report import json_safe

CARD, SVG, PNG = "card.json", "coverage.svg", "coverage.png"


def card_of(dataset_id: str, digest: str, config: DatasetConfig, coverage: Coverage) -> dict[str, Any]:
    """The card as plain JSON.

    Args:
        dataset_id: of the dataset.
        digest: SHA-256 of its manifest.
        config: of the demonstrations.
        coverage: what motions and properties the episodes reach.
    """
    return {
        "schema_version": 1,
        "dataset_id": dataset_id,
        "digest": digest,
        "config": config.model_dump(mode="json"),
        **json_safe(coverage.summary()),
        "pictures": [SVG, PNG],
    }


def store_card(
    store: ArtifactStore, dataset_id: str, digest: str, config: DatasetConfig, coverage: Coverage
) -> tuple[dict[str, Any], list[Artifact]]:
    """The card, and the artifacts of it and its pictures.

    Args:
        store: takes the three files.
        dataset_id: of the dataset.
        digest: SHA-256 of its manifest.
        config: of the demonstrations.
        coverage: what motions and properties the episodes reach.
    """
    card = card_of(dataset_id, digest, config, coverage)
    svg, png = coverage_pictures(coverage)
    text = json.dumps(card, indent=1, allow_nan=False).encode()
    artifacts = [
        store.put_bytes(text, CARD, "application/json"),
        store.put_bytes(svg, SVG, "image/svg+xml"),
        store.put_bytes(png, PNG, "image/png"),
    ]
    return card, artifacts
