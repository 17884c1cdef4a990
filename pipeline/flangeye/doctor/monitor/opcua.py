"""Tell a controller over OPC UA: write the state into one of its nodes."""

from __future__ import annotations

import asyncio

from flangeye.doctor.monitor.history import Finding
from flangeye.doctor.monitor.watchman import CODES
from flangeye.errors import StageError


def write_state(url: str, node: str, finding: Finding) -> None:
    """Write OK, DEGRADED or MOVED into a text node, or 0, 1, 2 into a numeric one.

    Args:
        url: ``opc.tcp://host:port``.
        node: ``ns=2;s=flangeye``.
        finding: Finding of the last check.

    Raises:
        StageError: asyncua is missing, the server does not answer, or there is no such node.
    """
    try:
        import asyncua  # noqa: F401
    except ImportError:
        raise StageError("OPC UA needs asyncua: pip install 'flangeye[opcua]'") from None
    try:
        asyncio.run(asyncio.wait_for(_write(url, node, finding), timeout=10))
    except Exception as error:  # asyncua, asyncio and sockets each have their own
        what = str(error) or type(error).__name__
        raise StageError(f"{url}, node '{node}': cannot be written: {what}") from None


async def _write(url: str, node: str, finding: Finding) -> None:
    from asyncua import ua
    from asyncua.client.client import Client

    async with Client(url) as client:
        variable = client.get_node(node)
        kind = await variable.read_data_type_as_variant_type()
        value = finding.state if kind == ua.VariantType.String else CODES[finding.state]
        await variable.write_value(ua.DataValue(ua.Variant(value, kind)))
