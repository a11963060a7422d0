# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Encryption: the machine's own certificate, or one that is given.

The own one is a leaf for the names and addresses that the machine has now, signed by an authority
that is made at the first start and stays. Browsers that trust the authority go on trusting the
leaf when addresses change. Since they trust it, it is made so that it can vouch for machines of
local networks alone.
"""

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from ipaddress import ip_network
import os
from pathlib import Path
from typing import TypeAlias

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sph_stab_ros.operator.addresses import IpAddress

Key: TypeAlias = ec.EllipticCurvePrivateKey

AUTHORITY, LEAF = 'authority.pem', 'certificate.pem'
AUTHORITY_LIFE = timedelta(days=3650)
# Apple's systems take none that lives longer; a new one is made a month before its end.
LEAF_LIFE, LEAF_REST = timedelta(days=397), timedelta(days=30)
# Of one that a browser trusts by its hash: 14 days at most (W3C, WebTransport).
BRIEF_LIFE = timedelta(days=13)
# Clocks differ.
BACKDATED = timedelta(days=1)
# Of local networks (RFC 1918, 3927, 4193, 4291): for others the authority cannot vouch.
NETWORKS = [ip_network(one) for one in (
    '127.0.0.0/8', '10.0.0.0/8', '172.16.0.0/12', '192.168.0.0/16', '169.254.0.0/16',
    '::1/128', 'fc00::/7', 'fe80::/10')]
DOMAINS = 'localhost', 'local'


@dataclass(frozen=True)
class Identity:
    """A certificate with its key, in one file, and the authority that has signed it."""

    file: Path
    fingerprint: str
    authority_pem: bytes
    authority_fingerprint: str


def own_identity(folder: Path, names: Collection[str],
                 addresses: Collection[IpAddress]) -> Identity:
    """
    Return the machine's identity, kept in a folder; make what is missing, outdated or of others.

    OSError where the folder cannot be written.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    wanted = {*names, *map(str, addresses)}
    authority, authority_key = _read(folder / AUTHORITY) or (None, None)
    if authority is None or authority_key is None or _ends(authority) < _now() + LEAF_LIFE \
            or not _vouches_for(authority, names, addresses):
        authority, authority_key = _new_authority(names, addresses)
        _write(folder / AUTHORITY, authority, authority_key)
    leaf, _ = _read(folder / LEAF) or (None, None)
    if leaf is None or leaf.issuer != authority.subject or _ends(leaf) < _now() + LEAF_REST \
            or _named(leaf) != wanted:
        leaf, key = _new_leaf(authority, authority_key, names, addresses)
        _write(folder / LEAF, leaf, key)
    return Identity(folder / LEAF, fingerprint(leaf),
                    authority.public_bytes(serialization.Encoding.PEM), fingerprint(authority))


def new_brief_identity() -> tuple[x509.Certificate, Key]:
    """Return a certificate, and its key, for those alone who are told its hash."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name('sph_stab_ros operator')
    return _builder(key, name, name, BRIEF_LIFE).serial_number(
        x509.random_serial_number()).sign(key, hashes.SHA256()), key


def fingerprint(certificate: x509.Certificate) -> str:
    """Return the SHA-256 as browsers show it."""
    return certificate.fingerprint(hashes.SHA256()).hex(':').upper()


def _new_authority(names: Collection[str],
                   addresses: Collection[IpAddress]) -> tuple[x509.Certificate, Key]:
    key = ec.generate_private_key(ec.SECP256R1())
    # A serial number in its name tells it from those made before.
    number = x509.random_serial_number()
    name = _name(f'sph_stab_ros operator {number & 0xffffffff:08x}')
    permitted = [
        *(x509.DNSName(one) for one in sorted({*DOMAINS, *names})),
        *(x509.IPAddress(one) for one in NETWORKS),
        *(x509.IPAddress(ip_network(one)) for one in sorted(addresses, key=str)
          if not _is_local(one))]
    certificate = _builder(key, name, name, AUTHORITY_LIFE).serial_number(number).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True,
    ).add_extension(
        x509.NameConstraints(permitted_subtrees=permitted, excluded_subtrees=None), critical=True,
    ).add_extension(
        _usage(signs_certificates=True), critical=True,
    ).sign(key, hashes.SHA256())
    return certificate, key


def _new_leaf(authority: x509.Certificate, authority_key: Key, names: Collection[str],
              addresses: Collection[IpAddress]) -> tuple[x509.Certificate, Key]:
    key = ec.generate_private_key(ec.SECP256R1())
    alternatives = [*map(x509.DNSName, sorted(names)),
                    *map(x509.IPAddress, sorted(addresses, key=str))]
    certificate = _builder(key, _name('sph_stab_ros operator'), authority.subject, LEAF_LIFE
                           ).serial_number(x509.random_serial_number()).add_extension(
        x509.SubjectAlternativeName(alternatives), critical=False,
    ).add_extension(
        x509.BasicConstraints(ca=False, path_length=None), critical=True,
    ).add_extension(
        _usage(signs_certificates=False), critical=True,
    ).add_extension(
        x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False,
    ).add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()),
        critical=False,
    ).sign(authority_key, hashes.SHA256())
    return certificate, key


def _builder(key: Key, subject: x509.Name, issuer: x509.Name,
             life: timedelta) -> x509.CertificateBuilder:
    begin = _now() - BACKDATED
    return x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(
        key.public_key()).not_valid_before(begin).not_valid_after(begin + life).add_extension(
        x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates, key_cert_sign=signs_certificates,
        crl_sign=signs_certificates, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _named(leaf: x509.Certificate) -> set[str]:
    """Return names and addresses in a certificate."""
    names = leaf.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return {*names.get_values_for_type(x509.DNSName),
            *map(str, names.get_values_for_type(x509.IPAddress))}


def _vouches_for(authority: x509.Certificate, names: Collection[str],
                 addresses: Collection[IpAddress]) -> bool:
    constraints = authority.extensions.get_extension_for_class(x509.NameConstraints).value
    permitted = [one.value for one in constraints.permitted_subtrees or ()]
    return {*names} <= {*permitted, *(one for one in names if one.endswith('.local'))} and all(
        _is_local(one) or ip_network(one) in permitted for one in addresses)


def _is_local(address: IpAddress) -> bool:
    return any(address in network for network in NETWORKS)


def _now() -> datetime:
    return datetime.now(timezone.utc)


def _ends(certificate: x509.Certificate) -> datetime:
    # Which one there is depends on the version.
    end = getattr(certificate, 'not_valid_after_utc', None) or certificate.not_valid_after
    return end.replace(tzinfo=timezone.utc)


def _read(file: Path) -> tuple[x509.Certificate, Key] | None:
    """Return certificate and key of a file; None where there is none that is whole."""
    try:
        data = file.read_bytes()
        key = serialization.load_pem_private_key(data, None)
        certificate = x509.load_pem_x509_certificate(data)
    except (OSError, ValueError, TypeError):
        return None
    return (certificate, key) if isinstance(key, ec.EllipticCurvePrivateKey) else None


def _write(file: Path, certificate: x509.Certificate, key: Key) -> None:
    """Write a file that only its owner may read, whole or not at all."""
    data = certificate.public_bytes(serialization.Encoding.PEM) + key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption())
    new = file.with_name(f'{file.name}.{os.getpid()}')
    new.unlink(missing_ok=True)
    with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'wb') as out:
        out.write(data)
    new.replace(file)
