"""Key files: what is wrong with them is told before anybody finds the door closed."""

import os
import re
import ssl
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from hypothesis import given, settings
from hypothesis import strategies as st
from secure_keys import files, make_keys

from psiu_broker.cli.authority import Authority
from psiu_broker.config.certificates import SOON, parse, problem, read_certificate, warnings

NOW = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, ["base", "hill"], ["operator"])
    make_keys(folder / "others", ["base"], ["operator"])
    return folder


@pytest.fixture
def keys(made: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    for file in (*made.glob("*.pem"), *made.glob("*.key")):
        copy = tmp_path / file.name
        copy.write_bytes(file.read_bytes())
        copy.chmod(0o600)
    return tmp_path


def test_what_psiu_broker_keys_makes_is_good(made: Path) -> None:
    assert problem(files(made, "base"), serves=True) is None
    assert problem(files(made, "operator"), serves=False) is None


def test_a_program_s_certificate_is_no_broker_s(made: Path) -> None:
    assert problem(files(made, "operator"), serves=True) == (
        "certificate",
        f"{made}/operator.pem is a program's; make a broker's: psiu-broker keys FOLDER --broker NAME",
    )


@pytest.mark.parametrize("option", ["ca", "certificate", "key"])
def test_a_file_that_is_not_there_is_named(made: Path, option: str) -> None:
    found = problem(files(made, "base").model_copy(update={option: "/none/here"}), serves=True)
    assert found is not None
    assert found[0] == option
    assert found[1].startswith("/none/here: cannot be read: No such file or directory; psiu-broker keys makes")


def test_a_key_of_another_certificate_is_refused(made: Path) -> None:
    found = problem(files(made, "base").model_copy(update={"key": f"{made}/hill.key"}), serves=True)
    assert found == (
        "key",
        f"{made}/hill.key is not the key of {made}/base.pem, or has a password; give the one made with it",
    )


@pytest.mark.parametrize("name", ["base", "operator"])
def test_a_certificate_of_another_authority_is_refused(made: Path, name: str) -> None:
    mixed = files(made, name).model_copy(update={"ca": f"{made}/others/ca.pem"})
    found = problem(mixed, serves=name == "base")
    assert found == (
        "certificate",
        f"{made}/{name}.pem was not made by {made}/others/ca.pem; give the ca that made it",
    )


@pytest.mark.parametrize("text", [b"", b"\xff\xfe", b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n"])
def test_a_file_that_is_no_certificate_is_refused(keys: Path, text: bytes) -> None:
    (keys / "base.pem").write_bytes(text)
    found = problem(files(keys, "base"), serves=True)
    assert found == ("certificate", f"{keys}/base.pem: expected a certificate in PEM, -----BEGIN CERTIFICATE-----")


def test_words_before_a_certificate_in_any_letters_do_no_harm(keys: Path) -> None:
    for name in ("ca", "base"):
        file = keys / f"{name}.pem"
        file.write_bytes("Subject: CN=Laboratório\n".encode() + file.read_bytes())
    assert problem(files(keys, "base"), serves=True) is None
    assert read_certificate(f"{keys}/base.pem").name == "base"


def test_a_key_that_is_too_weak_is_not_taken_for_another_s(tmp_path: Path) -> None:
    key = rsa.generate_private_key(65537, 1024)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "base")])
    certificate = x509.CertificateBuilder(name, name, key.public_key(), 1, NOW, NOW + timedelta(days=9)).sign(
        key, hashes.SHA256()
    )
    for file in ("ca", "base"):
        (tmp_path / f"{file}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    (tmp_path / "base.key").touch(0o600)
    (tmp_path / "base.key").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    expected = ("certificate", f"{tmp_path}/base.pem cannot be used: EE_KEY_TOO_SMALL; make another")
    assert problem(files(tmp_path, "base"), serves=True) in (expected, None), "an OpenSSL of low demands takes it"


@pytest.mark.parametrize("owner", [0, 65534])
@pytest.mark.parametrize("mode", [0o600, 0o400, 0o640, 0o660, 0o604, 0o644, 0o666, 0o610, 0o602])
@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_a_key_that_others_may_read_is_refused_with_what_to_run(keys: Path, owner: int, mode: int) -> None:
    key = keys / "base.key"
    key.chmod(mode)
    os.chown(key, owner, -1)
    found = problem(files(keys, "base"), serves=True)
    if mode in (0o600, 0o400) or (mode == 0o640 and owner == 0):  # a service's group reads what is root's
        assert found is None
        return
    assert found is not None
    option, text = found
    assert option == "key"
    assert text.startswith(f"{key} may be read by others")
    run = re.search(r"run: chmod ([0-7]+) (\S+)$", text)
    assert run is not None
    Path(run[2]).chmod(int(run[1], 8))
    assert problem(files(keys, "base"), serves=True) is None


@pytest.mark.parametrize(
    ("left", "expected"),
    [
        (SOON + timedelta(minutes=1), None),
        (
            SOON - timedelta(minutes=1),
            r"ends on 20\d\d-\d\d-\d\d, in 29 days; make another where .*--broker base --renew$",
        ),
        (timedelta(0), r"ended on 20\d\d-\d\d-\d\d: nobody lets its owner in; make another"),
        (timedelta(days=800), r"is valid from 20\d\d-\d\d-\d\d on, and today is 20\d\d-\d\d-\d\d: is it\?"),
    ],
)
def test_a_certificate_that_is_about_to_end_is_told_of(tmp_path: Path, left: timedelta, expected: str | None) -> None:
    Authority(tmp_path, NOW).make("base", 700, broker=True)
    told = list(warnings(files(tmp_path, "base"), NOW + timedelta(days=700) - left, serves=True))
    own = [text for option, text in told if option == "certificate"]
    assert [re.search(expected, text) is not None for text in own] == ([True] if expected else []), own


def test_an_authority_that_is_about_to_end_is_told_of(tmp_path: Path) -> None:
    Authority(tmp_path, NOW).make("base", 3650, broker=True)
    told = list(warnings(files(tmp_path, "base"), NOW + timedelta(days=3640), serves=True))
    assert [option for option, _ in told] == ["ca", "certificate"]


def test_an_ended_certificate_is_no_mistake_of_the_file_so_that_robots_go_on(tmp_path: Path) -> None:
    Authority(tmp_path, NOW - timedelta(days=4000)).make("base", 1, broker=True)
    assert problem(files(tmp_path, "base"), serves=True) is None


@given(name=st.text(min_size=1, max_size=64), days=st.integers(1, 20_000))
@settings(max_examples=30, deadline=None)
def test_name_and_end_are_read_as_cryptography_writes_them(name: str, days: int) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    organization = x509.NameAttribute(x509.NameOID.ORGANIZATION_NAME, "lab")
    try:
        subject = x509.Name([organization, x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    except ValueError:
        return
    certificate = (
        x509.CertificateBuilder(subject, subject, key.public_key(), 1, NOW, NOW + timedelta(days=days))
    ).sign(key, hashes.SHA256())
    read = parse(certificate.public_bytes(serialization.Encoding.DER))
    assert read == (name, NOW, NOW + timedelta(days=days))


@given(st.binary(max_size=300) | st.builds(lambda body: b"\x30\x82" + len(body).to_bytes(2) + body, st.binary()))
def test_anything_else_is_a_value_error(data: bytes) -> None:
    with pytest.raises(ValueError):
        parse(data)


def test_a_certificate_cut_or_changed_anywhere_is_read_or_refused(made: Path) -> None:
    der = ssl.PEM_cert_to_DER_cert((made / "base.pem").read_text())
    assert parse(der) == read_certificate(f"{made}/base.pem")
    for at in range(len(der)):
        for spoilt in (der[:at], der[:at] + bytes([der[at] ^ 0xFF]) + der[at + 1 :]):
            with suppress(ValueError):
                parse(spoilt)
