"""Looks at a session: how deep the tissue is dented, frame by frame. While nothing moves, no frame comes.

    python look.py http://127.0.0.1:7117 liver 3         a new session of the scene `liver`, for 3 s
    python look.py http://127.0.0.1:7117 SESSION 3       a session that others touch
"""

import argparse
import asyncio
import time

import palpate


async def look(session: palpate.aio.RemoteSession, seconds: float) -> None:
    mesh = await session.mesh()
    rest_m = mesh["rest_m"].reshape(*mesh["grid"], 3)
    frames, end_s = await session.frames(rate_hz=30), time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0:
        try:
            frame = await asyncio.wait_for(frames.__anext__(), left_s)
        except asyncio.TimeoutError:
            break
        depth_m = -frame.displacement_m[..., 2]
        x_m, y_m, _ = rest_m[divmod(int(depth_m.argmax()), depth_m.shape[1])]
        place = f"x {1e3 * x_m:.1f}, y {1e3 * y_m:.1f} mm"
        print(f"{frame.time_s:7.3f} s  {1e3 * depth_m.max():6.2f} mm deep at {place}", flush=True)


async def main(url: str, name: str, seconds: float) -> None:
    server = await palpate.aio.connect(url)
    if name in await server.scenes():
        async with await server.create_session(name) as session:
            await look(session, seconds)
    else:
        await look(await server.session(name), seconds)


parser = argparse.ArgumentParser(description="Look at a session: how deep the tissue is dented.")
parser.add_argument("url", help="of the server, such as http://127.0.0.1:7117")
parser.add_argument("name", metavar="scene", help="of a new session, such as liver; or the ID of a session")
parser.add_argument("seconds", type=float)
asyncio.run(main(**vars(parser.parse_args())))
