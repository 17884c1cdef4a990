"""The same messages to Foxglove: its own server, fed from the log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from flangeye.errors import StageError
from flangeye.log.watch.gate import gate, hidden_address
from flangeye.log.watch.tail import Channel, Message

Send = Callable[[Message], None]


@contextmanager
def foxglove_server(port: int) -> Iterator[Send]:
    """Serve on a port of this machine alone; what is given is sent to whoever may watch.

    Raises:
        StageError: foxglove-sdk is not installed, or the port is taken.
    """
    try:
        import foxglove
    except ImportError:
        raise StageError("--foxglove needs foxglove-sdk: pip install 'flangeye[watch]'") from None
    channels: dict[str, foxglove.Channel] = {}
    host, hidden = hidden_address()
    opened = ExitStack()
    try:
        opened.enter_context(gate(port, (host, hidden)))
        server = foxglove.start_server(name="flangeye", host=host, port=hidden)
    except (OSError, RuntimeError) as error:
        opened.close()
        raise StageError(f"--foxglove {port}: cannot serve there: {error}") from None

    def send(message: Message) -> None:
        topic = message.channel.topic
        if topic not in channels:
            channels[topic] = _opened(message.channel)
        channels[topic].log(message.data, log_time=message.time_ns)

    try:
        yield send
    finally:
        for channel in channels.values():
            channel.close()
        opened.close()
        server.stop()


def _opened(channel: Channel) -> foxglove.Channel:  # type: ignore[name-defined]  # noqa: F821
    import foxglove

    schema = foxglove.Schema(
        name=channel.schema, encoding=channel.schema_encoding, data=channel.schema_data
    )
    return foxglove.Channel(channel.topic, schema=schema, message_encoding=channel.encoding)
