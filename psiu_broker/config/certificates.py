"""Keys and certificates as files: who a certificate names, until when, and what is wrong with them.

Everything here reads files and no clock. A certificate is read with nothing but Python, so that a broker needs no
more than that to say that its own is about to end.
"""

import os
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple, Protocol

SOON: Final = timedelta(days=30)

_COMMON_NAME: Final = b"\x55\x04\x03"
_VERSION: Final = 0xA0
_UTC_TIME: Final = 0x17
_ANY_TIME: Final = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME: a computer whose clock is not set yet has the same keys as later."""
_OTHER_PURPOSE: Final = 26
"""OpenSSL's X509_V_ERR_INVALID_PURPOSE."""


class Files(Protocol):
    """What a program needs to be somebody: paths of PEM files."""

    @property
    def ca(self) -> str: ...
    @property
    def certificate(self) -> str: ...
    @property
    def key(self) -> str: ...


class Certificate(NamedTuple):
    name: str
    """Its common name; "" where it has none."""
    since: datetime
    until: datetime


def read_certificate(path: str) -> Certificate:
    """The first certificate in the PEM file `path`.

    Raises:
        OSError: it cannot be read.
        ValueError: there is none in it.
    """
    try:
        _, begin, rest = Path(path).read_text("latin-1").partition("-----BEGIN CERTIFICATE-----")
        body, end, _ = rest.partition("-----END CERTIFICATE-----")
        if not (begin and end):
            raise ValueError("it has no such lines")  # noqa: TRY301
        return parse(ssl.PEM_cert_to_DER_cert(f"{begin}{body}{end}"))
    except ValueError as error:
        raise ValueError("expected a certificate in PEM, -----BEGIN CERTIFICATE-----") from error


def parse(der: bytes) -> Certificate:
    """Read an X.509 certificate; raises ValueError where it is none. It is not verified."""
    [(_, whole)] = _items(der)
    (_, signed), _, _ = _items(whole)
    _, _, _, (_, validity), (_, subject), *_ = (item for item in _items(signed) if item[0] != _VERSION)
    since, until = (_time(tag, text) for tag, text in _items(validity))
    return Certificate(_common_name(subject), since, until)


def problem(files: Files, *, serves: bool) -> tuple[str, str] | None:
    """What makes `files` useless or unsafe, as the option at fault and a text for its author; None where all is well.

    Whether they are still valid is another question: `warnings`.

    Args:
        serves: others are to call their owner, which is a broker.
    """
    for option in ("ca", "certificate", "key"):
        path = getattr(files, option)
        try:
            if option == "key":
                Path(path).read_bytes()
            else:
                read_certificate(path)
        except OSError as error:
            return option, f"{path}: cannot be read: {error.strerror}; psiu-broker keys makes keys and certificates"
        except ValueError as error:
            return option, f"{path}: {error}"
    if (mode := _too_open(files.key)) is not None:
        return "key", f"{files.key} may be read by others, who could pass for its owner; run: chmod {mode} {files.key}"
    return _mismatch(files, serves=serves)


def warnings(files: Files, now: datetime, *, serves: bool) -> Iterator[tuple[str, str]]:
    """What is not valid at `now`, or not for long, as option and text; of files without a `problem`."""
    for option in ("ca", "certificate"):
        path = getattr(files, option)
        certificate = read_certificate(path)
        day = f"{certificate.until:%Y-%m-%d}"
        if now < certificate.since:
            yield option, f"{path} is valid from {certificate.since:%Y-%m-%d} on, and today is {now:%Y-%m-%d}: is it?"
        elif certificate.until <= now:
            yield option, f"{path} ended on {day}: nobody lets its owner in; {_renewal(path, option, serves)}"
        elif certificate.until - now < SOON:
            days = (certificate.until - now).days
            yield option, f"{path} ends on {day}, in {days} days; {_renewal(path, option, serves)}"


def _renewal(path: str, option: str, serves: bool) -> str:
    if option == "ca":
        return "make keys in a new folder, for everybody: psiu-broker keys"
    who = f"--{'broker' if serves else 'program'} {Path(path).stem}"
    return f"make another where ca.key is: psiu-broker keys FOLDER {who} --renew"


def _too_open(path: str) -> str | None:
    """The mode that a key should have, where others may read it. A group may read root's: so a service does."""
    status = os.stat(path)  # noqa: PTH116 - the whole of it
    allowed = 0o640 if status.st_uid == 0 else 0o600
    return f"{allowed:o}" if status.st_mode & 0o777 & ~allowed else None


def _mismatch(files: Files, *, serves: bool) -> tuple[str, str] | None:
    """What the three are not to one another, found by having them shake hands with themselves."""
    here, there = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        contexts = [_context(files, role) for role in (ssl.PROTOCOL_TLS_CLIENT, ssl.PROTOCOL_TLS_SERVER)]
    except (ssl.SSLError, ValueError) as error:
        if "TOO_" in (reason := getattr(error, "reason", None) or ""):  # EE_KEY_TOO_SMALL, CA_MD_TOO_WEAK
            return "certificate", f"{files.certificate} cannot be used: {reason}; make another"
        return "key", f"{files.key} is not the key of {files.certificate}, or has a password; give the one made with it"
    if not serves:
        contexts[0].verify_mode = ssl.CERT_NONE
    ends = contexts[0].wrap_bio(here, there), contexts[1].wrap_bio(there, here, server_side=True)
    for end in ends * 3:
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
        except ssl.SSLCertVerificationError as error:
            if error.verify_code == _OTHER_PURPOSE:
                text = f"{files.certificate} is a program's; make a broker's: psiu-broker keys FOLDER --broker NAME"
                return "certificate", text
            return "certificate", f"{files.certificate} was not made by {files.ca}; give the ca that made it"
        except ssl.SSLError as error:
            return "certificate", f"{files.certificate} cannot be used: {error.reason}; make another"
    return None


def _context(files: Files, role: int) -> ssl.SSLContext:
    """One side that shows its certificate and wants to see the other's."""
    context = ssl.SSLContext(role)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(context.verify_flags | _ANY_TIME)
    context.load_cert_chain(files.certificate, files.key, password="")
    context.load_verify_locations(files.ca)
    return context


def _items(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The tag and the content of each DER value in `data`; raises ValueError where it is none."""
    at = 0
    while at < len(data):
        if at + 2 > len(data):
            raise ValueError("cut short")
        tag, size = data[at], data[at + 1]
        at += 2
        if size & 0x80:
            octets = size & 0x7F
            size = int.from_bytes(data[at : at + octets])
            at += octets
        if at + size > len(data):
            raise ValueError("cut short")
        yield tag, data[at : at + size]
        at += size


def _time(tag: int, text: bytes) -> datetime:
    digits = text.decode("ascii")
    if tag == _UTC_TIME:
        digits = ("20" if digits < "5" else "19") + digits
    return datetime.strptime(digits, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)


def _common_name(subject: bytes) -> str:
    for _, relative in _items(subject):
        for _, attribute in _items(relative):
            (_, kind), (_, value) = _items(attribute)
            if kind == _COMMON_NAME:
                return value.decode()
    return ""
