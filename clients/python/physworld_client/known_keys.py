"""The public keys that this machine trusts to sign models, pinned by service as ``known_hosts`` of ssh pins hosts.

The first download that verifies pins the keys that its service lists. From then on a model is accepted only if one of
them signed it; a key that the service lists later is accepted only once it was trusted by hand (``trust``), beside the
older ones or, after ``distrust``, in their place. The file is ``PHYSWORLD_KNOWN_KEYS``, else
``physworld/known-keys.json`` below ``XDG_CONFIG_HOME`` or ``~/.config``:

    {"format": 2, "services": {service: {fingerprint: {"public_key", "how": "first use" | "trusted", "since"}}}}

It changes in one step and under a lock. A service stays known when its last key was distrusted: there is no second
first use.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from physworld_client.errors import ModelUnreadable, SignatureInvalid
from physworld_client.locks import locked
from physworld_client.signatures import TrustedKeys, fingerprint_of, given_key, keys_by_id, listed_keys
from physworld_schemas.signing import SigningKey
from physworld_schemas.wording import reason

FORMAT = 2
FINGERPRINT = re.compile(r"[0-9a-f]{64}")

Services = dict[str, dict[str, dict[str, str]]]


class KnownKeys:
    """The file of pinned keys.

    Args:
        path: of the file; by default the one of this machine.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = known_keys_file() if path is None else Path(path)

    def of(self, service: str) -> dict[str, str] | None:
        """Keys pinned for a service by fingerprint; None for one that was never met. Raises ModelUnreadable."""
        found = self._read().get(service)
        return None if found is None else {mark: entry["public_key"] for mark, entry in found.items()}

    def anyones(self) -> TrustedKeys:
        """Keys pinned for any service, for a folder that is opened without one. Raises ModelUnreadable."""
        texts = [entry["public_key"] for keys in self._read().values() for entry in keys.values()]
        return TrustedKeys(keys_by_id(texts), "known here")

    def expected(self, service: str, listed: Iterable[SigningKey]) -> TrustedKeys:
        """Keys that may have signed what a service gives: the pinned ones, at a first contact those that it lists.

        Raises:
            SignatureInvalid: the service lists a key under another key's id.
            ModelUnreadable: the file is damaged.
        """
        offered = listed_keys(listed, service)
        pinned = self.of(service)
        keys = offered if pinned is None else keys_by_id(pinned.values())
        return TrustedKeys(keys, f"trusted for {service}", service, offered)

    def met(self, keys: TrustedKeys) -> None:
        """Pins the keys of a first contact, after one of them was seen to have signed. Raises ModelUnreadable."""
        service = keys.service
        if service is None or self.of(service) is not None:
            return
        with self._changing() as services:
            if service not in services:
                services[service] = dict(_entry(text, "first use") for text in keys.by_id.values())

    def trust(self, service: str, key: str | Path, listed: Iterable[SigningKey] = ()) -> str:
        """Pins a key for a service beside those that are; its fingerprint.

        Args:
            key: a fingerprint of ``listed``, a public key in base64, or the path of a file with one of them.

        Raises:
            SignatureInvalid: the fingerprint is of no key in ``listed``.
            ModelUnreadable: it is no key, or the file of known keys is damaged or cannot be written.
        """
        text = given_key(key)
        if is_fingerprint(text):
            text = _with_fingerprint(text.lower(), listed_keys(listed, service), service)
        mark, entry = _entry(text, "trusted")
        if mark not in (self.of(service) or {}):
            with self._changing() as services:
                services.setdefault(service, {})[mark] = entry
        return mark

    def distrust(self, service: str, fingerprint: str) -> None:
        """Removes a key of a service. Raises ModelUnreadable when it is not pinned."""
        mark = fingerprint.strip().lower()
        with self._changing() as services:
            if mark not in services.get(service, {}):
                held = ", ".join(services.get(service, {})) or "none"
                raise ModelUnreadable(f"{mark[:80]!r} is no key that is trusted for {service}; there: {held}")
            del services[service][mark]

    def _read(self) -> Services:
        """Raises ModelUnreadable."""
        if not self.path.is_file():
            return {}
        try:
            held = json.loads(self.path.read_bytes())
            services = held["services"] if "services" in held else _of_first_format(held)
            for keys in services.values():
                for mark, entry in keys.items():
                    if fingerprint_of(entry["public_key"]) != mark:
                        raise ValueError(f"{mark} is not the fingerprint of its key")
        except (ValueError, KeyError, TypeError, AttributeError, ModelUnreadable) as error:
            raise ModelUnreadable(f"{self.path} is not a file of known keys: {reason(error)}") from error
        return dict(services)

    @contextmanager
    def _changing(self) -> Iterator[Services]:
        """What is pinned, to be changed; written at the end, in one step. Raises ModelUnreadable."""
        part = self.path.with_name(f"{self.path.name}.part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with locked(self.path.with_name(f"{self.path.name}.lock")):
                services = self._read()
                yield services
                part.touch(mode=0o600)
                part.write_text(json.dumps({"format": FORMAT, "services": services}, indent=1) + "\n")
                part.replace(self.path)
        except OSError as error:
            with suppress(OSError):
                part.unlink()
            raise ModelUnreadable(
                f"the service's keys cannot be remembered in {self.path} ({error}): set PHYSWORLD_KNOWN_KEYS to a "
                "place that can be written, or give public_key"
            ) from error


def trusted_keys(
    public_key: str | Path | None, allow_unsigned: bool = False, known_keys: str | Path | None = None
) -> TrustedKeys | None:
    """The keys that may have signed a folder: the one given, else all pinned ones; None: nobody need have signed.

    Raises:
        ModelUnreadable: ``public_key`` is none, or the file of known keys is damaged.
    """
    if public_key is not None:
        return TrustedKeys(keys_by_id([given_key(public_key)]), "the key that was given")
    return None if allow_unsigned else KnownKeys(known_keys).anyones()


def is_fingerprint(text: str) -> bool:
    """Whether a text is a fingerprint; a public key in base64 is shorter."""
    return FINGERPRINT.fullmatch(text.lower()) is not None


def known_keys_file() -> Path:
    """Where known keys are kept."""
    given = os.environ.get("PHYSWORLD_KNOWN_KEYS")
    if given:
        return Path(given)
    return (
        Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "physworld" / "known-keys.json"
    )


def _with_fingerprint(mark: str, listed: Mapping[str, str], service: str) -> str:
    for text in listed.values():
        if fingerprint_of(text) == mark:
            return text
    offered = ", ".join(fingerprint_of(text) for text in listed.values()) or "none"
    raise SignatureInvalid(f"{service} lists no key with the fingerprint {mark}; it lists {offered}")


def _entry(text: str, how: str) -> tuple[str, dict[str, str]]:
    since = datetime.now(UTC).isoformat(timespec="seconds")
    return fingerprint_of(text), {"public_key": text.strip(), "how": how, "since": since}


def _of_first_format(held: dict[str, Any]) -> Services:
    """``{key id: {"public_key", "origin"}}``, which knew only who had listed a key first."""
    services: Services = {}
    for entry in held.values():
        mark, pinned = _entry(entry["public_key"], "first use")
        services.setdefault(entry["origin"], {})[mark] = pinned
    return services
