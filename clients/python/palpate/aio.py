"""The client of a server for asyncio: what `palpate.connect` gives, with everything that waits to be awaited.

    server = await palpate.aio.connect("http://127.0.0.1:7117")
    async with await server.create_session("liver") as session:
        async for frame in await session.frames():
            ...
"""

from ._native import Frames, RemoteSession, Samples
from ._native import Server as Client

__all__ = ["Client", "Frames", "RemoteSession", "Samples", "connect"]


def connect(url, *, token=None, ca=None, tls_name=None, cert=None, key=None, within_s=10.0):
    """A connection to the server at `url`, to be awaited."""
    return Client.connect(
        url, token=token, ca=ca, tls_name=tls_name, cert=cert, key=key, within_s=within_s, awaited=True
    )
