# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""By which names and addresses others reach this machine."""

from fcntl import ioctl
from ipaddress import ip_address, IPv4Address, IPv6Address
from pathlib import Path
import re
import socket
from struct import pack
from typing import TypeAlias

IpAddress: TypeAlias = IPv4Address | IPv6Address
# Of the domain name system; underscores are common, if against the rules.
NAME = r'[a-z0-9_]([a-z0-9_.-]*[a-z0-9_])?'

# Of Linux: the request for an interface's address, and where its answer has it.
SIOCGIFADDR = 0x8915
ADDRESS = slice(20, 24)
IF_INET6 = Path('/proc/net/if_inet6')


def own_address() -> str:
    """Return the address by which others reach this machine, or its name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Nothing is sent: this only asks for the way out. The address is one for examples.
            probe.connect(('192.0.2.1', 9))
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def own_names() -> set[str]:
    """Return the names of this machine; the one in .local is what mDNS gives it."""
    name = socket.gethostname().lower()
    return {'localhost', *({name, f"{name.split('.')[0]}.local"} if is_name(name) else ())}


def is_name(host: str) -> bool:
    """Tell whether a host is a name that a certificate can hold, not an address."""
    return bool(re.fullmatch(NAME, host.lower())) and not re.fullmatch(r'[\d.]*', host)


def own_addresses() -> set[IpAddress]:
    """Return the addresses of all interfaces of this machine."""
    return {ip_address('127.0.0.1'), ip_address('::1'), *_v4_addresses(), *_v6_addresses()}


def _v4_addresses() -> set[IpAddress]:
    found: set[IpAddress] = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            try:
                answer = ioctl(asking, SIOCGIFADDR, pack('256s', name.encode()[:15]))
            except OSError:
                # It has none.
                continue
            found.add(ip_address(answer[ADDRESS]))
    return found


def _v6_addresses() -> set[IpAddress]:
    try:
        lines = IF_INET6.read_text().splitlines()
    except OSError:
        return set()
    return {ip_address(bytes.fromhex(line.split()[0])) for line in lines}
