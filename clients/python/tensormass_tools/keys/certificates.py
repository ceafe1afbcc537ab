"""X.509 certificates of a small authority, by the package `cryptography`.

Certificates of daemons are good for servers only, those of clients for clients only, so a client cannot pose as a
daemon. The browsers' page has an authority of its own, because browsers trust that one for every address.
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from tensormass._shared.client_keys import CLOCK_SKEW_S

AUTHORITY_DAYS = 3650


@dataclass(frozen=True)
class Certified:
    """A certificate and its private key, as PEM."""

    certificate: str
    private_key: str


def make_authority(name: str, now_s: int) -> Certified:
    """Makes an authority that signs for itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder(name, _name(name), key, key, now_s, AUTHORITY_DAYS)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    return _certified(builder.sign(key, hashes.SHA256()), key)


def make_client(authority: Certified, name: str, now_s: int, days: float) -> Certified:
    """Makes a client's certificate with `name` as its common name."""
    return _signed(authority, name, (), ExtendedKeyUsageOID.CLIENT_AUTH, now_s, days)


def make_server(authority: Certified, name: str, hosts: Sequence[str], now_s: int, days: float) -> Certified:
    """Makes a server's certificate for names and addresses."""
    return _signed(authority, name, hosts, ExtendedKeyUsageOID.SERVER_AUTH, now_s, days)


def _signed(
    authority: Certified, name: str, hosts: Sequence[str], use: x509.ObjectIdentifier, now_s: int, days: float
) -> Certified:
    signer = x509.load_pem_x509_certificate(authority.certificate.encode())
    signing_key = serialization.load_pem_private_key(authority.private_key.encode(), None)
    assert isinstance(signing_key, ec.EllipticCurvePrivateKey)
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder(name, signer.subject, signing_key, key, now_s, days)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    builder = builder.add_extension(x509.ExtendedKeyUsage([use]), critical=False)
    # zenoh's TLS wants a name in every certificate.
    names = [_general_name(host) for host in dict.fromkeys(hosts)] or [
        x509.DNSName(f"{name.rpartition('.')[2]}.client")
    ]
    builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return _certified(builder.sign(signing_key, hashes.SHA256()), key)


def _builder(
    name: str,
    issuer: x509.Name,
    signing_key: ec.EllipticCurvePrivateKey,
    key: ec.EllipticCurvePrivateKey,
    now_s: int,
    days: float,
) -> x509.CertificateBuilder:
    begin = datetime.datetime.fromtimestamp(now_s - CLOCK_SKEW_S, datetime.UTC)
    end = datetime.datetime.fromtimestamp(now_s, datetime.UTC) + datetime.timedelta(days=days)
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key()), critical=False)
    )


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


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _general_name(host: str) -> x509.GeneralName:
    with contextlib.suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    return x509.DNSName(host)


def _certified(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Certified:
    return Certified(
        certificate.public_bytes(serialization.Encoding.PEM).decode(),
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ).decode(),
    )
