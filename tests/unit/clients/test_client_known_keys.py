"""Keys are pinned at the first use of a service; another one is accepted only after it was trusted by hand."""

from __future__ import annotations

import base64
import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from physworld_client.errors import ModelUnreadable, SignatureInvalid, SigningKeyUntrusted
from physworld_client.known_keys import KnownKeys, known_keys_file, trusted_keys
from physworld_client.signatures import fingerprint_of, verify_signature
from physworld_client.transport import service_name

from physworld_schemas.signing import SigningKey
from physworld_storage.signing import Signer, signer_of

OURS = signer_of(base64.b64encode(bytes(range(32))).decode(), "ours")
THEIRS = signer_of(base64.b64encode(bytes(range(1, 33))).decode(), "theirs")
OUR_PRINT, THEIR_PRINT = fingerprint_of(OURS.public_key), fingerprint_of(THEIRS.public_key)
SERVICE = "https://ours"
MANIFEST = b"{}"


@pytest.fixture
def known(tmp_path: Path) -> KnownKeys:
    return KnownKeys(tmp_path / "config" / "known.json")


def wire(signer: Signer) -> SigningKey:
    return SigningKey(key_id=signer.key_id, public_key=signer.public_key)


def signed(folder: Path, signer: Signer) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "manifest.sig.json").write_bytes(signer.sign(MANIFEST))
    return folder


def test_the_first_contact_pins_what_the_service_lists_and_only_that(known: KnownKeys) -> None:
    first = known.expected(SERVICE, [wire(OURS)])
    assert known.of(SERVICE) is None, "nothing is pinned before a signature was seen to hold"
    known.met(first)
    assert known.of(SERVICE) == {OUR_PRINT: OURS.public_key}
    later = known.expected(SERVICE, [wire(OURS), wire(THEIRS)])
    known.met(later)
    assert known.of(SERVICE) == {OUR_PRINT: OURS.public_key}
    assert known.of("https://another") is None
    assert json.loads(known.path.read_text())["services"][SERVICE][OUR_PRINT]["how"] == "first use"


def test_a_key_that_the_service_lists_later_is_refused_until_it_is_trusted(
    known: KnownKeys, tmp_path: Path
) -> None:
    known.met(known.expected(SERVICE, [wire(OURS)]))
    folder = signed(tmp_path / "model", THEIRS)
    listed = [wire(OURS), wire(THEIRS)]
    with pytest.raises(
        SigningKeyUntrusted, match=rf"not trusted for {SERVICE}: {OUR_PRINT}.*models trust"
    ) as found:
        verify_signature(folder, MANIFEST, known.expected(SERVICE, listed))
    assert (found.value.signer, found.value.trusted, found.value.service) == (
        THEIR_PRINT,
        (OUR_PRINT,),
        SERVICE,
    )
    with pytest.raises(SigningKeyUntrusted, match="does not list that key either"):
        verify_signature(folder, MANIFEST, known.expected(SERVICE, [wire(OURS)]))
    assert known.trust(SERVICE, THEIR_PRINT, listed) == THEIR_PRINT
    verify_signature(folder, MANIFEST, known.expected(SERVICE, listed))
    verify_signature(signed(tmp_path / "older", OURS), MANIFEST, known.expected(SERVICE, listed))


def test_a_distrusted_key_does_not_come_back_by_a_second_first_use(known: KnownKeys, tmp_path: Path) -> None:
    known.met(known.expected(SERVICE, [wire(OURS)]))
    known.distrust(SERVICE, OUR_PRINT)
    keys = known.expected(SERVICE, [wire(OURS)])
    known.met(keys)
    assert known.of(SERVICE) == {}
    with pytest.raises(SigningKeyUntrusted, match=f"trusted for {SERVICE}: none"):
        verify_signature(signed(tmp_path / "model", OURS), MANIFEST, keys)
    with pytest.raises(ModelUnreadable, match="no key that is trusted"):
        known.distrust(SERVICE, OUR_PRINT)


def test_a_key_is_trusted_by_fingerprint_by_its_text_and_by_a_file(known: KnownKeys, tmp_path: Path) -> None:
    file = tmp_path / "ours.pub"
    file.write_text(OURS.public_key + "\n")
    assert known.trust("a", OUR_PRINT.upper(), [wire(OURS)]) == OUR_PRINT
    assert known.trust("b", OURS.public_key) == OUR_PRINT
    assert known.trust("c", file) == OUR_PRINT
    assert known.of("a") == known.of("b") == known.of("c") == {OUR_PRINT: OURS.public_key}
    with pytest.raises(
        SignatureInvalid, match=f"lists no key with the fingerprint {THEIR_PRINT}.*{OUR_PRINT}"
    ):
        known.trust("a", THEIR_PRINT, [wire(OURS)])
    for wrong in ("bm90IGEga2V5", OUR_PRINT[:16], tmp_path / "absent"):
        with pytest.raises(ModelUnreadable):
            known.trust("a", wrong)
    assert known.of("a") == {OUR_PRINT: OURS.public_key}


def test_a_key_under_anothers_id_is_refused(known: KnownKeys) -> None:
    forged = SigningKey(key_id=OURS.key_id, public_key=THEIRS.public_key)
    with pytest.raises(SignatureInvalid, match="another id"):
        known.expected(SERVICE, [forged])


def test_keys_pinned_at_once_are_all_kept(known: KnownKeys) -> None:
    signers = [signer_of(base64.b64encode(bytes([i] * 32)).decode(), "one") for i in range(16)]
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda one: KnownKeys(known.path).trust(SERVICE, one.public_key), signers))
    assert set(known.of(SERVICE) or {}) == {fingerprint_of(one.public_key) for one in signers}


def test_a_file_of_the_first_format_is_read_and_kept(known: KnownKeys) -> None:
    known.path.parent.mkdir()
    old = {OURS.key_id: {"public_key": OURS.public_key, "origin": SERVICE}}
    known.path.write_text(json.dumps(old))
    assert known.of(SERVICE) == {OUR_PRINT: OURS.public_key}
    known.trust("https://theirs", THEIRS.public_key)
    assert known.of(SERVICE) == {OUR_PRINT: OURS.public_key}
    assert set(known.anyones().by_id) == {OURS.key_id, THEIRS.key_id}


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ModelUnreadable, match=r"cannot be remembered in .*set PHYSWORLD_KNOWN_KEYS"):
        KnownKeys(tmp_path / "file" / "known.json").trust(SERVICE, OURS.public_key)


@pytest.mark.parametrize(
    "text",
    ['{"0": 3}', "[]", "no", '{"services": {"a": {"%s": {"public_key": "bm8="}}}}' % ("0" * 64)],
)
def test_a_damaged_file_of_keys_is_named(known: KnownKeys, text: str) -> None:
    known.path.parent.mkdir()
    known.path.write_text(text)
    with pytest.raises(ModelUnreadable, match=r"known\.json is not a file of known keys"):
        known.of(SERVICE)


def test_a_key_of_another_text_than_its_fingerprint_is_damage(known: KnownKeys) -> None:
    known.trust(SERVICE, OURS.public_key)
    known.path.write_text(known.path.read_text().replace(OURS.public_key, THEIRS.public_key))
    with pytest.raises(ModelUnreadable, match="is not the fingerprint of its key"):
        known.anyones()


def test_where_keys_are_kept_is_set_by_argument_by_setting_or_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PHYSWORLD_KNOWN_KEYS", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert known_keys_file() == tmp_path / "physworld" / "known-keys.json"
    monkeypatch.setenv("PHYSWORLD_KNOWN_KEYS", str(tmp_path / "set.json"))
    assert KnownKeys().path == tmp_path / "set.json"
    assert KnownKeys(tmp_path / "given.json").path == tmp_path / "given.json"


def test_a_given_key_counts_even_where_no_signature_is_asked_for(tmp_path: Path) -> None:
    assert trusted_keys(None, allow_unsigned=True) is None
    keys = trusted_keys(OURS.public_key, allow_unsigned=True)
    assert keys is not None and set(keys.by_id) == {OURS.key_id}


def test_a_service_is_known_without_what_lets_somebody_in() -> None:
    assert service_name("https://me:secret@Ours.org:443/lab/") == "https://ours.org/lab"
    assert len(hashlib.sha256(b"").hexdigest()) == len(OUR_PRINT)
