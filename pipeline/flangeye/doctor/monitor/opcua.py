"""Tell a controller over OPC UA: write the state into one of its nodes."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

from flangeye.doctor.monitor.history import Finding
from flangeye.doctor.monitor.watchman import CODES
from flangeye.errors import StageError
from flangeye.files.elsewhere import is_this_machine

OPEN = "none"
"""Instead of a security policy: neither encrypted nor signed."""


def require_secured(url: str, security: str | None) -> None:
    """Refuse to speak to another machine in the open without being asked to.

    Raises:
        StageError: The server is on another machine, and no security policy is given.
    """
    host = urlsplit(url).hostname or ""
    if security is None and not is_this_machine(host):
        raise StageError(
            f"{url}: is on another machine, where anybody between can change the state: give "
            "--opcua-security POLICY,MODE,CERTIFICATE,KEY, such as Basic256Sha256,SignAndEncrypt,"
            f"cert.der,key.pem, or '{OPEN}' in a network of its own"
        )


def write_state(url: str, node: str, finding: Finding, security: str | None = None) -> None:
    """Write OK, DEGRADED or MOVED into a text node, or 0, 1, 2 into a numeric one.

    Args:
        url: ``opc.tcp://host:port``.
        node: ``ns=2;s=flangeye``.
        finding: Finding of the last check.
        security: ``POLICY,MODE,CERTIFICATE,KEY`` as asyncua has it, or OPEN.

    Raises:
        StageError: asyncua is missing, the server does not answer, there is no such node, or the
            server is on another machine and nothing is said of security.
    """
    require_secured(url, security)
    try:
        import asyncua  # noqa: F401
    except ImportError:
        raise StageError("OPC UA needs asyncua: pip install 'flangeye[opcua]'") from None
    try:
        asyncio.run(asyncio.wait_for(_write(url, node, finding, security), timeout=10))
    except Exception as error:  # asyncua, asyncio and sockets each have their own
        what = str(error) or type(error).__name__
        raise StageError(f"{url}, node '{node}': cannot be written: {what}") from None


async def _write(url: str, node: str, finding: Finding, security: str | None) -> None:
    from asyncua import ua
    from asyncua.client.client import Client

    client = Client(url)
    if security not in (None, OPEN):
        await client.set_security_string(security)
    async with client:
        variable = client.get_node(node)
        kind = await variable.read_data_type_as_variant_type()
        value = finding.state if kind == ua.VariantType.String else CODES[finding.state]
        await variable.write_value(ua.DataValue(ua.Variant(value, kind)))
