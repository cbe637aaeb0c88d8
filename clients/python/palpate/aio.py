"""The client of a server for asyncio: like `palpate.connect`, but every call that waits returns an awaitable.

    server = await palpate.aio.connect("http://127.0.0.1:7117")
    async with await server.create_session("liver") as session:
        async for frame in await session.frames():
            ...
"""

from ._native import Frames, Measures, RemoteSession, Samples
from ._native import Server as Client

__all__ = ["Client", "Frames", "Measures", "RemoteSession", "Samples", "connect"]


def connect(url, *, token=None, ca=None, tls_name=None, cert=None, key=None, within_s=10.0):
    """Connects to the server at `url`; await the result. See `palpate.connect` for the arguments."""
    return Client.connect(
        url, token=token, ca=ca, tls_name=tls_name, cert=cert, key=key, within_s=within_s, awaited=True
    )
