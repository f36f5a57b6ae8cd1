"""An authority for the keys of one laboratory: a folder with its own certificate and those it has made."""

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise ImportError("making keys needs cryptography: pip install 'psiu-broker[keys]'") from error

CA_DAYS: Final = 3650
CA: Final = "ca"
"""Its own name among the files: ca.pem and ca.key."""

_EARLIER: Final = timedelta(days=1)
"""The clocks of other computers may be behind ours."""


class Authority:
    """Makes certificates in `folder`, each with its key: NAME.pem and NAME.key, which only their owner may read."""

    def __init__(self, folder: Path, now: datetime | None = None) -> None:
        """Begin anew where `folder` has no authority yet: `is_new`.

        Raises:
            OSError: a file cannot be read or written.
            ValueError: ca.pem or ca.key is none, only one of them is there, or they do not belong together.
        """
        self.folder = folder
        self._now = (now or datetime.now(UTC)).replace(microsecond=0)  # as certificates tell it
        self.is_new = not (folder / "ca.pem").exists()
        if self.is_new and (folder / "ca.key").exists():
            raise ValueError(f"{folder / 'ca.key'} is there without ca.pem; put that back, or take both away")
        if self.is_new:
            folder.mkdir(parents=True, exist_ok=True)
            self._key = ec.generate_private_key(ec.SECP256R1())
            subject = _name(f"psiu-broker keys, {folder.absolute().name}")
            self._certificate = _sign(
                self._builder(subject, subject, self._key.public_key(), CA_DAYS)
                .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
                .add_extension(_usage(signs_certificates=True), critical=True),
                self._key,
            )
            _write(folder, CA, self._certificate, self._key)
        else:
            self._certificate = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
            self._key = _read_key(folder / "ca.key", self._certificate)

    def make(self, name: str, days: int, *, broker: bool) -> None:
        """Write the key and the certificate of `name`, in place of those that are there.

        A broker's is good for being called and for calling others, a program's for calling only: no
        program can pass for a broker.

        Raises:
            OSError: a file cannot be written.
            ValueError: it would outlive the authority.
        """
        end = self._certificate.not_valid_after_utc
        if self._now + timedelta(days=days) > end:
            left = (end - self._now).days
            how = f"--days {left} at most, or begin" if left > 0 else "begin"
            raise ValueError(f"ca.pem ends on {end:%Y-%m-%d}, in less than {days} days; {how} anew in another folder")
        key = ec.generate_private_key(ec.SECP256R1())
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if broker else [])]
        certificate = _sign(
            self._builder(_name(name), self._certificate.subject, key.public_key(), days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name.replace("_", "-"))]), critical=False),
            self._key,
        )
        _write(self.folder, name, certificate, key)

    def _builder(
        self, subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int
    ) -> x509.CertificateBuilder:
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(self._now - _EARLIER)
            .not_valid_after(self._now + timedelta(days=days))
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
        )


def _read_key(file: Path, certificate: x509.Certificate) -> ec.EllipticCurvePrivateKey:
    if not file.exists():
        raise ValueError(f"{file.name} is not there, which makes more; put it back, or begin anew in another folder")
    try:
        key = serialization.load_pem_private_key(file.read_bytes(), None)
    except TypeError as error:
        raise ValueError(f"{file.name} has a password; take it off: openssl pkey -in {file} -out {file}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise ValueError(f"{file.name} is not the key of ca.pem, which psiu-broker keys made; put the right one there")
    return key


def _sign(builder: x509.CertificateBuilder, key: ec.EllipticCurvePrivateKey) -> x509.Certificate:
    return builder.sign(key, hashes.SHA256())


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _write(folder: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    """The key first, which nobody else may read at any moment; each is there whole or as it was before."""
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for suffix, mode, data in (
        ("key", 0o600, secret),
        ("pem", 0o644, certificate.public_bytes(serialization.Encoding.PEM)),
    ):
        new = folder / f".{name}.{suffix}.new"
        new.unlink(missing_ok=True)
        with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:  # noqa: PTH123
            file.write(data)
        new.replace(folder / f"{name}.{suffix}")
