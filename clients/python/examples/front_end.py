"""A front end in the terminal: the tissue as a map of depth, the force as a bar, and a device that strokes over it.

    python front_end.py http://127.0.0.1:7117 liver 10
"""

import argparse
import asyncio
import math
import sys
import time

import numpy as np

import palpate


class Stroke:
    """A device: a hand that circles over the tissue, 2 mm deep. Yours is called a thousand times a second as well."""

    limits, force_n = "omega3", (0.0, 0.0, 0.0)

    def __init__(self):
        self.begun_s = time.monotonic()

    def read(self):
        now_s = time.monotonic() - self.begun_s
        angle = 2 * math.pi * now_s / 4
        return (0.012 * math.cos(angle), 0.012 * math.sin(angle), max(0.004 - 0.006 * now_s, -0.002)), now_s % 0.3 < 0.15

    def write(self, force_n):
        self.force_n = force_n


def draw(frame, force_n, marks=" .:-=+*#%@"):
    depth_m = np.maximum(-frame.displacement_m[..., 2], 0)
    rows = depth_m[:: max(1, depth_m.shape[0] // 60), :: max(1, depth_m.shape[1] // 24)]
    shades = (rows / max(rows.max(), 1e-4) * (len(marks) - 1)).astype(int)
    lines = ["".join(marks[shade] for shade in line) for line in shades.T[::-1]]
    strength_n = math.hypot(*force_n)
    lines.append(f"{frame.time_s:6.2f} s  {1e3 * depth_m.max():4.1f} mm  {strength_n:5.2f} N " + "=" * round(20 * strength_n))
    print("\x1b[H\x1b[2J" * sys.stdout.isatty() + "\n".join(lines), flush=True)


async def main(url, scene, seconds):
    server = await palpate.aio.connect(url)
    async with await server.create_session(scene) as session:
        frames, device = await session.frames(rate_hz=20), Stroke()
        touching = asyncio.ensure_future(session.touch(device, seconds=seconds))
        while not touching.done():
            frame = asyncio.ensure_future(frames.__anext__())
            await asyncio.wait([touching, frame], return_when=asyncio.FIRST_COMPLETED)
            draw(frame.result(), device.force_n) if frame.done() else frame.cancel()
        touched = touching.result()
    print(f"{len(touched.time_s)} ticks, {touched.late_ticks} late; at most {np.abs(touched.force_n).max():.2f} N")


parser = argparse.ArgumentParser()
for name, kind in {"url": str, "scene": str, "seconds": float}.items():
    parser.add_argument(name, type=kind)
asyncio.run(main(**vars(parser.parse_args())))
