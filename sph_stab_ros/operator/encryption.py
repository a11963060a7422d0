# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How the server's connections are encrypted: by whose certificate, if at all."""

from argparse import Namespace
from dataclasses import dataclass
import os
from pathlib import Path
import ssl

from sph_stab_ros.operator.access import is_loopback
from sph_stab_ros.operator.addresses import is_name, own_addresses, own_names

# What phones fetch, to trust this machine from then on.
AUTHORITY_FILE, AUTHORITY_TYPE = 'authority.crt', 'application/x-x509-ca-cert'


@dataclass(frozen=True)
class Encryption:
    """A TLS context, and what to tell of its certificate; ``authority_pem`` where it is ours."""

    context: ssl.SSLContext
    fingerprint: str = ''
    authority_pem: bytes = b''
    authority_fingerprint: str = ''


def encryption(args: Namespace) -> Encryption | None:
    """
    Return what the command line asks for; None for none.

    OSError (also ssl.SSLError) where files cannot be used, ImportError without cryptography.
    """
    if args.certificate:
        return Encryption(context(args.certificate, args.key))
    if args.insecure or is_loopback(args.host):
        return None
    # An optional dependency, missing with a line of its own.
    from sph_stab_ros.operator.certificate import own_identity
    names = own_names() | ({args.host.lower()} if is_name(args.host) else set())
    identity = own_identity(data_folder(), names, own_addresses())
    return Encryption(context(identity.file), identity.fingerprint, identity.authority_pem,
                      identity.authority_fingerprint)


def context(certificate: Path, key: Path | None = None) -> ssl.SSLContext:
    """Return a TLS context of a server; without a key of its own the certificate's file has it."""
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    made.load_cert_chain(certificate, key, password=_no_password)
    return made


def _no_password() -> str:
    # OpenSSL would ask at the terminal.
    raise ssl.SSLError(1, 'the key is encrypted')


def data_folder() -> Path:
    """Return where this program keeps its own files of a user (XDG base directories)."""
    base = os.environ.get('XDG_DATA_HOME', '')
    return (Path(base) if base.startswith('/') else Path.home() / '.local' / 'share') \
        / 'sph_stab_ros' / 'operator'
