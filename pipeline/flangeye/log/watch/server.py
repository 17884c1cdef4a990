"""The same messages to Foxglove: its own server, fed from the log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from flangeye.errors import StageError
from flangeye.log.watch.tail import Channel, Message

Send = Callable[[Message], None]


@contextmanager
def foxglove_server(port: int) -> Iterator[Send]:
    """Serve on a port; what is given is sent to whoever watches.

    Raises:
        StageError: foxglove-sdk is not installed, or the port is taken.
    """
    try:
        import foxglove
    except ImportError:
        raise StageError("--foxglove needs foxglove-sdk: pip install 'flangeye[watch]'") from None
    try:
        server = foxglove.start_server(name="flangeye", port=port)
    except (OSError, RuntimeError) as error:
        raise StageError(f"--foxglove {port}: cannot serve there: {error}") from None
    channels: dict[str, foxglove.Channel] = {}

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
        server.stop()


def _opened(channel: Channel) -> foxglove.Channel:  # type: ignore[name-defined]  # noqa: F821
    import foxglove

    schema = foxglove.Schema(
        name=channel.schema, encoding=channel.schema_encoding, data=channel.schema_data
    )
    return foxglove.Channel(channel.topic, schema=schema, message_encoding=channel.encoding)
